"""A rendered frame with its buffers and halves, and the images estimated from it.

A `Frame` stores each quantity once, as K independent sub-buffers on the first axis
(disjoint samples, equally many), and derives the rest: the full image is their mean,
the half buffers are the means of the first and the last K/2. Halves are frames
themselves, so with K = 4 a combiner of halves can be judged by halves again. K = 1 is a
frame too; what needs halves raises an error there.

An `Estimate` is an image of a frame and the same image made from each half alone.
Whoever makes an image of a frame makes an `Estimate`: denoisers, combiners, networks,
files. So a combiner's result goes wherever a denoiser's goes, and every estimate is
judged the same way: by the half that it was not made from. `with_halves` makes one.

All are pytrees of arrays: they jit, vmap and differentiate. Where a frame came from is
not part of it; `exr.read_provenance` returns that.

Units: colour, estimates and reference are linear scene-referred radiance; variance is
of the mean, squared radiance; albedo and visibility are in [0, 1]; normals have unit
length or are 0; depth is a distance, 0 where there is nothing. A frame is *normalised*
when its radiance was divided by its median luminance (`Frame.normalised`). Networks and
regressions have absolute constants, so their functions of frames need that; the front
door `jscomb.combine` normalises once, and scales the result back once.
"""

import importlib.util
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jscomb.numerics.guards import finite
from jscomb.numerics.luminance import median_luminance
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
        return median_luminance(self.color)

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
        divisor = self.median_luminance if unit is None else jnp.asarray(unit)
        divisor = divisor.astype(self.buffers.color.dtype)
        return self.scaled(1 / divisor)._replace(unit=divisor)

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
        checked = _checked_estimate(name, estimate, self.color.shape)
        return self._replace(estimates=self.estimates | {name: checked})

    def require(self, who: str, needs: "Needs") -> None:
        """Raise unless the frame has what a method needs.

        Args:
            who: the method's name.
            needs: what it needs.

        Raises:
            ValueError: names the method, what is missing and how to get it.
            ImportError: likewise, if a package is missing.
        """
        if missing := needs.missing(self):
            kind = ImportError if needs.missing_package() else ValueError
            raise kind(f"{who} needs {missing}")


