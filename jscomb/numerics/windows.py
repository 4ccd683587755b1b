"""Sums, means and extrema over square windows that are clipped to the image.

The window of pixel c is the w-by-w square about c, cut off at the border: never
reflected, never wrapped, because a reflected pixel is not a new sample. So the count
p_c of its pixels varies, and any image of at least 1x1 works, also one smaller than the
window.

Sums are made of additions of the window's own pixels, separably where all windows have
the same weights. Running differences (integral images) are never used: one firefly of
1e6 would erase the float32 digits of every later pixel in its row. Columns are slid by
doubling (sums over 1, 2, 4, ... pixels, put together by the bits of w), the fastest
form on a CPU; rows by
`lax.reduce_window`, which an image sharded by rows turns into one exchange of halos
(two collective permutes, where doubling needs twelve); for wide windows twice, which
takes less work. Extrema double along both axes:
`reduce_window` is many times slower on a CPU. Gaussian weights have no such form, nor
have those of `kernels`, which differ from pixel to pixel: sharded by rows they exchange
pixels once for every row of the window.

A `mask` names the pixels that take part; what the others hold is never looked at, so it
may be NaN.
"""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jscomb.numerics.guards import divide
from jscomb.typing import Image, Mask

_FEW = 15  # rows that are added in one step


def window_sum(image: Image, window: int, *, mask: Mask | None = None) -> Image:
    """Sum over the window of each pixel.

    Args:
        image: values of any unit, shape [H,W,C].
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the sums, in the unit of `image`, shape [H,W,C].

    Raises:
        ValueError: if `window` is even or less than one.

    Example:
        >>> import jax.numpy as jnp
        >>> print(window_sum(jnp.ones((2, 3, 1)), 3)[..., 0])
        [[4. 6. 4.]
         [4. 6. 4.]]
    """
    image = _only(image, mask, 0.0)
    columns = _add_columns(image, check_window(window))
    return _add_rows(columns, window)


def window_mean(
    image: Image, window: int, *, mask: Mask | None = None, sigma: float | None = None
) -> Image:
    """Mean over the window of each pixel, equal or Gaussian weights.

    Args:
        image: values of any unit, shape [H,W,C].
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.
        sigma: standard deviation in pixels of Gaussian weights; None for equal ones.

    Returns:
        the means, in the unit of `image`, shape [H,W,C]; 0 where no pixel of the
        window takes part.

    Raises:
        ValueError: if `window` is even or less than one, or `sigma` is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> print(window_mean(jnp.arange(3.0).reshape(1, 3, 1), 3)[..., 0])
        [[0.5 1.  1.5]]
    """
    image, ones = _only(image, mask, 0.0), _ones(image, mask)
    if sigma is None:
        total, weight = window_sum(image, window), window_sum(ones, window)
    else:
        kernel = _gaussian(window, sigma)
        total, weight = (separable_sum(i, kernel) for i in (image, ones))
    weight = jnp.broadcast_to(weight, total.shape)
    return divide(total, weight, where=weight > 0)


def window_min(image: Image, window: int, *, mask: Mask | None = None) -> Image:
    """Least value in the window of each pixel.

    Args:
        image: values of any unit, shape [H,W,C].
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the minima, shape [H,W,C]; infinite where no pixel of the window takes part.

    Raises:
        ValueError: if `window` is even or less than one.

    Example:
        >>> import jax.numpy as jnp
        >>> print(window_min(jnp.arange(4.0).reshape(1, 4, 1), 3)[..., 0])
        [[0. 0. 1. 2.]]
    """
    return _extremum(_only(image, mask, np.inf), window, lax.min, np.inf)


def window_max(image: Image, window: int, *, mask: Mask | None = None) -> Image:
    """Greatest value in the window of each pixel.

    Args:
        image: values of any unit, shape [H,W,C].
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the maxima, shape [H,W,C]; minus infinity where no pixel of the window takes
        part.

    Raises:
        ValueError: if `window` is even or less than one.

    Example:
        >>> import jax.numpy as jnp
        >>> print(window_max(jnp.arange(4.0).reshape(1, 4, 1), 3)[..., 0])
        [[1. 2. 3. 3.]]
    """
    return _extremum(_only(image, mask, -np.inf), window, lax.max, -np.inf)


