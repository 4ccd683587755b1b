"""Errors of the radiance. Pure and differentiable.

Layout: images [H,W,C], linear radiance.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import check_same_shape, divide, finite
from jscomb.typing import Image, Mask, Scalar


def rel_l2(
    image: Image,
    reference: Image,
    *,
    epsilon: float = 0.01,
    half_difference: Image | None = None,
    mask: Mask | None = None,
) -> Scalar:
    """Relative squared error: mean of (a-r)^2 / (mean_rgb(r)^2 + epsilon).

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: squared radiance that keeps black pixels from deciding.
        half_difference: difference of the reference's two independent halves, shape
            [H,W,C]. Then the part of the error that is the reference's own noise,
            mean of difference^2 / 4 / weight, is subtracted. The result may be
            slightly negative for an image as good as the reference.
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error, no unit.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(rel_l2(jnp.full((2, 2, 3), 1.1), jnp.ones((2, 2, 3))).round(4))
        0.0099

    Source: Rousselle et al. 2011; the form with the channels' mean is NJS's.
    """
    image, reference = pair(image, reference, mask)
    weight = _grey_square(reference) + epsilon
    square = jnp.square(image - reference)
    if half_difference is not None:
        check_same_shape(reference=reference, half_difference=half_difference)
        square = square - jnp.square(_masked(mask, half_difference)) / 4
    return masked_mean(square / weight, mask)


class Change(NamedTuple):
    """An estimated change of an error, and how far to trust it.

    Attributes:
        mean: the estimate, shape []; negative where the error falls.
        standard_error: of the estimate over the frame's pixels, shape [].
    """

    mean: Scalar
    standard_error: Scalar

    @property
    def helps(self) -> Bool[Array, ""]:
        """Whether the error falls by more than the standard error."""
        return self.mean + self.standard_error < 0


def rel_l2_change(
    candidates: Float[Array, "2 h w c"],
    baselines: Float[Array, "2 h w c"],
    unbiased: Float[Array, "2 h w c"],
    *,
    epsilon: Scalar | float = 0.01,
    limit: float | None = None,
) -> Change:
    """Estimate from half buffers, without a reference, what a change does to the error.

    With z the candidate, y the baseline and x the unbiased image of independent halves,

        (z_a - x_b)^2 - (y_a - x_b)^2 = 2 (z_a - y_a) ((z_a + y_a) / 2 - x_b),

    whose expectation over x_b is the difference of the true squared errors: the noise
    of x_b cancels. Both directions, averaged over the whole frame; a single pixel's
    value is far too noisy to decide anything.

    Args:
        candidates: z made from each half, linear radiance, shape [2,H,W,C].
        baselines: y made from each half, likewise.
        unbiased: x of each half, likewise.
        epsilon: squared radiance that keeps black pixels from deciding, as in `rel_l2`.
        limit: how far x counts as away from the middle of z and y, in units of their
            radiance: so no firefly decides for the frame, but the estimate is biased,
            towards the darker image where noise is skewed. None for an unbiased one.

    Returns:
        relative L2 of the candidates less that of the baselines, relative to the mean
        radiance of both. Unbiased, for images made from one half. The standard error
        takes pixels as independent, and the spread of the true change over the frame
        for noise, so it is rather too large. Pixels that are not finite are left out;
        NaN if none is left.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> two = lambda value: jnp.full((2, 4, 4, 3), value)
        >>> change = rel_l2_change(two(1.1), two(1.2), two(1.0))
        >>> print(f"{change.mean:.4f}", change.helps)
        -0.0225 True
    """
    changes = []
    for half in (0, 1):
        z, y, x = candidates[half], baselines[half], unbiased[1 - half]
        check_same_shape(unbiased=x, candidates=z, baselines=y)
        middle = (z + y) / 2
        if limit is not None:
            reach = limit * _root(_grey_square(middle) + epsilon)
            x = middle + jnp.clip(x - middle, -reach, reach)
        square = 2 * (z - y) * (middle - x)
        changes.append(mean_change(square, middle, epsilon=epsilon))
    means, errors = (jnp.stack(i) for i in zip(*changes, strict=True))
    return Change(jnp.mean(means), _root(jnp.sum(jnp.square(errors))) / 2)


def mean_change(
    square: Image, baseline: Image, *, epsilon: Scalar | float = 0.01
) -> Change:
    """Mean over the frame of estimated changes of the squared error.

    Args:
        square: change of each pixel's squared error, squared radiance, shape [H,W,C].
        baseline: radiance that it is relative to, shape [H,W,C].
        epsilon: squared radiance that keeps black pixels from deciding.

    Returns:
        the change of the relative L2; pixels that are not finite are left out.

    Raises:
        ValueError: while tracing, if the shapes differ.

    Example:
        >>> change = mean_change(jnp.full((4, 4, 3), 0.03), jnp.ones((4, 4, 3)))
        >>> print(f"{change.mean:.4f}")
        0.0297
    """
    check_same_shape(square=square, baseline=baseline)
    mask = finite(square, baseline)
    square, baseline = _masked(mask, square), _masked(mask, baseline)
    weight = _grey_square(baseline) + epsilon
    change = jnp.mean(square / weight, axis=-1, keepdims=True)
    mean = masked_mean(change, mask)
    spread = masked_mean(jnp.square(change - mean), mask)
    return Change(mean, _root(spread / jnp.sum(mask).astype(mean.dtype)))


def rmse(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Root of the mean squared error.

    Args:
        image: linear radiance, shape [H,W,C].
        reference: linear radiance, shape [H,W,C].
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error in radiance. Its derivative at an error of zero is 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(f"{rmse(jnp.full((1, 1, 3), 3.0), jnp.ones((1, 1, 3))):.3f}")
        2.000
    """
    image, reference = pair(image, reference, mask)
    square = masked_mean(jnp.square(image - reference), mask)
    return _root(square)


