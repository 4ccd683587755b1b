"""What a renderer hands over: one frame with its buffers, halves and statistics.

A `Frame` stores each quantity once, as K independent sub-buffers on the first axis
(disjoint samples, equally many), and derives the rest: the full image is their mean,
the half buffers are the means of the first and the last K/2. Halves are frames
themselves, so with K = 4 a combiner of halves can be judged by halves again. K = 1 is a
frame too; what needs halves then says so.

Everything is an array, so a frame is a pytree: it jits, vmaps and differentiates. Where
it came from is not part of it; `exr.read_provenance` tells.

Units: colour, biased images and reference are linear scene-referred radiance; variance
is of the mean, squared radiance; albedo, visibility in [0, 1]; normals of unit length
or 0; depth a distance, 0 where there is nothing.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jscomb.numerics.exposure import exposure
from jscomb.numerics.guards import finite
from jscomb.typing import Image, Mask, Scalar, Variance

CHANNELS = {"albedo": 3, "normal": 3, "depth": 1, "visibility": 1}


class Buffers(NamedTuple):
    """Sub-buffers as a renderer writes them, [K,H,W,C] each.

    Attributes:
        color: radiance of each sub-buffer, [K,H,W,C].
        variance: of the mean of that sub-buffer, [K,H,W,C]; None if not known.
        albedo: [K,H,W,3]; this and the other features may be None, or have one
            sub-buffer that all share.
        normal: [K,H,W,3].
        depth: [K,H,W,1].
        visibility: unoccluded fraction of emitter samples, [K,H,W,1].
    """

    color: Float[Array, "k h w c"]
    variance: Float[Array, "k h w c"] | None = None
    albedo: Float[Array, "_ h w 3"] | None = None
    normal: Float[Array, "_ h w 3"] | None = None
    depth: Float[Array, "_ h w 1"] | None = None
    visibility: Float[Array, "_ h w 1"] | None = None


class Biased(NamedTuple):
    """A biased image of a frame: denoised, photon mapped, ...

    Attributes:
        full: made from the full frame, radiance, [H,W,C].
        halves: made from each half alone, [2,H,W,C]; None if there are none.
    """

    full: Image
    halves: Float[Array, "2 h w c"] | None = None


class Reference(NamedTuple):
    """A much better rendering, for measuring only.

    Attributes:
        image: mean of its two halves, radiance, [H,W,C].
        half_difference: half a minus half b, to correct errors for the reference's
            own noise, [H,W,C]; None if not known.
    """

    image: Image
    half_difference: Image | None = None


class Frame(NamedTuple):
    """One rendered frame; build it with `make_frame`, which checks it.

    Attributes:
        buffers: the stored sub-buffers.
        samples: samples a pixel of the full frame; None if not known.
        biased: biased images by name; not to be changed, see `with_biased`.
        reference: None if there is none.
    """

    buffers: Buffers
    samples: Scalar | None
    biased: dict[str, Biased]
    reference: Reference | None

    @property
    def sub_buffers(self) -> int:
        """K, the number of independent sub-buffers."""
        return self.buffers.color.shape[0]

    @property
    def color(self) -> Image:
        """The unbiased image, mean of all sub-buffers, [H,W,C]."""
        return jnp.mean(self.buffers.color, axis=0)

    @property
    def variance(self) -> Variance:
        """Variance of the mean `color`, [H,W,C].

        From the renderer's own variances where it wrote them, else from the spread of
        the sub-buffers: unbiased, but with K-1 degrees of freedom very noisy.

        Raises:
            ValueError: if there is neither.
        """
        k = self.sub_buffers
        if self.buffers.variance is not None:
            return jnp.mean(self.buffers.variance, axis=0) / k
        if k < 2:
            raise ValueError(
                "this frame has neither variance nor sub-buffers to estimate it from"
            )
        return jnp.var(self.buffers.color, axis=0, ddof=1) / k

    @property
    def albedo(self) -> Image | None:
        """Mean albedo, [H,W,3], or None."""
        return _mean(self.buffers.albedo)

    @property
    def normal(self) -> Image | None:
        """Mean normal, [H,W,3], or None."""
        return _mean(self.buffers.normal)

    @property
    def depth(self) -> Image | None:
        """Mean depth, [H,W,1], or None."""
        return _mean(self.buffers.depth)

    @property
    def visibility(self) -> Image | None:
        """Mean visibility, [H,W,1], or None."""
        return _mean(self.buffers.visibility)

    def halves(self) -> tuple["Frame", "Frame"]:
        """The two half frames, of disjoint samples; independent of each other.

        Returns:
            frames of K/2 sub-buffers each, with the biased images made from that half
            (those without halves are left out), without reference.

        Raises:
            ValueError: if the frame has no sub-buffers.
        """
        k = self.sub_buffers
        if k < 2:
            raise ValueError(
                "this frame has no sub-buffers: half buffers need at least 2, got 1"
            )

        def half(number: int) -> Frame:
            return Frame(
                jax.tree.map(lambda buffer: _half(buffer, number), self.buffers),
                samples=None if self.samples is None else self.samples / 2,
                biased={
                    name: Biased(image.halves[number])
                    for name, image in self.biased.items()
                    if image.halves is not None
                },
                reference=None,
            )

        return half(0), half(1)

    def merged(self, sub_buffers: int) -> "Frame":
        """The same frame with fewer sub-buffers, neighbours averaged.

        Args:
            sub_buffers: how many to keep, 1 or even; divides the present number.

        Returns:
            the frame; its full images are the same to rounding.

        Raises:
            ValueError: if the present number cannot be merged into that many.
        """
        k = self.sub_buffers
        kept = sub_buffers == 1 or (sub_buffers > 1 and sub_buffers % 2 == 0)
        if not kept or k % sub_buffers:
            raise ValueError(f"{k} sub-buffers cannot be merged into {sub_buffers}")

        def merge(buffer: Array) -> Array:
            if len(buffer) == 1:
                return buffer
            return jnp.mean(buffer.reshape(sub_buffers, -1, *buffer.shape[1:]), axis=1)

        merged = jax.tree.map(merge, self.buffers)
        if merged.variance is not None:  # of a mean of k / sub_buffers
            scale = sub_buffers / k
            merged = merged._replace(variance=merged.variance * scale)
        return self._replace(buffers=merged)

    @property
    def valid(self) -> Mask:
        """Pixels that are finite in every buffer and biased image, [H,W,1]."""
        stored = [b for b in self.buffers if b is not None]
        stored += [h for i in self.biased.values() for h in i if h is not None]
        images = [i for b in stored for i in (b if b.ndim == 4 else b[None])]
        return finite(*images)

    @property
    def exposure(self) -> Scalar:
        """A radiance typical of the frame: the median of its positive luminances.

        Robust against fireflies and black backgrounds; 1 for a frame that is all
        black. Divide by it (`scaled`) before a method with absolute constants.
        """
        return exposure(self.color)

    def scaled(self, factor: Scalar | float) -> "Frame":
        """The frame with all radiance multiplied by `factor`, variances by its square.

        Args:
            factor: positive, for example 1 / `exposure`.

        Returns:
            the frame; features are unchanged.
        """
        color, variance, *features = self.buffers
        if variance is not None:
            variance = variance * jnp.square(factor)
        scale = lambda image: image * factor
        biased = jax.tree.map(scale, self.biased)
        reference = jax.tree.map(scale, self.reference)
        buffers = Buffers(color * factor, variance, *features)
        return self._replace(buffers=buffers, biased=biased, reference=reference)

    def with_biased(self, name: str, image: Biased | ArrayLike) -> "Frame":
        """The frame with one more biased image.

        Args:
            name: to call it by.
            image: the image of the full frame [H,W,C], or with that of the halves.

        Returns:
            a new frame; this one is unchanged.

        Raises:
            ValueError: if the shape is not the colour's.
        """
        return self._replace(
            biased=self.biased | {name: _checked_biased(name, image, self.color.shape)}
        )


def make_frame(
    color: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    depth: ArrayLike | None = None,
    visibility: ArrayLike | None = None,
    samples: float | int | None = None,
    biased: Mapping[str, Biased | ArrayLike] | None = None,
    reference: Reference | ArrayLike | None = None,
) -> Frame:
    """Build a frame and check every shape, once.

    Args:
        color: radiance, [K,H,W,C] sub-buffers, or one image [H,W,C]. K is 1 or even.
        variance: of the mean of each sub-buffer, [K,H,W,C]; or one image [H,W,C], the
            variance of the mean of all of them.
        albedo: [K,H,W,3] or [H,W,3]; this and the other features are optional, and one
            image is shared by all sub-buffers.
        normal: [K,H,W,3] or [H,W,3].
        depth: [K,H,W,1] or [H,W,1].
        visibility: [K,H,W,1] or [H,W,1].
        samples: samples a pixel of the full frame, positive.
        biased: biased images by name, [H,W,C] each or `Biased`.
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
        _expect("variance", variance, [(k, *shape)])
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
        biased={n: _checked_biased(n, i, full) for n, i in (biased or {}).items()},
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
    _expect("reference", image, [shape])
    if difference is not None:
        _expect("half_difference", difference, [shape])
    return Reference(image, difference)