def at_window_max(
    by: Float[Array, "h w 1"], image: Image, window: int, *, mask: Mask | None = None
) -> Image:
    """Values of an image at the pixel of each window where another is greatest.

    Args:
        by: what is greatest there, finite, shape [H,W,1].
        image: values of any unit, shape [H,W,C].
        window: width w of the window in pixels, odd.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the values, of one pixel for all channels, shape [H,W,C]; 0 where no pixel of
        the window takes part.

    Raises:
        ValueError: if `window` is even or less than one.

    Example:
        >>> import jax.numpy as jnp
        >>> size = jnp.array([3.0, 1.0, 2.0, 0.0]).reshape(1, 4, 1)
        >>> print(at_window_max(size, -size, 3)[..., 0])
        [[-3. -3. -2. -2.]]
    """

    def pick(near: Image, far: Image) -> Image:
        return jnp.where(near[..., :1] >= far[..., :1], near, far)

    both = jnp.concatenate([_only(by, mask, -np.inf), _only(image, mask, 0.0)], axis=-1)
    best = _extremum(both, window, pick, -np.inf)
    return jnp.where(best[..., :1] > -np.inf, best[..., 1:], 0.0)


def separable_sum(
    image: Image, kernel: Float[ArrayLike, " taps"], *, mask: Mask | None = None
) -> Image:
    """Sum over the window with weights kernel[row] * kernel[column].

    Args:
        image: values of any unit, shape [H,W,C].
        kernel: weights along either axis, an odd number of them.
        mask: pixels that take part, shape [H,W,1]; None for all.

    Returns:
        the sums, in the unit of `image`, shape [H,W,C].

    Raises:
        ValueError: if the kernel's length is even.

    Example:
        >>> kernel = jnp.array([1.0, 2.0, 1.0])
        >>> print(separable_sum(jnp.ones((2, 3, 1)), kernel)[..., 0])
        [[ 9. 12.  9.]
         [ 9. 12.  9.]]
    """
    kernel = jnp.asarray(kernel, image.dtype)
    r = check_window(len(kernel)) // 2
    image = _only(image, mask, 0.0)
    for axis in (1, 0):
        size = image.shape[axis]
        ends = [(r, r) if a == axis else (0, 0) for a in range(3)]
        padded = jnp.pad(image, ends)
        image = sum(
            weight * lax.slice_in_dim(padded, k, k + size, axis=axis)
            for k, weight in enumerate(kernel)
        )  # type: ignore[assignment]
    return image


def window_count(
    shape: tuple[int, ...], window: int, *, dtype: jnp.dtype | type = jnp.float32
) -> Float[Array, "h w 1"]:
    """Number p_c of pixels in the clipped window of each pixel; costs no sum.

    Args:
        shape: of the image, at least (H, W).
        window: width w of the window in pixels, odd.
        dtype: of the result.

    Returns:
        the counts, shape [H,W,1].

    Raises:
        ValueError: if `window` is even or less than one.

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


def check_window(window: int) -> int:
    """The window if it is odd and positive.

    Args:
        window: width in pixels.

    Returns:
        the same width.

    Raises:
        ValueError: otherwise; raised while tracing.

    Example:
        >>> check_window(4)
        Traceback (most recent call last):
            ...
        ValueError: window must be odd and positive, got 4
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window must be odd and positive, got {window}")
    return window


def reach_of(*windows: int) -> int:
    """Return how far a chain of windows sees.

    Args:
        windows: widths w in pixels, odd; each is applied to the result of the one
            before.

    Returns:
        the sum of w // 2, in pixels.

    Raises:
        ValueError: if a width is even or less than one.

    Example:
        >>> reach_of(21, 7)
        13
    """
    return sum(check_window(window) // 2 for window in windows)


def _only(image: Image, mask: Mask | None, neutral: float) -> Image:
    """The image with `neutral` where a pixel takes no part."""
    return image if mask is None else jnp.where(mask, image, neutral)


def _ones(image: Image, mask: Mask | None) -> Float[Array, "h w 1"]:
    """One for each pixel that takes part."""
    ones = jnp.ones_like(image[..., :1])
    return ones if mask is None else mask.astype(image.dtype)


def _add_columns(image: Image, window: int) -> Image:
    """Sum over the w columns about each pixel by doubling."""
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

    Many rows in two steps: of runs of m rows, and of q runs, m apart.
    """
    r, height = window // 2, image.shape[0]
    # A concrete initial value, else jit loses the reverse derivative.
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


def _extremum(image: Image, window: int, pick: Callable, neutral: float) -> Image:
    """Least or greatest by doubling; two runs may overlap, unlike those of a sum."""
    r = check_window(window) // 2
    for axis in (1, 0):
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


def _gaussian(window: int, sigma: float) -> np.ndarray:
    """Gaussian weights along one axis, of total one."""
    r = check_window(window) // 2
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    weights = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma) ** 2)
    return weights / weights.sum()