class Needs(NamedTuple):
    """What a denoiser or combiner needs of a frame.

    Attributes:
        variance: variances, or sub-buffers to estimate them from.
        halves: half buffers, and the variances of each if it needs variances.
        channels: of the colour; None for any number.
        features: names of features, such as albedo.
        normalised: radiance divided by the median luminance.
        extra: the extra of jscomb that installs a package it needs; None for none.
        package: that package's module.
    """

    variance: bool = False
    halves: bool = False
    channels: int | None = None
    features: tuple[str, ...] = ()
    normalised: bool = False
    extra: str | None = None
    package: str | None = None

    def package_of(self) -> dict[str, str | None]:
        """Return the package alone, to add to other needs by `_replace`."""
        return {"extra": self.extra, "package": self.package}

    def summary(self) -> str:
        """Return all needs in a few words; empty if there are none."""
        some = {
            "variance": self.variance,
            "half buffers": self.halves,
            f"{self.channels} channels": self.channels is not None,
            ", ".join(self.features): bool(self.features),
            f"extra `{self.extra}`": self.extra is not None,
        }
        return ", ".join(name for name, needed in some.items() if needed)

    def missing_package(self) -> str:
        """Return which package is missing and how to install it; empty if none."""
        if self.package is None or importlib.util.find_spec(self.package):
            return ""
        return f'the package {self.package}: pip install "jscomb[{self.extra}]"'

    def missing(self, frame: Frame) -> str:
        """Return what a frame lacks and how to get it, in one line; empty if nothing.

        Args:
            frame: the frame.

        Returns:
            the line, to follow "needs".
        """
        return self._missing(frame, frame.sub_buffers)

    def missing_for_halves(self, frame: Frame) -> str:
        """Return what the halves of a frame lack; empty if each half has enough.

        Args:
            frame: the full frame.

        Returns:
            the line, to follow "needs".
        """
        if frame.sub_buffers < 2:
            return "half buffers: render at least 2 sub-buffers (this frame has 1)"
        return self._missing(frame, frame.sub_buffers // 2)

    def _missing(self, frame: Frame, k: int) -> str:
        """What a frame, or a half of it, with `k` sub-buffers lacks."""
        total = frame.sub_buffers
        unknown = self.variance and frame.buffers.variance is None
        wanted = (2 if self.halves else 1) * (2 if unknown else 1)
        channels = frame.buffers.color.shape[-1]
        lacking = [f for f in self.features if getattr(frame.buffers, f) is None]
        if self.normalised and frame.unit is None:
            return "a normalised frame: call frame.normalised(), or use jscomb.combine"
        if k < wanted and not self.halves:
            return (
                f"the variance, given or estimated from sub-buffers: render with "
                f"variances, or at least {wanted * total // k} sub-buffers (this frame "
                f"has {total})"
            )
        if k < wanted:
            return (
                f"half buffers: render at least {wanted * total // k} sub-buffers "
                f"(this frame has {total})"
            )
        if self.channels not in (None, channels):
            return f"{self.channels} channels of colour, not {channels}"
        if lacking:
            return f"{', '.join(lacking)}: render with these features"
        return self.missing_package()


Maker = Callable[[Frame], Estimate]
"""A denoiser, or a combiner with its other arguments bound."""


def with_halves(
    frame: Frame,
    make: Callable[..., Image],
    *given: Any,
    needs: Needs = Needs(),  # noqa: B008 (immutable)
) -> Estimate:
    """Make an image of a frame, and the same image of each half alone.

    Args:
        frame: the frame.
        make: from a frame, or a half as a frame, and its estimates to an image [H,W,C].
        given: what `make` takes beside the frame: estimates, makers of them, or trees
            of both. For a half, an estimate stands for its half, which has no halves
            of its own; a maker is called with the half.
        needs: what `make` needs of a frame; with `needs.halves` estimates must have
            halves.

    Returns:
        the estimate; its halves are None where a half lacks what is needed
        (`needs.missing_for_halves`), or an estimate has no halves to pass on.

    Example:
        >>> frame = make_frame(jnp.stack([jnp.zeros((2, 2, 1)), jnp.ones((2, 2, 1))]))
        >>> double = lambda part: 2 * part.color
        >>> made = with_halves(frame, double)
        >>> print(made.image[0, 0], made.halves[:, 0, 0, 0])
        [1.] [0. 2.]
        >>> add = lambda part, estimate: part.color + estimate.image
        >>> print(with_halves(frame, add, made).halves[:, 0, 0, 0])
        [0. 3.]
    """
    image = make(frame, *estimates_of(frame, given))
    if not halves_possible(frame, given, needs=needs):
        return Estimate(image)
    halves = [
        make(half, *estimates_of(half, given, number))
        for number, half in enumerate(frame.halves())
    ]
    return Estimate(image, jnp.stack(halves))


def halves_possible(frame: Frame, given: Any = (), *, needs: Needs) -> bool:
    """Return whether a combiner can be run on each half of a frame alone.

    Args:
        frame: the frame.
        given: estimates of it, makers, or a tree of both.
        needs: what the combiner needs of a frame; with `needs.halves` an estimate is
            not enough, because its halves have no halves of their own.

    Returns:
        whether; `needs.missing_for_halves` is the reason if the frame is in the way.

    Example:
        >>> frame = make_frame(jnp.ones((2, 2, 2, 1)))
        >>> print(halves_possible(frame, needs=Needs(halves=True)))
        False
    """
    fixed = [e for e in _leaves(given) if isinstance(e, Estimate)]
    passed_on = all(e.halves is not None for e in fixed)
    return passed_on and not (
        needs.missing_for_halves(frame) or (needs.halves and fixed)
    )


def estimates_of(part: Frame, given: Any, number: int | None = None) -> Any:
    """Return the estimates of a frame, or of one of its halves.

    Args:
        part: the frame or the half.
        given: estimates of the frame, makers, or a tree of both.
        number: of the half, 0 or 1; None for the frame.

    Returns:
        the tree with an estimate in place of each maker.

    Example:
        >>> frame = make_frame(jnp.ones((2, 2, 2, 1)))
        >>> maker = lambda part: Estimate(3 * part.color)
        >>> print(estimates_of(frame, {"three": maker})["three"].image[0, 0])
        [3.]
    """

    def one(each: Estimate | Maker) -> Estimate:
        if not isinstance(each, Estimate):
            return each(part)
        return each if number is None else each.half(number)

    return jax.tree.map(one, given, is_leaf=_is_leaf)


def _leaves(given: Any) -> list[Any]:
    """The estimates and makers of a tree."""
    return jax.tree.leaves(given, is_leaf=_is_leaf)


def _is_leaf(tree: Any) -> bool:
    """Whether a part of a tree is one estimate."""
    return isinstance(tree, Estimate)


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
            variance of the mean of all of them.
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
        estimates={
            n: _checked_estimate(n, e, full) for n, e in (estimates or {}).items()
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


def _checked_estimate(
    name: str, estimate: Estimate | ArrayLike, shape: tuple[int, ...]
) -> Estimate:
    """An estimate of the colour's shape."""
    if not isinstance(estimate, Estimate):
        estimate = Estimate(jnp.asarray(estimate))
    image, halves = (None if i is None else jnp.asarray(i) for i in estimate)
    assert image is not None
    _expect(f"estimate {name!r}", image, [shape])
    if halves is not None:
        _expect(f"the halves of estimate {name!r}", halves, [(2, *shape)])
    return Estimate(image, halves)
