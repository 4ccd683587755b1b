"""Means over windows with weights of each pixel's own, given or predicted.

Such weights have no separable form. A network's are many: 225 a pixel for windows of 15
take 0.9 GB a megapixel, so `predicted_mean` makes and uses them a strip of rows at a
time. The sums walk the window row by row, so that neither the value nor the reverse
derivative ever holds its w² shifted copies of the image.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jscomb.numerics.guards import divide
from jscomb.numerics.tiles import map_rows
from jscomb.numerics.windows import check_window
from jscomb.typing import Image, Mask


class Kernels(NamedTuple):
    """Weights of every pixel's window, to be worked out a strip of rows at a time.

    Attributes:
        features: what they are made of, shape [H,W,F].
        head: from a strip of them, [t+2*reach,W,F], to weights, at least zero, [t,W,K].
        reach: rows around a strip that its weights depend on.
    """

    features: Image
    head: Callable[[Array], Array]
    reach: int


def kernel_mean(
    image: Image,
    weights: Float[Array, "h w window2"],
    window: int,
    *,
    mask: Mask | None = None,
) -> Image:
    """Mean over the window of each pixel with weights of its own.

    Args:
        image: values of any unit, shape [H,W,C].
        weights: at least zero, shape [H,W,w²], row-major over the offsets
            (-r, -r) ... (r, r); those that fall outside the image do not count.
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the means, in the unit of `image`, shape [H,W,C]; 0 where the weights of all
        pixels that take part are 0.

    Raises:
        ValueError: if `window` is even or less than one, or the weights' shape is not
            [H,W,w²].

    Example:
        >>> left = jnp.zeros((1, 3, 9)).at[..., 3].set(1.0)
        >>> image = jnp.array([1.0, 2.0, 3.0]).reshape(1, 3, 1)
        >>> print(kernel_mean(image, left, 3)[0, :, 0])
        [0. 1. 2.]
    """
    h, w, _ = image.shape
    r = check_window(window) // 2
    if weights.shape != (h, w, window**2):
        raise ValueError(
            f"weights must have shape {(h, w, window**2)} for this image and window, "
            f"got {weights.shape}"
        )
    padded = jnp.pad(_counted([image], mask), ((r, r), (r, r), (0, 0)))
    return _mean(_taps(padded, weights, window))


def predicted_mean(
    images: Float[Array, "n h w c"],
    kernels: Kernels,
    window: int,
    *,
    mask: Mask | None = None,
) -> Float[Array, "n h w c"]:
    """Means over the window of each pixel with weights that a network predicts.

    The weights of a strip of rows exist while it is worked on, never those of all
    pixels.

    Args:
        images: values of any unit, each with kernels of its own, shape [N,H,W,C].
        kernels: N w² weights a pixel, as for `kernel_mean`, one image after another.
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the means, shape [N,H,W,C]; 0 where the weights of all pixels that take part
        are 0.

    Raises:
        ValueError: if `window` is even or less than one, or there are not N w² weights.

    Example:
        >>> image = jnp.array([1.0, 2.0, 6.0]).reshape(1, 3, 1)
        >>> even = lambda near: jnp.ones((*near.shape[:2], 9))
        >>> (mean,) = predicted_mean(image[None], Kernels(image, even, 0), 3)
        >>> print([f"{value:.2f}" for value in mean.ravel()])
        ['1.50', '3.00', '4.00']
    """
    n, _, _, c = images.shape
    r = check_window(window) // 2
    both = jnp.pad(_counted(images, mask), ((0, 0), (r, r), (0, 0)))

    def strip(features: Array, near: Array) -> Array:
        """The means of all images side by side."""
        weights = kernels.head(features)
        if weights.shape[-1] != n * window**2:
            raise ValueError(
                f"{n} images and windows of {window} need {n * window**2} weights a "
                f"pixel, got {weights.shape[-1]}"
            )
        # An image's channels and the mask.
        own = [jnp.r_[k * c : (k + 1) * c, n * c] for k in range(n)]
        shares = jnp.split(weights, n, axis=-1)
        pairs = zip(own, shares, strict=True)
        sums = [_taps(near[..., i], share, window) for i, share in pairs]
        return jnp.concatenate([_mean(s) for s in sums], axis=-1)

    mean = map_rows(strip, [(kernels.features, kernels.reach), (both, r)])
    return jnp.stack(jnp.split(mean, n, axis=-1))


def _counted(images: Iterable[Image], mask: Mask | None) -> Array:
    """Images side by side, 0 where a pixel takes no part, and 1 where it does."""
    images = list(images)
    ones = jnp.ones_like(images[0][..., :1])
    if mask is None:
        return jnp.concatenate([*images, ones], axis=-1)
    some = [jnp.where(mask, image, 0.0) for image in images]
    return jnp.concatenate([*some, mask.astype(ones.dtype)], axis=-1)


def _taps(
    padded: Float[Array, "_ _ c"], weights: Float[Array, "h w _"], window: int
) -> Image:
    """Weighted sums of values with w // 2 more pixels on every side, [H,W,C]."""
    h, w, _ = weights.shape
    rows = jnp.moveaxis(weights.reshape(h, w, window, window), 2, 0)

    @jax.checkpoint
    def add_row(total: Image, row: tuple[Array, Array]) -> tuple[Image, None]:
        number, share = row
        strip = lax.dynamic_slice_in_dim(padded, number, h, axis=0)
        for column in range(window):
            near = lax.slice_in_dim(strip, column, column + w, axis=1)
            total = total + share[..., column : column + 1] * near
        return total, None

    start = jnp.zeros((h, w, padded.shape[-1]), padded.dtype)
    # Rows of weights as what is scanned over: sliced from all of them inside the loop,
    # each turn's derivative would be added to an array of all.
    return lax.scan(add_row, start, (jnp.arange(window), rows))[0]


def _mean(sums: Float[Array, "h w _"]) -> Float[Array, "h w _"]:
    """Sums, the last of which is that of the weights, as means."""
    total, weight = sums[..., :-1], sums[..., -1:]
    weight = jnp.broadcast_to(weight, total.shape)
    return divide(total, weight, where=weight > 0)
