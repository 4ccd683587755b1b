"""Sums, means and extrema over square windows that are clipped to the image.

The window of a pixel is the w-by-w square about it, w odd, cut off at the border: never
reflected, never wrapped, because a reflected pixel is not a new sample. So the count of
its pixels varies, and any image of at least 1x1 works, also one smaller than the
window. Layout: images [H,W,C] of any unit, which is that of the result. A `mask`
[H,W,1] selects pixels, None all; the others are excluded, and may be NaN.

Sums add the window's own pixels, separably where all windows have the same weights, not
by running differences (integral images): one firefly of 1e6 would erase the float32
digits of every later pixel in its row. Columns are summed by doubling (1, 2, 4, ...
pixels, combined by the bits of w), the fastest form on a CPU. Rows are summed by
`lax.reduce_window`, where an image sharded by rows exchanges halos once, not twelve
times; for wide windows twice. Extrema double along both axes: `reduce_window` of them
is many times slower on a CPU. Gaussian weights and those of `kernels` double in no way.
"""

import functools
import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from jscomb.numerics.guards import check_image, check_static, weighted_ratio
from jscomb.numerics.linear import with_transpose
from jscomb.numerics.tiles import in_memory
from jscomb.typing import Image, Mask

__all__ = [
    "at_window_max",
    "block_sum",
    "check_window",
    "gaussian_kernel",
    "reach_of",
    "separable_sum",
    "window_count",
    "window_max",
    "window_mean",
    "window_min",
    "window_sum",
]

_FEW = 15  # rows to add in one step


def window_sum(image: Image, window: int, *, mask: Mask | None = None) -> Image:
    """Sum over the window of each pixel.

    Args:
        image: shape [H,W,C].
        window: width w in pixels, odd.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the sums, shape [H,W,C].

    Raises:
        ValueError: if `window` is even or below one.

    Example:
        >>> print(window_sum(jnp.ones((2, 3, 1)), 3)[..., 0])
        [[4. 6. 4.]
         [4. 6. 4.]]
    """
    check_window(window)
    total = lambda image: _add_rows(_add_columns(image, window), window)
    # Its own transpose: a pixel is in the windows of those that are in its own.
    return with_transpose(total, total, _only(image, mask, 0.0))


def window_mean(
    image: Image, window: int, *, mask: Mask | None = None, sigma: float | None = None
) -> Image:
    """Average over the window of each pixel, with equal or Gaussian weights.

    Args:
        image: shape [H,W,C].
        window: width w in pixels, odd.
        mask: pixels to include, shape [H,W,1]; None for all.
        sigma: standard deviation in pixels of Gaussian weights; None for equal ones.

    Returns:
        the means, shape [H,W,C]; 0 where the window includes no pixel.

    Raises:
        ValueError: if `window` is even or below one, or `sigma` is not positive.

    Example:
        >>> print(window_mean(jnp.arange(3.0).reshape(1, 3, 1), 3)[..., 0])
        [[0.5 1.  1.5]]
    """
    image, ones = _only(image, mask, 0.0), _ones(image, mask)
    if sigma is None:
        total, weight = window_sum(image, window), window_sum(ones, window)
    else:
        total = separable_sum(image, kernel := gaussian_kernel(window, sigma))
        (weight,) = in_memory(separable_sum(ones, kernel))  # once for all channels
    return weighted_ratio(total, weight)


def gaussian_kernel(window: int, sigma: float) -> np.ndarray:
    """Return Gaussian weights along one axis, for `separable_sum`.

    Args:
        window: their number, odd.
        sigma: standard deviation in pixels.

    Returns:
        the weights, of sum one, shape [w].

    Raises:
        ValueError: if `window` is even or `sigma` not positive.

    Example:
        >>> print(gaussian_kernel(3, 1.0).round(3))
        [0.274 0.452 0.274]
    """
    r = check_window(window) // 2
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    weights = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma) ** 2)
    return weights / weights.sum()


def block_sum(image: Image, block: int) -> Float[Array, "rows columns _"]:
    """Return the sums over square blocks.

    Args:
        image: shape [H,W,C].
        block: width B of a block in pixels.

    Returns:
        the sums, shape [H/B,W/B,C], rounded up: the last block of a row or column has
        the pixels that are left.

    Example:
        >>> print(block_sum(jnp.ones((2, 5, 1)), 2)[..., 0])
        [[4. 4. 2.]]
    """
    if block == 1:
        return image
    height, width, channels = image.shape
    below, right = -height % block, -width % block
    padded = jnp.pad(image, ((0, below), (0, right), (0, 0)))
    rows, columns = (height + below) // block, (width + right) // block
    split = padded.reshape(rows, block, columns, block, channels)
    return jnp.sum(split, axis=(1, 3))


