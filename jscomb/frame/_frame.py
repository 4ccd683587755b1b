"""A frame, its buffers, estimates and reference."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jscomb.numerics.guards import finite
from jscomb.numerics.luminance import median_luminance
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image, Mask, Scalar, Variance

CHANNELS = {"albedo": 3, "normal": 3, "depth": 1, "visibility": 1}


class Buffers(NamedTuple):
    """Sub-buffers as a renderer writes them, [K,H,W,C] each.

    Attributes:
        color: radiance of each sub-buffer, [K,H,W,C].
        variance: of the mean of that sub-buffer, [K,H,W,C]; None if unknown.
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


class Estimate(NamedTuple):
    """An image of a frame: denoised, photon mapped, combined, ...

    Attributes:
        image: made from the full frame, radiance, [H,W,C].
        halves: made from each half alone, [2,H,W,C]; None if they cannot be made.
    """

    image: Image
    halves: Float[Array, "2 h w c"] | None = None

    def half(self, number: int) -> "Estimate":
        """Return the estimate of half 0 or 1, without halves of its own."""
        if self.halves is None:
            raise ValueError("this estimate has no halves")
        return Estimate(self.halves[number])

    def scaled(self, factor: Scalar | float) -> "Estimate":
        """Return the estimate with its radiance multiplied by a positive factor."""
        return jax.tree.map(lambda image: image * factor, self)


class Reference(NamedTuple):
    """A much better rendering, for measuring only.

    Attributes:
        image: mean of its two halves, radiance, [H,W,C].
        half_difference: half a minus half b, to correct errors for the reference's
            own noise, [H,W,C]; None if unknown.
    """

    image: Image
    half_difference: Image | None = None


class Frame(NamedTuple):
    """One rendered frame; build it with `make_frame`, which checks it.

    Attributes:
        buffers: the stored sub-buffers.
        samples: samples a pixel of the full frame; None if unknown.
        estimates: estimates by name; not to be changed, see `with_estimate`.
        reference: None if there is none.
        unit: the radiance that a normalised frame was divided by; None for a frame in
            its renderer's units.
    """

    buffers: Buffers
    samples: Scalar | None
    estimates: dict[str, Estimate]
    reference: Reference | None
    unit: Scalar | None = None

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
        """Return the two half frames, of disjoint samples, independent of each other.

        Returns:
            frames of K/2 sub-buffers each, with the estimates made from that half
            (those without halves are excluded), without reference; normalised by the
            full frame's unit if that is normalised.

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
                estimates={
                    name: estimate.half(number)
                    for name, estimate in self.estimates.items()
                    if estimate.halves is not None
                },
                reference=None,
                unit=self.unit,
            )

        return half(0), half(1)

    def merged(self, sub_buffers: int) -> "Frame":
        """Return the same frame with fewer sub-buffers, neighbours averaged.

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
        """Pixels that are finite in every buffer and estimate, [H,W,1]."""
        stored = [b for b in self.buffers if b is not None]
        stored += jax.tree.leaves(self.estimates)
        images = [i for b in stored for i in (b if b.ndim == 4 else b[None])]
        return finite(*images)

    @property
    def median_luminance(self) -> Scalar:
        """The median of the colour's positive luminances, linear radiance.

        Robust against fireflies and black backgrounds; 1 for a frame that is all
        black.
        """
        return compiled(median_luminance)(self.color)

    def normalised(self, unit: Scalar | float | None = None) -> "Frame":
        """Return the frame with radiance divided by its median luminance.

        Args:
            unit: linear radiance, positive, to divide by instead: frames that are to be
                compared share one.

        Returns:
            the frame, with `unit` set; itself if it is normalised already. Multiply
            what is made of it by `unit` (`Estimate.scaled`).

        Raises:
            ValueError: if a unit is given for a frame that is normalised already.
        """
        if self.unit is not None:
            if unit is not None:
                raise ValueError("this frame is normalised already")
            return self
        return compiled(_normalised)(self, unit)

    def scaled(self, factor: Scalar | float) -> "Frame":
        """Return the frame with radiance multiplied by a factor.

        Args:
            factor: positive.

        Returns:
            the frame, variances multiplied by the factor's square, features unchanged;
            no longer normalised.
        """
        color, variance, *features = self.buffers
        if variance is not None:
            # Twice: the square may leave the range of float32.
            variance = variance * factor * factor
        images = self.estimates, self.reference
        estimates, reference = jax.tree.map(lambda image: image * factor, images)
        buffers = Buffers(color * factor, variance, *features)
        return Frame(buffers, self.samples, estimates, reference)

    def with_estimate(self, name: str, estimate: Estimate | ArrayLike) -> "Frame":
        """Return the frame with one more estimate.

        Args:
            name: of the estimate; replaces one of the same name.
            estimate: the image of the full frame [H,W,C], or with that of the halves.

        Returns:
            a new frame; this one is unchanged.

        Raises:
            ValueError: if the shape is not the colour's.
        """
        checked = checked_estimate(name, estimate, self.color.shape)
        return self._replace(estimates=self.estimates | {name: checked})

    def require(self, who: str, needs: Any) -> None:
        """Raise unless the frame has what a method needs.

        Args:
            who: the method's name.
            needs: what it needs, a `Needs`.

        Raises:
            ValueError: names the method, what is missing and how to get it.
            ImportError: the same for a package.
        """
        if missing := needs.missing(self):
            kind = ImportError if missing == needs.missing_package() else ValueError
            raise kind(f"{who} needs {missing}")


def _normalised(frame: Frame, unit: Scalar | float | None) -> Frame:
    """The frame in a unit, or in its median luminance."""
    divisor = frame.median_luminance if unit is None else jnp.asarray(unit)
    divisor = divisor.astype(frame.buffers.color.dtype)
    return frame.scaled(1 / divisor)._replace(unit=divisor)


def _mean(buffer: Array | None) -> Image | None:
    """Mean over the sub-buffers of an optional buffer."""
    return None if buffer is None else jnp.mean(buffer, axis=0)


def _half(buffer: Array, half: int) -> Array:
    """The first or last half of the sub-buffers; a single one is shared."""
    if len(buffer) == 1:
        return buffer
    middle = len(buffer) // 2
    return buffer[:middle] if half == 0 else buffer[middle:]


def expect(name: str, array: Array, shapes: list[tuple[int, ...]]) -> None:
    """Raise unless the array has one of the shapes."""
    if array.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {array.shape}, expected {wanted}")


def checked_estimate(
    name: str, estimate: Estimate | ArrayLike, shape: tuple[int, ...]
) -> Estimate:
    """An estimate of the colour's shape."""
    if not isinstance(estimate, Estimate):
        estimate = Estimate(jnp.asarray(estimate))
    image, halves = (None if i is None else jnp.asarray(i) for i in estimate)
    assert image is not None
    expect(f"estimate {name!r}", image, [shape])
    if halves is not None:
        expect(f"the halves of estimate {name!r}", halves, [(2, *shape)])
    return Estimate(image, halves)