def smape(
    image: Image,
    reference: Image,
    *,
    epsilon: float = 0.001,
    mask: Mask | None = None,
) -> Scalar:
    """Symmetric mean absolute percentage error: |a-r| / (|a| + |r| + epsilon).

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: radiance that keeps black pixels from deciding.
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error, in [0, 1].

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(f"{smape(jnp.full((1, 1, 3), 3.0), jnp.ones((1, 1, 3))):.3f}")
        0.500

    Source: DSC eq. 18 (epsilon 0.001).
    """
    image, reference = pair(image, reference, mask)
    scale = jnp.abs(image) + jnp.abs(reference) + epsilon
    return masked_mean(jnp.abs(image - reference) / scale, mask)


def _grey_square(image: Image) -> Array:
    """Squared mean of a pixel's channels, [H,W,1]."""
    return jnp.square(jnp.mean(image, axis=-1, keepdims=True))


def _root(square: Array) -> Array:
    """Square root with derivative 0 at 0; NaN stays NaN."""
    exact = square == 0
    return jnp.where(exact, 0.0, jnp.sqrt(jnp.where(exact, 1.0, square)))


def pair(image: Image, reference: Image, mask: Mask | None) -> tuple[Image, Image]:
    """Image and reference of one shape, ready for arithmetic.

    Args:
        image: shape [H,W,C].
        reference: likewise.
        mask: pixels that count, shape [H,W,1].

    Returns:
        both, 0 where a pixel does not count.

    Raises:
        ValueError: while tracing, if shapes differ.
    """
    check_same_shape(image=image, reference=reference)
    return _masked(mask, image), _masked(mask, reference)


def _masked(mask: Mask | None, image: Image) -> Image:
    """The image with 0 where a pixel does not count, for finite derivatives."""
    return image if mask is None else jnp.where(mask, image, 0.0)


def masked_mean(values: Image, mask: Mask | None) -> Scalar:
    """Mean over pixels that count and all channels.

    Args:
        values: shape [H,W,C].
        mask: pixels that count, shape [H,W,1].

    Returns:
        the mean; NaN if no pixel counts.
    """
    if mask is None:
        return jnp.mean(values)
    total = jnp.sum(jnp.where(mask, values, 0.0))
    count = jnp.sum(mask).astype(total.dtype) * values.shape[-1]
    return divide(total, count, where=count > 0, otherwise=jnp.nan)
