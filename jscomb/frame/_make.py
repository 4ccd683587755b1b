"""Build a frame from arrays, with every shape checked."""

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jscomb.frame._frame import (
    CHANNELS,
    Buffers,
    Estimate,
    Frame,
    Reference,
    checked_estimate,
    expect,
)

_BATCH = ": for a batch of frames map make_frame by jax.vmap"


def make_frame(
    color: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    depth: ArrayLike | None = None,
    visibility: ArrayLike | None = None,
    samples: float | int | None = None,
    estimates: Mapping[str, Estimate | ArrayLike] | None = None,
    reference: Reference | ArrayLike | None = None,
) -> Frame:
    """Build a frame and check every shape, once.

    Args:
        color: radiance, [K,H,W,C] sub-buffers, or one image [H,W,C]. K is 1 or even.
        variance: of the mean of each sub-buffer, [K,H,W,C]; or one image [H,W,C], the
            variance of the mean of all of them. One channel is that of each.
        albedo: [K,H,W,3] or [H,W,3]; this and the other features are optional, and one
            image is shared by all sub-buffers.
        normal: [K,H,W,3] or [H,W,3].
        depth: [K,H,W,1] or [H,W,1].
        visibility: [K,H,W,1] or [H,W,1].
        samples: samples a pixel of the full frame, positive.
        estimates: estimates by name, [H,W,C] each or `Estimate`.
        reference: [H,W,C] or `Reference`.

    Returns:
        the frame, its arrays on the default device.

    Raises:
        ValueError: names the buffer, the shape that was got and what was expected.

    Example:
        >>> frame = make_frame(jnp.ones((2, 4, 5, 3)), samples=64)
        >>> print(frame.color.shape, frame.halves()[0].samples)
        (4, 5, 3) 32.0
    """
    if samples is not None and not samples > 0:
        raise ValueError(f"samples must be positive, got {samples}")
    color = _stacked("color", color)
    k, *shape = color.shape
    if k > 1 and k % 2:
        raise ValueError(f"color must have 1 or an even number of sub-buffers, got {k}")
    if variance is not None:
        variance = jnp.asarray(variance)
        if variance.ndim == 3:
            variance = jnp.broadcast_to(k * variance, (k, *variance.shape))
        if variance.shape == (*color.shape[:-1], 1):
            variance = jnp.broadcast_to(variance, color.shape)
        expect("variance", variance, [(k, *shape)])
    given = {
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
        "visibility": visibility,
    }
    features = {
        name: _checked_feature(name, feature, color.shape)
        for name, feature in given.items()
        if feature is not None
    }
    full = tuple(shape)
    if reference is not None:
        reference = _checked_reference(reference, full)
    return Frame(
        Buffers(color, variance, **features),
        samples=None if samples is None else jnp.asarray(samples, color.dtype),
        estimates={
            n: checked_estimate(n, e, full) for n, e in (estimates or {}).items()
        },
        reference=reference,
    )


def _checked_reference(
    reference: Reference | ArrayLike, shape: tuple[int, ...]
) -> Reference:
    """A reference of the colour's shape."""
    if not isinstance(reference, Reference):
        reference = Reference(jnp.asarray(reference))
    image, difference = (None if i is None else jnp.asarray(i) for i in reference)
    assert image is not None
    expect("reference", image, [shape])
    if difference is not None:
        expect("half_difference", difference, [shape])
    return Reference(image, difference)


def _stacked(name: str, buffer: ArrayLike) -> Array:
    """A buffer with its axis of sub-buffers."""
    array = jnp.asarray(buffer)
    if array.ndim not in (3, 4) or array.size == 0:
        raise ValueError(
            f"{name} must have shape [H,W,C] or [K,H,W,C] and at least one pixel, "
            f"got {array.shape}" + _BATCH * (array.ndim == 5)
        )
    return array if array.ndim == 4 else array[None]


def _checked_feature(name: str, feature: ArrayLike, color: tuple[int, ...]) -> Array:
    """A feature as large as the colour, with as many sub-buffers or one."""
    k, height, width, _ = color
    stacked = _stacked(name, feature)
    size = (height, width, CHANNELS[name])
    expect(name, stacked, [(count, *size) for count in sorted({1, k})])
    return stacked
