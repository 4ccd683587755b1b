"""From errors to weights, and from weights to the image."""

import functools
from collections.abc import Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jscomb.ensemble._estimate import SCALES, error_matrix, selection_errors
from jscomb.ensemble._evidence import Bases, check_bases
from jscomb.ensemble._filter import Filter, Guide, filter_weights
from jscomb.numerics import simplex
from jscomb.numerics.guards import first_finite, zero_invalid
from jscomb.numerics.linear import stack_sum
from jscomb.numerics.windows import block_sum, window_mean
from jscomb.typing import Image, Key, Variance

Blocks = Float[Array, "n rows columns _"]
Solver = Literal["multi-scale", "hull", "iterative", "reference", "one-hot"]
_SMOOTH = 2.0  # standard deviation, in blocks, of the filter of multi-scale weights


def combine(
    biased: Bases,
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    *,
    solver: Solver = "multi-scale",
    filter: bool | Filter = False,
    albedo: Guide | None = None,
    normal: Guide | None = None,
    solver_key: Key | None = None,
    variance_a: Variance | None = None,
    variance_b: Variance | None = None,
    windows: Sequence[int] = SCALES,
    shared: bool = True,
    block: int = 4,
) -> Image:
    """Combine any number of bases by the weights of minimum estimated error.

    Pure, scale-equivariant, and differentiable in every array with the exact solvers.
    The paper's method is `solver="hull", filter=True`, its comparison with a selection
    of one base a pixel (section 5.2.6) `solver="one-hot", filter=True`.

    Args:
        biased: y, each base of the full frame, radiance, shape [N,H,W,C]. The unbiased
            image may be one of them, which makes the result consistent.
        biased_a: the bases made from half a, same shape.
        biased_b: the bases made from half b, same shape.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, same shape.
        solver: see `solve_weights`.
        filter: smooth the weights by `filter_weights`, guided by the ensemble with the
            weights as they are; a `Filter` has other options than the paper's.
        albedo: guide of the filter, shape [H,W,3]; optional, as is the normal.
        normal: guide of the filter, shape [H,W,3].
        solver_key: of the iterative solver, a typed key.
        variance_a: of x_a, shape [H,W,C]; "one-hot" needs it, and "multi-scale" takes
            it as `error_matrix` does.
        variance_b: of x_b, same shape.
        windows: of "multi-scale".
        shared: of "multi-scale", one weight for all channels.
        block: of "multi-scale", width in pixels of the blocks whose weights are solved
            for, and interpolated between them.

    Returns:
        the combined image, radiance, shape [H,W,C]; at a pixel where a base is not
        finite the first that is, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, there is no base, or as
            `solve_weights`.

    Example:
        >>> at = lambda *values: jnp.array(values).reshape(-1, 1, 1, 1)
        >>> y, x = at(1.0, 4.0), at(2.0)[0]
        >>> print(combine(y, y, y, x, x)[0, 0].round(3))
        [2.]

    Source: ED section 4; the multi-scale weights are ours.
    """
    weights = filtered_weights(
        biased,
        biased_a,
        biased_b,
        unbiased_a,
        unbiased_b,
        solver=solver,
        filter=filter,
        albedo=albedo,
        normal=normal,
        solver_key=solver_key,
        variance_a=variance_a,
        variance_b=variance_b,
        windows=windows,
        shared=shared,
        block=block,
    )
    return average(biased, weights)


def filtered_weights(
    biased: Bases,
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    *,
    filter: bool | Filter,
    albedo: Guide | None,
    normal: Guide | None,
    **options: Any,
) -> Bases:
    """The weights of `combine`; options are those of `solve_weights`."""
    if biased.shape != biased_a.shape:
        raise ValueError(f"biased is {biased.shape}, biased_a is {biased_a.shape}")
    weights = solve_weights(biased_a, biased_b, unbiased_a, unbiased_b, **options)
    if not filter:
        return weights
    z, z_a, z_b = (average(y, weights) for y in (biased, biased_a, biased_b))
    noise = jnp.square(z_a - z_b) / 2
    how = filter if isinstance(filter, Filter) else Filter()
    return filter_weights(
        weights, z, noise, albedo=albedo, normal=normal, **how._asdict()
    )