def window_min(image: Image, window: int, *, mask: Mask | None = None) -> Image:
    """Return the minimum over the window of each pixel.

    Args:
        image: shape [H,W,C].
        window: width w in pixels, odd.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the minima, shape [H,W,C]; infinite where the window includes no pixel.

    Raises:
        ValueError: if `window` is even or below one.

    Example:
        >>> print(window_min(jnp.arange(4.0).reshape(1, 4, 1), 3)[..., 0])
        [[0. 0. 1. 2.]]
    """
    return _extremum(_only(image, mask, np.inf), window, lax.min, np.inf)


def window_max(image: Image, window: int, *, mask: Mask | None = None) -> Image:
    """Return the maximum over the window of each pixel.

    Args:
        image: shape [H,W,C].
        window: width w in pixels, odd.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the maxima, shape [H,W,C]; minus infinity where the window includes no pixel.

    Raises:
        ValueError: if `window` is even or below one.

    Example:
        >>> print(window_max(jnp.arange(4.0).reshape(1, 4, 1), 3)[..., 0])
        [[1. 2. 3. 3.]]
    """
    return _extremum(_only(image, mask, -np.inf), window, lax.max, -np.inf)


def at_window_max(
    by: Float[Array, "h w 1"], image: Image, window: int, *, mask: Mask | None = None
) -> Image:
    """Return an image's values where another is largest in the window of each pixel.

    Args:
        by: the other image, finite, shape [H,W,1].
        image: shape [H,W,C].
        window: width w in pixels, odd.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the values, all channels of one pixel, shape [H,W,C]; 0 where the window
        includes no pixel.

    Raises:
        ValueError: if `window` is even or below one.

    Example:
        >>> size = jnp.array([3.0, 1.0, 2.0, 0.0]).reshape(1, 4, 1)
        >>> print(at_window_max(size, -size, 3)[..., 0])
        [[-3. -3. -2. -2.]]
    """

    def pick(near: Array, far: Array) -> Array:
        return jnp.where(near[:1] >= far[:1], near, far)

    both = jnp.concatenate([_only(by, mask, -np.inf), _only(image, mask, 0.0)], axis=-1)
    # Planes, so that one comparison serves neighbours in memory.
    best = _extremum(jnp.moveaxis(both, -1, 0), window, pick, -np.inf, axes=(2, 1))
    return jnp.moveaxis(jnp.where(best[:1] > -np.inf, best[1:], 0.0), 0, -1)


def separable_sum(
    image: Image, kernel: Float[ArrayLike, " taps"], *, mask: Mask | None = None
) -> Image:
    """Sum over the window of each pixel with weights kernel[row] * kernel[column].

    Args:
        image: shape [H,W,C].
        kernel: weights along either axis, shape [w], w odd.
        mask: pixels to include, shape [H,W,1]; None for all.

    Returns:
        the sums, shape [H,W,C].

    Raises:
        ValueError: if the kernel's length is even.

    Example:
        >>> kernel = jnp.array([1.0, 2.0, 1.0])
        >>> print(separable_sum(jnp.ones((2, 3, 1)), kernel)[..., 0])
        [[ 9. 12.  9.]
         [ 9. 12.  9.]]
    """
    image = _only(image, mask, 0.0)
    if isinstance(kernel, Tracer):  # it may have a derivative
        return _separable(image, kernel)
    taps = np.asarray(kernel)
    of = lambda k: functools.partial(_separable, kernel=jnp.asarray(k, image.dtype))
    total, turned = of(taps), of(taps[::-1])
    even = (taps == taps[::-1]).all()
    return with_transpose(total, total if even else turned, image)


def window_count(
    shape: tuple[int, ...], window: int, *, dtype: jnp.dtype | type = jnp.float32
) -> Float[Array, "h w 1"]:
    """Count the pixels in the clipped window of each pixel, without a sum.

    Args:
        shape: of the image, (H, W, ...).
        window: width w in pixels, odd.
        dtype: of the result.

    Returns:
        the counts, shape [H,W,1].

    Raises:
        ValueError: if `window` is even or below one.

    Example:
        >>> print(window_count((2, 3), 3)[..., 0])
        [[4. 6. 4.]
         [4. 6. 4.]]
    """
    r = check_window(window) // 2

    def along(n: int) -> np.ndarray:
        at = np.arange(n)
        return np.minimum(at + r, n - 1) - np.maximum(at - r, 0) + 1

    return jnp.asarray(np.outer(along(shape[0]), along(shape[1]))[..., None], dtype)


