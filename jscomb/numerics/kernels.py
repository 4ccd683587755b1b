"""Means over windows where every pixel has its own kernel, given or predicted.

Such weights have no separable form. A network predicts many: 225 a pixel for windows of
15 take 0.9 GB a megapixel, so `predicted_mean` makes and uses them a strip of rows at a
time. The sums walk the window pixel by pixel, so that neither the value nor the reverse
derivative ever holds w² shifted copies of the image.

Layout: images [H,W,C] of any unit, which is that of the means; kernels [H,W,w²], at
least zero, row-major over the offsets (-r, -r) ... (r, r) with r = w // 2. Weights
outside the image do not count. Windows and `mask` as in `windows`.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import check_image, weighted_ratio
from jscomb.numerics.tiles import by_device, map_rows
from jscomb.numerics.windows import check_window
from jscomb.typing import Image, Mask

__all__ = ["Kernels", "kernel_mean", "predicted_mean"]

_ROWS = 16  # of a strip, at least


class Kernels(NamedTuple):
    """Kernels of all pixels, to be evaluated a strip of rows at a time.

    Attributes:
        features: input of the head, shape [H,W,F].
        head: from a strip of features, [t+2*reach,W,F], to weights [t,W,K].
        reach: rows around a strip that its weights depend on.
        window: width of the windows in pixels, odd.
    """

    features: Image
    head: Callable[[Array], Array]
    reach: int
    window: int


def kernel_mean(
    image: Image,
    weights: Float[Array, "h w window2"],
    window: int,
    *,
    mask: Mask | None = None,
) -> Image:
    """Average over the window of each pixel with its own weights.

    Args:
        image: shape [H,W,C].
        weights: kernels, shape [H,W,w²].
        window: width w in pixels, odd.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the means, shape [H,W,C]; 0 where all included pixels have weight 0.

    Raises:
        ValueError: if `window` is even or below one, or the weights do not fit.

    Example:
        >>> left = jnp.zeros((1, 3, 9)).at[..., 3].set(1.0)
        >>> image = jnp.array([1.0, 2.0, 3.0]).reshape(1, 3, 1)
        >>> print(kernel_mean(image, left, 3)[0, :, 0])
        [0. 1. 2.]
    """
    check_image(image=image)
    h, w, _ = image.shape
    r = check_window(window) // 2
    if weights.shape != (h, w, window**2):
        raise ValueError(
            f"weights must have shape {(h, w, window**2)} for this image and window, "
            f"got {weights.shape}"
        )
    padded = jnp.pad(_counted([image], mask), ((r, r), (r, r), (0, 0)))
    return _mean(_weighted_sum(padded, weights, window))


def predicted_mean(
    images: Float[Array, "n h w c"],
    kernels: Kernels,
    *,
    mask: Mask | None = None,
) -> Float[Array, "n h w c"]:
    """Average over the window of each pixel with weights that a network predicts.

    Args:
        images: each with its own kernels, shape [N,H,W,C].
        kernels: N w² weights a pixel, one image after another.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the means, shape [N,H,W,C]; 0 where all included pixels have weight 0.

    Raises:
        ValueError: if the window is even or below one, or there are not N w² weights.

    Example:
        >>> image = jnp.array([1.0, 2.0, 6.0]).reshape(1, 3, 1)
        >>> even = lambda near: jnp.ones((*near.shape[:2], 9))
        >>> (mean,) = predicted_mean(image[None], Kernels(image, even, 0, 3))
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['1.50', '3.00', '4.00']
    """
    n, _, width, c = images.shape
    window = check_window(kernels.window)
    r = window // 2
    padded = jnp.pad(_counted(images, mask), ((0, 0), (r, r), (0, 0)))

    def strip(features: Array, near: Array) -> Array:
        """Return the means of all images side by side."""
        weights = kernels.head(features)
        if weights.shape[-1] != n * window**2:
            raise ValueError(
                f"{n} images and windows of {window} need {n * window**2} weights a "
                f"pixel, got {weights.shape[-1]}"
            )
        means = []
        for k, kernel in enumerate(jnp.split(weights, n, axis=-1)):
            channels = jnp.r_[k * c : (k + 1) * c, n * c]  # an image and the mask
            means.append(_mean(_weighted_sum(near[..., channels], kernel, window)))
        return jnp.concatenate(means, axis=-1)

    weights = by_device(cpu=2**22, accelerator=2**28)  # of a strip, about
    rows = max(_ROWS, weights // (width * n * window**2))
    mean = map_rows(strip, [(kernels.features, kernels.reach), (padded, r)], rows=rows)
    return jnp.stack(jnp.split(mean, n, axis=-1))


def _counted(images: Iterable[Image], mask: Mask | None) -> Array:
    """Return images side by side, then the mask as numbers; 0 where excluded."""
    images = list(images)
    ones = jnp.ones_like(images[0][..., :1])
    if mask is None:
        return jnp.concatenate([*images, ones], axis=-1)
    included = [jnp.where(mask, image, 0.0) for image in images]
    return jnp.concatenate([*included, mask.astype(ones.dtype)], axis=-1)


def _weighted_sum(
    padded: Float[Array, "_ _ c"], weights: Float[Array, "h w _"], window: int
) -> Image:
    """Sum over windows of an image that has w // 2 more pixels on every side."""
    h, w, _ = weights.shape
    # Channels first: every step reads and writes whole images in their order.
    image, taps = (jnp.moveaxis(array, -1, 0) for array in (padded, weights))

    @jax.checkpoint
    def add(total: Array, tap: tuple[Array, Array]) -> tuple[Array, None]:
        number, weight = tap
        corner = (jnp.zeros_like(number), number // window, number % window)
        near = lax.dynamic_slice(image, corner, (image.shape[0], h, w))
        return total + weight[None] * near, None

    start = jnp.zeros((image.shape[0], h, w), padded.dtype)
    total, _ = lax.scan(add, start, (jnp.arange(window**2), taps))
    return jnp.moveaxis(total, 0, -1)


def _mean(sums: Float[Array, "h w _"]) -> Float[Array, "h w _"]:
    """Divide sums by the last of them, that of the weights."""
    return weighted_ratio(sums[..., :-1], sums[..., -1:])