def solve_weights(
    biased_a: Bases,
    biased_b: Bases,
    unbiased_a: Image,
    unbiased_b: Image,
    *,
    solver: Solver = "multi-scale",
    solver_key: Key | None = None,
    variance_a: Variance | None = None,
    variance_b: Variance | None = None,
    windows: Sequence[int] = SCALES,
    shared: bool = True,
    block: int = 4,
) -> Bases:
    """Solve for the weights of the bases at every pixel.

    Args:
        biased_a: y^a, each base made from half a, radiance, shape [N,H,W,C].
        biased_b: y^b, made from half b.
        unbiased_a: x_a, shape [H,W,C].
        unbiased_b: x_b, same shape.
        solver: "multi-scale", ours: `quadratic` on `error_matrix`; "hull", the paper's
            objective of single pixels and channels, exactly; "iterative" and
            "reference", the same by the paper's solver and by jaxopt; "one-hot", the
            base of minimum `selection_errors`.
        solver_key: of the iterative solver, a typed key.
        variance_a: of x_a, shape [H,W,C]; "one-hot" needs it, and "multi-scale" takes
            it as `error_matrix` does.
        variance_b: of x_b, same shape.
        windows: of "multi-scale".
        shared: of "multi-scale", one weight for all channels.
        block: of "multi-scale", width in pixels of the blocks whose weights are solved
            for, and interpolated between them.

    Returns:
        the weights, at least zero, of sum one, shape [N,H,W,C]; at an invalid pixel
        1/N, or those of the pixels around it.

    Raises:
        ValueError: while tracing, if shapes differ, there is no base, the solver is
            unknown, or lacks its key or variances.

    Example:
        >>> at = lambda *values: jnp.array(values).reshape(-1, 1, 1, 1)
        >>> y, x = at(1.0, 4.0), at(2.0)[0]
        >>> weights = solve_weights(y, y, x, x, solver="hull")
        >>> print([f"{share:.3f}" for share in weights.ravel()])
        ['0.667', '0.333']

    Source: ED eq. 13, 14.
    """
    check_bases(biased_a, biased_b, unbiased_a, unbiased_b)
    images = biased_a, biased_b, unbiased_a, unbiased_b
    if solver == "multi-scale":
        matrix = error_matrix(
            *images,
            variance_a=variance_a,
            variance_b=variance_b,
            windows=windows,
            shared=shared,
            block=block,
        )
        there = block_sum(zero_invalid(*images)[0].astype(matrix.dtype), block) > 0
        weights = interpolated(simplex.quadratic(matrix), block, there)
        height, width = biased_a.shape[1:3]
        return jnp.broadcast_to(weights[:, :height, :width], biased_a.shape)
    _, *clean = zero_invalid(*images)
    if solver == "hull":
        return simplex.hull(*clean)
    if solver == "one-hot":
        if variance_a is None or variance_b is None:
            raise ValueError("the one-hot solver needs variance_a and variance_b")
        return one_hot(selection_errors(*images, variance_a, variance_b))
    if solver == "reference":
        return simplex.reference(*clean)
    if solver != "iterative":
        raise ValueError(f"solver must be one of {get_args(Solver)}, got {solver!r}")
    if solver_key is None:
        raise ValueError("the iterative solver needs solver_key")
    return simplex.iterative(solver_key, *clean)