def reach_of(*windows: int) -> int:
    """Return how far windows see that are applied one after another.

    Args:
        windows: widths in pixels, odd.

    Returns:
        pixels to either side, the sum of w // 2.

    Raises:
        ValueError: if a width is even or below one.

    Example:
        >>> reach_of(7, 7, 19)
        15
    """
    return sum(check_window(window) // 2 for window in windows)


def check_window(window: int) -> int:
    """Return the window's width; raise unless it is odd and positive.

    Args:
        window: width in pixels.

    Returns:
        the same width.

    Raises:
        ValueError: while tracing; also for a window that is traced itself.

    Example:
        >>> check_window(4)
        Traceback (most recent call last):
            ...
        ValueError: window must be odd and positive, got 4
    """
    check_static(window=window)
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window must be odd and positive, got {window}")
    return window


def _only(image: Image, mask: Mask | None, neutral: float) -> Image:
    """Return the image with `neutral` at excluded pixels."""
    check_image(image=image)
    return image if mask is None else jnp.where(mask, image, neutral)


def _ones(image: Image, mask: Mask | None) -> Float[Array, "h w 1"]:
    """Return 1 at included pixels, 0 elsewhere."""
    ones = jnp.ones_like(image[..., :1])
    return ones if mask is None else mask.astype(image.dtype)


def _separable(image: Image, kernel: Float[Array, " taps"]) -> Image:
    """Sum over the columns, then the rows about each pixel, with weights."""
    r = check_window(len(kernel)) // 2
    for axis in (1, 0):
        size = image.shape[axis]
        ends = [(r, r) if a == axis else (0, 0) for a in range(3)]
        padded = jnp.pad(image, ends)
        image = sum(
            weight * lax.slice_in_dim(padded, k, k + size, axis=axis)
            for k, weight in enumerate(kernel)
        )  # type: ignore[assignment]
    return image


def _add_columns(image: Image, window: int) -> Image:
    """Sum over the w columns about each pixel, by doubling."""
    r, width = window // 2, image.shape[1]
    span, run = 1, jnp.pad(image, ((0, 0), (r, r), (0, 0)))
    total, start = None, 0  # over columns [0, start) from the window's left edge
    while span <= window:
        if window & span:
            part = run[:, start : start + width]
            total = part if total is None else total + part
            start += span
        if 2 * span <= window:
            run = run[:, :-span] + run[:, span:]
        span *= 2
    assert total is not None
    return total


def _add_rows(image: Image, window: int) -> Image:
    """Sum over the w rows about each pixel.

    Many rows in two steps: over runs of m rows, then over q runs, m apart.
    """
    r, height = window // 2, image.shape[0]
    # Concrete: with a traced initial value jit loses the reverse derivative.
    start = np.zeros((), image.dtype)

    def rows(image: Array, count: int, ends: tuple[int, int], apart: int = 1) -> Array:
        size, by, one = (count, 1, 1), (apart, 1, 1), (1, 1, 1)
        padding = (ends, (0, 0), (0, 0))
        return lax.reduce_window(image, start, lax.add, size, one, padding, None, by)

    if window <= _FEW:
        return rows(image, window, (r, r))
    m = math.isqrt(window)
    q, rest = divmod(window, m)
    runs = rows(image, m, (r, r))
    total = rows(runs, q, (0, 0), m)[:height]
    return total + rows(image, rest, (r, r))[-height:] if rest else total


def _extremum(
    image: Float[Array, "_ _ _"],
    window: int,
    pick: Callable,
    neutral: float,
    axes: tuple[int, int] = (1, 0),
) -> Float[Array, "_ _ _"]:
    """Reduce by doubling; two runs may overlap, unlike those of a sum."""
    r = check_window(window) // 2
    for axis in axes:
        ends = [(r, r) if a == axis else (0, 0) for a in range(3)]
        run, span = jnp.pad(image, ends, constant_values=neutral), 1
        while span < window:
            step = min(span, window - span)
            size = run.shape[axis] - step
            near, far = (
                lax.slice_in_dim(run, s, s + size, axis=axis) for s in (0, step)
            )
            run, span = pick(near, far), span + step
        image = run
    return image
