"""Frames, and the family of variants: many estimates of one frame by one denoiser.

What is cheap to change about a denoiser makes errors that differ: which features guide
it, whether they are denoised first, the size of the network, whether texture is divided
out, and how the image is turned. Their mean, or an ensemble of them, is better than
each.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jscomb.denoisers.oidn import _filter
from jscomb.denoisers.oidn._denoise import (
    EXPOSURE,
    NEEDS,
    color_model,
    denoise_feature,
    guarded,
)
from jscomb.denoisers.oidn._models import Model, Quality
from jscomb.frame import Estimate, Frame, Needs
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image

_DARK = 0.2  # an albedo below it is not divided out fully
_BATCH = 2**23  # pixels, of images that are denoised by one call
_AT_ONCE = 4  # of these, on an accelerator


class Variant(NamedTuple):
    """A way to denoise a frame.

    Attributes:
        features: which guide it, if the frame has them: "both" albedo and normal,
            "albedo" or "none".
        clean: denoise the features first, and denoise with the network for clean ones.
        quality: "high", "balanced" or "fast"; also of the features' denoising.
        demodulated: divide the colour by the albedo, and multiply the result by it.
        turned: the mean over the eight flips and rotations of the image.
    """

    features: Literal["both", "albedo", "none"] = "both"
    clean: bool = False
    quality: Quality = "high"
    demodulated: bool = False
    turned: bool = False

    @property
    def needs(self) -> Needs:
        """What it needs of a frame to be what it says."""
        names: tuple[str, ...] = ()
        if self.demodulated or self.features == "albedo":
            names = ("albedo",)
        return NEEDS._replace(features=("albedo", "normal") if self.clean else names)


VARIANTS: dict[str, Variant] = {
    "oidn": Variant(),
    "oidn-color": Variant("none"),
    "oidn-albedo": Variant("albedo"),
    "oidn-demodulated": Variant("none", demodulated=True),
    "oidn-clean": Variant(clean=True),
    "oidn-clean-balanced": Variant(clean=True, quality="balanced"),
    "oidn-turned": Variant(turned=True),
    "oidn-clean-turned": Variant(clean=True, turned=True),
}
"""By name, as in the table of methods."""


class _Job(NamedTuple):
    """Images to filter, and what is to be done with the result."""

    model: Model
    images: dict[str, Array]
    finish: Callable[[Array], Array]


def denoise_color(
    color: Image, frame: Frame, *, variant: Variant = VARIANTS["oidn"]
) -> Image:
    """Denoise another colour of a normalised frame, guided by the frame's features.

    For derivatives with respect to the colour, as `progressive` takes them.

    Args:
        color: normalised radiance, shape [H,W,3].
        frame: normalised, of the same size.
        variant: how.

    Returns:
        the denoised colour, normalised radiance, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised, does not have three channels, or
            lacks a feature.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> from jscomb.frame import make_frame
        >>> noise = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> frame = make_frame(noise).normalised()
        >>> if not NEEDS.missing_package():
        ...     made = denoise_color(frame.color, frame)
        ...     assert (made == denoise_frame(frame).image).all()
    """
    frame.require("oidn", variant.needs)
    (made,) = _made([(color, frame, variant)])
    return made


def denoise_frame(frame: Frame, *, variant: Variant = VARIANTS["oidn"]) -> Estimate:
    """Denoise a normalised frame, guided by its features.

    Args:
        frame: normalised, with three channels.
        variant: how.

    Returns:
        the estimate, normalised radiance; each half is guided by its own features.

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised, does not have three channels, or
            lacks a feature.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> from jscomb.frame import make_frame
        >>> shape = 2, 32, 32, 3
        >>> noise = jax.random.exponential(jax.random.key(0), shape, jnp.float32)
        >>> if not NEEDS.missing_package():
        ...     made = denoise_frame(make_frame(noise).normalised())
        ...     assert made.image.std() < made.halves.std() < 0.1 * noise.std()
    """
    (made,) = denoise_variants(frame, [variant])
    return made


def denoise_variants(frame: Frame, variants: Sequence[Variant]) -> list[Estimate]:
    """Denoise a normalised frame in several ways at once.

    Variants of one network share calls, and those with clean features the denoising of
    these.

    Args:
        frame: normalised, with three channels.
        variants: each a way.

    Returns:
        an estimate for each, normalised radiance.

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised, does not have three channels, or
            lacks a feature of a variant.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> from jscomb.frame import make_frame
        >>> noise = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> if not NEEDS.missing_package():
        ...     ways = Variant(), Variant(quality="fast")
        ...     first, second = denoise_variants(make_frame(noise).normalised(), ways)
        ...     assert first.halves is None and (first.image != second.image).any()
    """
    for variant in variants:
        frame.require("oidn", variant.needs)
    halves = () if NEEDS.missing_for_halves(frame) else frame.halves()
    parts = frame, *halves
    made = _made([(part.color, part, v) for v in variants for part in parts])
    estimates = []
    for start in range(0, len(made), len(parts)):
        image, *of_halves = made[start : start + len(parts)]
        estimates.append(Estimate(image, jnp.stack(of_halves) if halves else None))
    return estimates


def denoise_turns(
    frame: Frame, *, variant: Variant = VARIANTS["oidn"]
) -> Float[Array, "8 h w 3"]:
    """Denoise a normalised frame in its eight flips and rotations.

    How they differ shows where the result is uncertain, without half buffers.

    Args:
        frame: normalised, with three channels.
        variant: how.

    Returns:
        the images, turned back, normalised radiance, shape [8,H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised, does not have three channels, or
            lacks a feature.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> from jscomb.frame import make_frame
        >>> noise = jax.random.exponential(jax.random.key(0), (32, 48, 3), jnp.float32)
        >>> if not NEEDS.missing_package():
        ...     print(denoise_turns(make_frame(noise).normalised()).shape)
        (8, 32, 48, 3)
    """
    frame.require("oidn", variant.needs)
    jobs = _jobs(frame.color, _features(frame, variant), variant._replace(turned=True))
    return jnp.stack(_results(jobs))


def _made(asked: Sequence[tuple[Image, Frame, Variant]]) -> list[Image]:
    """Denoise colours of frames."""
    kept: dict = {}  # features of a frame, as guards or their denoising made them

    def features(frame: Frame, variant: Variant) -> dict[str, Array]:
        key = id(frame), variant.clean, variant.clean and variant.quality
        if key not in kept:
            kept[key] = _features(frame, variant)
        return kept[key]

    jobs = [_jobs(color, features(frame, v), v) for color, frame, v in asked]
    results = iter(_results([job for each in jobs for job in each]))
    grouped = [[next(results) for _ in each] for each in jobs]
    return [images[0] if len(images) == 1 else _mean(images) for images in grouped]


def _mean(images: Sequence[Image]) -> Image:
    """The mean of images, none of which need be stacked."""
    return functools.reduce(jnp.add, images) / len(images)


def _features(frame: Frame, variant: Variant) -> dict[str, Array]:
    """The frame's features by name, guarded or denoised."""
    found = {"albedo": frame.albedo, "normal": frame.normal}
    features = {name: image for name, image in found.items() if image is not None}
    if variant.clean:
        return {
            name: denoise_feature(image, name, quality=variant.quality)
            for name, image in features.items()
        }
    return {name: guarded(name, image, image.shape) for name, image in features.items()}


def _jobs(color: Image, features: dict[str, Array], variant: Variant) -> list[_Job]:
    """What a variant filters: one job, or one for each turn."""
    shape = (*color.shape[:2], 3)
    factor = 1.0
    if variant.demodulated:
        factor = _modulation(features["albedo"])
    names = {"both": ("albedo", "normal"), "albedo": ("albedo",), "none": ()}
    used = tuple(n for n in names[variant.features] if n in features)
    if used == ("normal",):
        used = ()
    model = color_model(used, variant.clean, variant.quality)
    images = {n: features[n] for n in used}
    images |= {"color": guarded("color", color / factor, shape)}
    if not variant.turned:
        return [_Job(model, images, lambda made: factor * made)]
    return [
        _Job(
            model,
            {name: _turn(image, number) for name, image in images.items()},
            lambda made, number=number: factor * _turn_back(made, number),
        )
        for number in range(8)
    ]


def _modulation(albedo: Array) -> Array:
    """The albedo, where it is bright enough to divide by."""
    return jnp.maximum(albedo, _DARK)


def _turn(image: Array, number: int) -> Array:
    """One of the eight flips and rotations of an image."""
    return jnp.rot90(image[:, ::-1] if number >= 4 else image, number % 4)


def _turn_back(image: Array, number: int) -> Array:
    """The inverse of `_turn`."""
    image = jnp.rot90(image, -number % 4)
    return image[:, ::-1] if number >= 4 else image


def _results(jobs: Sequence[_Job]) -> list[Array]:
    """Filter, all images of one model and shape by as few calls as memory allows."""
    groups: dict = {}
    for number, job in enumerate(jobs):
        groups.setdefault((job.model, job.images["color"].shape), []).append(number)
    results: dict[int, Array] = {}
    for (model, (height, width, _)), numbers in groups.items():
        count = max(1, _BATCH // (height * width))
        for start in range(0, len(numbers), count):
            some = numbers[start : start + count]
            made = _filtered(model, [jobs[number].images for number in some])
            results |= dict(zip(some, made, strict=True))
    return [job.finish(results[number]) for number, job in enumerate(jobs)]


def _filtered(model: Model, images: list[dict[str, Array]]) -> Sequence[Array]:
    """Filter images of one shape."""
    if len(images) == 1:
        return [_filter.run(model, images[0], EXPOSURE)]
    stacked = jax.tree.map(lambda *each: jnp.stack(each), *images)
    return list(compiled(_mapped, model=model)(stacked))


def _mapped(images: dict[str, Array], *, model: Model) -> Array:
    """Filter stacked images: a CPU is busy with one, other devices take several."""
    at_once = None if jax.default_backend() == "cpu" else _AT_ONCE
    one = lambda images: _filter.run(model, images, EXPOSURE)
    return lax.map(one, images, batch_size=at_once)
