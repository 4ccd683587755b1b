"""Ways to make one image of several bases, by name."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jscomb import ensemble
from jscomb.denoisers import nonlocal_means
from jscomb.ensemble import Filter
from jscomb.frame import Estimate, Frame
from jscomb.numerics import simplex
from jscomb.typing import Image, Variance


class Inputs(NamedTuple):
    """What weights are made from: y [N,H,W,C], x, variances and features [H,W,C]."""

    full: jax.Array
    a: jax.Array
    b: jax.Array
    x_a: Image
    x_b: Image
    v_a: Variance
    v_b: Variance
    albedo: Image | None
    normal: Image | None

    @property
    def halves(self) -> tuple[jax.Array, ...]:
        """y^a, y^b, x_a and x_b."""
        return self.a, self.b, self.x_a, self.x_b


Weigh = Callable[[Inputs], jax.Array]
Method = Callable[[Inputs], Image]


def inputs_of(frame: Frame, estimates: Mapping[str, Estimate]) -> Inputs:
    """The inputs of a frame with two halves and variances, and of its estimates."""
    a, b = frame.halves()
    assert a.variance is not None
    assert b.variance is not None
    return Inputs(
        *ensemble.stack_estimates(estimates),
        *(a.color, b.color, a.variance, b.variance),
        *(frame.albedo, frame.normal),
    )


def filtered(given: Inputs, weights: jax.Array, how: Filter) -> jax.Array:
    """Weights under the cross-bilateral filter, guided by their own ensemble."""
    z, z_a, z_b = (ensemble.average(y, weights) for y in given[:3])
    return ensemble.filter_weights(
        *(weights, z, jnp.square(z_a - z_b) / 2),
        albedo=given.albedo,
        normal=given.normal,
        **how._asdict(),
    )


def weighed(weigh: Weigh, how: Filter | None = None) -> Method:
    """The ensemble with such weights, filtered or not, compiled."""

    def image(given: Inputs) -> Image:
        weights = jnp.broadcast_to(weigh(given), given.full.shape)
        if how is not None:
            weights = filtered(given, weights, how)
        return ensemble.average(given.full, weights)

    return jax.jit(image)


def solved(solver: str, **options) -> Weigh:
    """Weights by a solver of the library."""
    return lambda given: ensemble.solve_weights(*given.halves, solver=solver, **options)


def over(*windows: int, whole_frame: bool = False, shared: bool = True) -> Weigh:
    """Weights of minimum error over one window, or the frame."""
    return lambda given: simplex.quadratic(
        ensemble.error_matrix(
            *given.halves, windows=windows, whole_frame=whole_frame, shared=shared
        )
    )


def either_sign(window: int, *, shared: bool) -> Weigh:
    """Weights of minimum error over a window without a limit at zero."""
    return lambda given: simplex.affine(
        ensemble.error_matrix(
            *given.halves, windows=(window,), whole_frame=False, shared=shared
        )
    )


def selection_errors(given: Inputs) -> jax.Array:
    """Errors of eq. 36 and 37 of each base."""
    return ensemble.selection_errors(*given.halves, given.v_a, given.v_b)


def one_hot(given: Inputs) -> jax.Array:
    """The base of minimum error at each pixel."""
    return ensemble.one_hot(selection_errors(given))


def one_hot_window(given: Inputs) -> jax.Array:
    """The base of minimum error over 31x31 pixels, of all channels and relative."""
    matrix = ensemble.error_matrix(*given.halves, windows=(31,), whole_frame=False)
    return ensemble.one_hot(jnp.stack([m[k] for k, m in enumerate(matrix)]))


def one_hot_bilateral(given: Inputs) -> jax.Array:
    """The base of minimum error, errors filtered like weights, by the noisy image."""
    found = ensemble.filter_weights(
        selection_errors(given),
        (given.x_a + given.x_b) / 2,
        (given.v_a + given.v_b) / 4,
        albedo=given.albedo,
        normal=given.normal,
    )
    return ensemble.one_hot(found)


def one_hot_means(given: Inputs) -> jax.Array:
    """The base of minimum error, errors filtered by non-local means."""
    found = jnp.moveaxis(selection_errors(given), 0, 2)
    flat = found.reshape(*found.shape[:2], -1)
    x, v = (given.x_a + given.x_b) / 2, (given.v_a + given.v_b) / 4
    smooth = nonlocal_means.denoise(flat, x, v).reshape(found.shape)
    return ensemble.one_hot(jnp.moveaxis(smooth, 2, 0))


def iterative(given: Inputs) -> jax.Array:
    """Weights by the paper's solver."""
    return solved("iterative", solver_key=jax.random.key(0))(given)


PAPER, OURS, AVERAGE = "pixel, filtered (the paper)", "multi-scale", "average"
UNFILTERED, ITERATIVE = "pixel, no filter", "pixel, filtered, iterative solver"
SHARED = "pixel, filtered, shared by channels"
SHARED_UNFILTERED = "pixel, no filter, shared by channels"
EACH_CHANNEL = "multi-scale, each channel"
EITHER, EITHER_FILTERED = "pixel, either sign", "pixel, either sign, filtered"
CROSS, MEANS = "one-hot, errors cross-bilateral", "one-hot, errors non-local means"
ONE_HOT, AFTER = "one-hot, pixel", "one-hot, weights filtered"
BLURRED, CLIPPED, STANDARD, ALL_THREE = (
    f"{PAPER}, {name}"
    for name in (
        "variance blurred",
        "weights clipped",
        "normals standardised",
        "all three",
    )
)
_LIKE_PAPER = Filter()

METHODS = {
    AVERAGE: weighed(lambda given: jnp.full_like(given.full, 1 / len(given.full))),
    ONE_HOT: weighed(one_hot),
    CROSS: weighed(one_hot_bilateral),
    MEANS: weighed(one_hot_means),
    AFTER: weighed(one_hot, _LIKE_PAPER),
    "one-hot, 31x31": weighed(one_hot_window),
    EITHER: weighed(either_sign(1, shared=False)),
    EITHER_FILTERED: weighed(either_sign(1, shared=False), _LIKE_PAPER),
    UNFILTERED: weighed(solved("hull")),
    SHARED_UNFILTERED: weighed(over(1)),
    PAPER: weighed(solved("hull"), _LIKE_PAPER),
    ITERATIVE: weighed(iterative, _LIKE_PAPER),
    SHARED: weighed(over(1), _LIKE_PAPER),
    BLURRED: weighed(solved("hull"), Filter(blur=2.0)),
    CLIPPED: weighed(solved("hull"), Filter(clip=1.0)),
    STANDARD: weighed(solved("hull"), Filter(standardise=True)),
    ALL_THREE: weighed(solved("hull"), Filter(blur=2.0, clip=1.0, standardise=True)),
    **{f"{w}x{w}": weighed(over(w)) for w in (7, 15, 31, 63)},
    "frame": weighed(over(whole_frame=True)),
    OURS: weighed(solved("multi-scale")),
    "multi-scale, filtered": weighed(solved("multi-scale"), _LIKE_PAPER),
    EACH_CHANNEL: weighed(solved("multi-scale", shared=False)),
    "31x31, either sign": weighed(either_sign(31, shared=True)),
}
