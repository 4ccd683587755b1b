"""Errors of linear radiance; pure and differentiable."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import (
    check_same_shape,
    masked_mean,
    safe_sqrt,
    zero_invalid,
)
from jscomb.numerics.linear import channel_mean
from jscomb.typing import Image, Mask, Scalar


def rel_l2(
    image: Image,
    reference: Image,
    *,
    epsilon: float = 0.01,
    half_difference: Image | None = None,
    mask: Mask | None = None,
) -> Scalar:
    """Return the relative squared error: mean of (a-r)^2 / (mean_rgb(r)^2 + epsilon).

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: squared radiance that limits the weight of black pixels.
        half_difference: difference of the reference's independent halves, to subtract
            the error of its own noise, shape [H,W,C]. The result may be slightly
            negative for an image as good as the reference.
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
    image, reference = counted(mask, image=image, reference=reference)
    square = jnp.square(image - reference)
    if half_difference is not None:
        _, difference = counted(
            mask, reference=reference, half_difference=half_difference
        )
        square = square - jnp.square(difference) / 4
    return mean(square / (grey_square(reference) + epsilon), mask)


def rel_l2_map(
    image: Image, reference: Image, *, epsilon: float = 0.01
) -> Float[Array, "h w 1"]:
    """Return the relative squared error of every pixel, whose mean is `rel_l2`.

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: squared radiance that limits the weight of black pixels.

    Returns:
        the mean over channels of (a-r)^2 / (mean_rgb(r)^2 + epsilon), shape [H,W,1].

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> image = jnp.array([[[1.1], [2.0]]])
        >>> errors = rel_l2_map(image, jnp.ones((1, 2, 1)))
        >>> print([f"{error:.4f}" for error in errors.ravel()])
        ['0.0099', '0.9901']
    """
    check_same_shape(image=image, reference=reference)
    square = channel_mean(jnp.square(image - reference))
    return square / (grey_square(reference) + epsilon)


class Change(NamedTuple):
    """An estimated change of an error.

    Attributes:
        mean: the estimate, shape []; negative if the error falls.
        standard_error: of `mean`, over the frame's pixels, shape [].
    """

    mean: Scalar
    standard_error: Scalar

    @property
    def helps(self) -> Bool[Array, ""]:
        """Whether the error falls by more than the standard error of the estimate."""
        return self.mean + self.standard_error < 0


def rel_l2_change(
    candidates: Float[Array, "2 h w c"],
    baselines: Float[Array, "2 h w c"],
    unbiased: Float[Array, "2 h w c"],
    *,
    epsilon: Scalar | float = 0.01,
    limit: float | None = None,
) -> Change:
    """Estimate the change of an error from half buffers, without a reference.

    With z the candidate, y the baseline and x the unbiased image of independent halves,

        (z_a - x_b)^2 - (y_a - x_b)^2 = 2 (z_a - y_a) ((z_a + y_a) / 2 - x_b),

    the expectation over x_b is the difference of the true squared errors. Averaged over
    both directions and the whole frame; a single pixel's value is far too noisy.

    Args:
        candidates: z made from each half, linear radiance, shape [2,H,W,C].
        baselines: y made from each half, linear radiance, shape [2,H,W,C].
        unbiased: x of each half, linear radiance, shape [2,H,W,C].
        epsilon: squared radiance that limits the weight of black pixels.
        limit: maximum distance of x from the middle of z and y, relative to their
            radiance. It bounds the effect of a firefly, but biases the estimate towards
            the darker image where noise is skewed. None for an unbiased estimate.

    Returns:
        relative L2 of the candidates minus that of the baselines, relative to the mean
        radiance of both; unbiased for images made from one half. The standard error
        assumes independent pixels and includes the spread of the true change over the
        frame, so it is rather too large. Pixels that are not finite are excluded; NaN
        if none remains.

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
            reach = limit * safe_sqrt(grey_square(middle) + epsilon)
            x = middle + jnp.clip(x - middle, -reach, reach)
        square = 2 * (z - y) * (middle - x)
        changes.append(mean_change(square, middle, epsilon=epsilon))
    means, errors = (jnp.stack(i) for i in zip(*changes, strict=True))
    return Change(jnp.mean(means), safe_sqrt(jnp.sum(jnp.square(errors))) / 2)


def mean_change(
    square: Image, baseline: Image, *, epsilon: Scalar | float = 0.01
) -> Change:
    """Return the change of the relative L2 from each pixel's change of squared error.

    Args:
        square: estimated change of the squared error, squared radiance, shape [H,W,C].
        baseline: linear radiance that it is relative to, shape [H,W,C].
        epsilon: squared radiance that limits the weight of black pixels.

    Returns:
        the mean over pixels that are finite in both images; NaN if there is none.

    Raises:
        ValueError: while tracing, if the shapes differ.

    Example:
        >>> change = mean_change(jnp.full((4, 4, 3), 0.03), jnp.ones((4, 4, 3)))
        >>> print(f"{change.mean:.4f}")
        0.0297
    """
    check_same_shape(square=square, baseline=baseline)
    valid, square, baseline = zero_invalid(square, baseline)
    weight = grey_square(baseline) + epsilon
    change = channel_mean(square / weight)
    average = mean(change, valid)
    spread = mean(jnp.square(change - average), valid)
    return Change(average, safe_sqrt(spread / jnp.sum(valid).astype(spread.dtype)))


def rmse(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Return the root of the mean squared error.

    Args:
        image: linear radiance, shape [H,W,C].
        reference: linear radiance, shape [H,W,C].
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error in radiance; its derivative at an error of zero is 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(f"{rmse(jnp.full((1, 1, 3), 3.0), jnp.ones((1, 1, 3))):.3f}")
        2.000
    """
    image, reference = counted(mask, image=image, reference=reference)
    return safe_sqrt(mean(jnp.square(image - reference), mask))


def smape(
    image: Image,
    reference: Image,
    *,
    epsilon: float = 0.001,
    mask: Mask | None = None,
) -> Scalar:
    """Return the symmetric mean absolute percentage error.

    The mean of |a-r| / (|a| + |r| + epsilon).

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: radiance that limits the weight of black pixels.
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
    image, reference = counted(mask, image=image, reference=reference)
    scale = jnp.abs(image) + jnp.abs(reference) + epsilon
    return mean(jnp.abs(image - reference) / scale, mask)


def grey_square(image: Image) -> Array:
    """Squared mean of a pixel's channels, [H,W,1]."""
    return jnp.square(channel_mean(image))


def counted(mask: Mask | None, **images: Image) -> tuple[Image, ...]:
    """Return images of one shape, 0 where a pixel does not count.

    So the derivatives there are 0, whatever the image holds.
    """
    check_same_shape(**images)
    if mask is None:
        return tuple(images.values())
    return tuple(jnp.where(mask, image, 0.0) for image in images.values())


def mean(values: Image, mask: Mask | None) -> Scalar:
    """Return the mean over pixels that count and channels; NaN if no pixel counts."""
    return masked_mean(values, mask, otherwise=jnp.nan)