def interpolated(
    weights: Blocks, block: int, there: Bool[Array, "rows columns 1"] | None = None
) -> Bases:
    """Values of every pixel from those of blocks: smooth, without a seam.

    Blocks that are not there change no value of the others.
    """
    if block == 1:
        return weights
    if there is None:
        there = jnp.ones((*weights.shape[1:3], 1), bool)
    window = 2 * round(2 * _SMOOTH) - 1
    mean = functools.partial(window_mean, window=window, sigma=_SMOOTH)
    smooth = jax.vmap(functools.partial(mean, mask=there))(weights)
    smooth = jnp.where(mean(there.astype(weights.dtype)) > 0, smooth, weights)
    columns, there = _upsampled(smooth, there, block, axis=1)
    return _upsampled(columns, there, block, axis=2)[0]


def _upsampled(
    values: Array, there: Array, factor: int, *, axis: int
) -> tuple[Array, Array]:
    """Linear interpolation between the middles of blocks, constant beyond the last.

    And which of the new blocks, smaller along the axis, are there.
    """
    values = jnp.moveaxis(values, axis, 0)
    known = jnp.moveaxis(there[None], axis, 0)
    parts = []
    for offset in ((np.arange(factor) + 0.5) / factor - 0.5).tolist():
        other, beside = (_next(i, after=offset > 0) for i in (values, known))
        change = jnp.where(beside, other - values, 0.0)
        parts.append(values + abs(offset) * change)
    fine = jnp.stack(parts, axis=1).reshape(-1, *values.shape[1:])
    return jnp.moveaxis(fine, 0, axis), jnp.repeat(there, factor, axis=axis - 1)


def _next(values: Array, *, after: bool) -> Array:
    """The values after or before each along the first axis; the last's own."""
    if after:
        return jnp.concatenate([values[1:], values[-1:]])
    return jnp.concatenate([values[:1], values[:-1]])


def one_hot(errors: Bases) -> Bases:
    """Return weights that select the base of minimum error.

    Args:
        errors: of each base at each pixel, for example `selection_errors`, filtered or
            not, shape [N,H,W,C].

    Returns:
        1 for the base of minimum error, the first of equals, else 0, shape [N,H,W,C].

    Example:
        >>> errors = jnp.array([2.0, 1.0, 3.0]).reshape(3, 1, 1, 1)
        >>> print(one_hot(errors).ravel())
        [0. 1. 0.]

    Source: ED section 5.2.6.
    """
    best = jnp.argmin(errors, axis=0)
    return jax.nn.one_hot(best, len(errors), axis=0, dtype=errors.dtype)


def average(biased: Bases, weights: Bases) -> Image:
    """Average the bases with weights: the ensemble.

    Args:
        biased: y, radiance, shape [N,H,W,C].
        weights: of sum one, shape [N,H,W,C].

    Returns:
        the image, shape [H,W,C]; at a pixel where a base is not finite the first that
        is, else 0.

    Example:
        >>> at = lambda *values: jnp.array(values).reshape(-1, 1, 1, 1)
        >>> print(average(at(1.0, 5.0), at(0.75, 0.25))[0, 0])
        [2.]

    Source: ED eq. 3.
    """
    valid, clean = zero_invalid(biased)
    total = jnp.sum(weights * clean, axis=0)
    return jnp.where(valid, total, first_finite(*biased))


def spread(biased: Bases, weights: Bases) -> Image:
    """Return the weighted variance of the bases: where they disagree.

    Args:
        biased: y, radiance, shape [N,H,W,C].
        weights: of sum one, shape [N,H,W,C].

    Returns:
        squared radiance, shape [H,W,C]; 0 at a pixel where a base is not finite.

    Example:
        >>> at = lambda *values: jnp.array(values).reshape(-1, 1, 1, 1)
        >>> print(spread(at(1.0, 5.0), at(0.75, 0.25))[0, 0])
        [3.]
    """
    valid, clean = zero_invalid(biased)
    distance = jnp.square(clean - stack_sum(weights * clean)[None])
    return jnp.where(valid, stack_sum(weights * distance), 0.0)