def _mean(buffer: Array | None) -> Image | None:
    """Mean over the sub-buffers of an optional buffer."""
    return None if buffer is None else jnp.mean(buffer, axis=0)


def _half(buffer: Array, half: int) -> Array:
    """The first or last half of the sub-buffers; a single one is shared."""
    if len(buffer) == 1:
        return buffer
    middle = len(buffer) // 2
    return buffer[:middle] if half == 0 else buffer[middle:]


def _stacked(name: str, buffer: ArrayLike) -> Array:
    """A buffer with its axis of sub-buffers."""
    array = jnp.asarray(buffer)
    if array.ndim not in (3, 4) or array.size == 0:
        raise ValueError(
            f"{name} must have shape [H,W,C] or [K,H,W,C] and at least one pixel, "
            f"got {array.shape}"
        )
    return array if array.ndim == 4 else array[None]


def _expect(name: str, array: Array, shapes: list[tuple[int, ...]]) -> None:
    """Raise unless the array has one of the shapes."""
    if array.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {array.shape}, expected {wanted}")


def _checked_feature(name: str, feature: ArrayLike, color: tuple[int, ...]) -> Array:
    """A feature as large as the colour, with as many sub-buffers or one."""
    k, height, width, _ = color
    stacked = _stacked(name, feature)
    size = (height, width, CHANNELS[name])
    _expect(name, stacked, [(count, *size) for count in sorted({1, k})])
    return stacked


def _checked_biased(
    name: str, image: Biased | ArrayLike, shape: tuple[int, ...]
) -> Biased:
    """A biased image of the colour's shape."""
    given = image if isinstance(image, Biased) else Biased(jnp.asarray(image))
    full, halves = (None if i is None else jnp.asarray(i) for i in given)
    assert full is not None
    _expect(f"biased image {name!r}", full, [shape])
    if halves is not None:
        _expect(f"biased image {name!r} of halves", halves, [(2, *shape)])
    return Biased(full, halves)
