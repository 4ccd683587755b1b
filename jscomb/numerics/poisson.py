r"""Screened Poisson: the image of least distance from an image and from its gradients.

Layout: images [H,W,C], linear radiance; channels are solved separately. Notation:

    y       primal image, for example independent estimates
    g, h    differences to the right and to the lower neighbour, for example of
            correlated estimates: g_ij ~ u_i,j+1 - u_ij, [H,W-1,C]; h_ij ~ u_i+1,j -
            u_ij, [H-1,W,C]
    D       forward differences, none across the border (natural boundaries)
    alpha   how much the primal image counts

    u = argmin alpha^2 |u - y|^2 + |D_x u - g|^2 + |D_y u - h|^2,
    (alpha^2 + D_x'D_x + D_y'D_y) u = alpha^2 y + D_x'g + D_y'h.

With natural boundaries the cosines of the type-2 transform are the eigenvectors and
2 - 2 cos(pi k / N) the eigenvalues along each axis: one transform, a division, one
transform back, and the solution is exact. Where values are missing that is only
nearly the solution, and conjugate gradients find the rest in few steps.

Sources:
    P. Bhat, B. Curless, M. Cohen, C. Zitnick, "Fourier analysis of the 2D screened
    Poisson equation for gradient domain problems", 2008; J. Makhoul, "A fast cosine
    transform in one and two dimensions", 1980; IDU section 5 (L2 reconstruction).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import check_same_shape, divide
from jscomb.typing import Image

Linear = Callable[[Image], Image]

_STEPS = 100  # at most, of conjugate gradients


def reconstruct(
    primal: Image,
    gradient_x: Float[Array, "_ _ _"],
    gradient_y: Float[Array, "_ _ _"],
    *,
    alpha: float = 0.2,
) -> Image:
    """Image of least squared distance from a primal image and its gradients.

    Pure, linear in the arrays, differentiable, and scale-equivariant. Values that are
    not finite take no part, each for itself. The transforms couple all pixels: the
    rounding error is that of the frame's greatest value.

    Args:
        primal: y, linear radiance, shape [H,W,C].
        gradient_x: g, differences to the right neighbour, shape [H,W-1,C].
        gradient_y: h, differences to the neighbour below, shape [H-1,W,C].
        alpha: > 0, how much the primal image counts against the gradients.

    Returns:
        u, linear radiance, shape [H,W,C]; where all is known its mean is that of y.
        Pixels that nothing is known of are 0.

    Raises:
        ValueError: while tracing, if shapes do not fit or `alpha` is not positive.

    Example:
        >>> y = jnp.array([0.0, 3.0, 0.0]).reshape(1, 3, 1)
        >>> flat = jnp.zeros((1, 2, 1)), jnp.zeros((0, 3, 1))
        >>> print([f"{v:.3f}" for v in reconstruct(y, *flat, alpha=1.0).ravel()])
        ['0.750', '1.500', '0.750']

    Source: IDU section 5 (L2 reconstruction).
    """
    check_same_shape(primal=primal)
    h, w, c = primal.shape
    if not alpha > 0:
        raise ValueError(f"alpha must be positive, got {alpha}")
    for name, array, shape in (
        ("gradient_x", gradient_x, (h, w - 1, c)),
        ("gradient_y", gradient_y, (h - 1, w, c)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    given = primal, gradient_x, gradient_y
    known = tuple(jnp.isfinite(array) for array in given)
    values = tuple(
        jnp.where(mask, array, 0.0) for mask, array in zip(known, given, strict=True)
    )
    return _solve(values, known, alpha)


def _solve(
    values: tuple[Array, ...], known: tuple[Bool[Array, "..."], ...], alpha: float
) -> Image:
    """The least squares solution by the values that are known."""
    rows = lambda u: (alpha * u, jnp.diff(u, axis=1), jnp.diff(u, axis=0))
    image = jax.ShapeDtypeStruct(values[0].shape, values[0].dtype)
    transposed = jax.linear_transpose(rows, image)

    def only_known(residual: tuple[Array, ...]) -> tuple[Array, ...]:
        pairs = zip(known, residual, strict=True)
        return tuple(jnp.where(mask, each, 0.0) for mask, each in pairs)

    primal, *gradients = values
    (right,) = transposed((alpha * primal, *gradients))
    solution = _conjugate_gradients(
        lambda u: transposed(only_known(rows(u)))[0],
        right,
        lambda right: _cosine_solve(right, alpha),
    )
    return jnp.where(_touched(*known), solution, 0.0)


def _touched(primal: Array, gradient_x: Array, gradient_y: Array) -> Bool[Array, "..."]:
    """Pixels that any known value tells of."""
    for axis, gradient in ((1, gradient_x), (0, gradient_y)):
        for side in ((1, 0), (0, 1)):
            ends = [side if a == axis else (0, 0) for a in range(3)]
            primal = primal | jnp.pad(gradient, ends)
    return primal


def _conjugate_gradients(
    operator: Linear, right: Image, approximate_inverse: Linear
) -> Image:
    """Solve operator(u) = right; at once, if the approximate inverse is exact."""
    tolerance = 10 * float(jnp.finfo(right.dtype).eps)

    def solve(operator: Linear, right: Image) -> Image:
        enough = tolerance**2 * jnp.sum(jnp.square(right))

        def unfinished(state: tuple) -> Array:
            _, residual, _, _, step = state
            return (jnp.sum(jnp.square(residual)) > enough) & (step < _STEPS)

        def improve(state: tuple) -> tuple:
            u, residual, direction, length, step = state
            image = operator(direction)
            curvature = jnp.sum(direction * image)
            far = divide(length, curvature, where=curvature > 0)
            u, residual = u + far * direction, residual - far * image
            steepest = approximate_inverse(residual)
            shorter = jnp.sum(residual * steepest)
            share = divide(shorter, length, where=length > 0)
            return u, residual, steepest + share * direction, shorter, step + 1

        u = approximate_inverse(right)
        residual = right - operator(u)
        direction = approximate_inverse(residual)
        length = jnp.sum(residual * direction)
        return lax.while_loop(unfinished, improve, (u, residual, direction, length, 0))[
            0
        ]

    return lax.custom_linear_solve(operator, right, solve, symmetric=True)


def _cosine_solve(right: Image, alpha: float) -> Image:
    """The solution where every value is known."""
    h, w, _ = right.shape
    across, down = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (w, h))
    eigenvalues = (alpha**2 + np.add.outer(down, across))[..., None]
    inverse = jnp.asarray(1 / eigenvalues, right.dtype)
    spectrum = _cosines(_cosines(right, 0), 1)
    return _from_cosines(_from_cosines(inverse * spectrum, 0), 1)


def _cosines(image: Array, axis: int) -> Array:
    """Cosine transform of type 2 along an axis: sum_j x_j cos(pi k (2j + 1) / 2N)."""
    x = jnp.moveaxis(image, axis, -1)
    # Even places, then the odd ones backwards: a Fourier transform of as many points.
    spectrum = jnp.fft.fft(jnp.concatenate([x[..., ::2], x[..., 1::2][..., ::-1]], -1))
    return jnp.moveaxis((spectrum * _turn(x)).real, -1, axis)


def _from_cosines(spectrum: Array, axis: int) -> Array:
    """The inverse of `_cosines`."""
    s = jnp.moveaxis(spectrum, axis, -1)
    mirrored = jnp.pad(s[..., :0:-1], [(0, 0)] * (s.ndim - 1) + [(1, 0)])
    x = jnp.fft.ifft(lax.complex(s, -mirrored) * jnp.conj(_turn(s))).real
    even = (s.shape[-1] + 1) // 2
    back = jnp.zeros_like(s).at[..., ::2].set(x[..., :even])
    back = back.at[..., 1::2].set(x[..., even:][..., ::-1])
    return jnp.moveaxis(back, -1, axis)


def _turn(x: Array) -> Array:
    """The factors exp(-i pi k / 2N) along the last axis."""
    n = x.shape[-1]
    angle = (np.pi / 2 * np.arange(n) / n).reshape((1,) * (x.ndim - 1) + (n,))
    parts = np.cos(angle), -np.sin(angle)
    return lax.complex(*(jnp.asarray(part, x.dtype) for part in parts))
