"""Read a frame with all that the command was given beside it."""

import os
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from jscomb import exr, methods
from jscomb.exr import Contents
from jscomb.frame import CHANNELS, Estimate, Frame, make_frame
from jscomb.typing import Image

_ROUNDING = 0.02  # of 16 bits, and of filters that differ
FEATURES = ("albedo", "normal", "variance")


class Options(NamedTuple):
    """The options of `combine` that a result depends on, but its files."""

    method: str
    budget: float | None
    samples: int | None
    layer: str | None
    layers: Literal["all", "color"]
    pixels: Literal["same", "half", "float"]


class Job(NamedTuple):
    """One frame, and the files that belong to it.

    Attributes:
        frame: file or directory.
        target: file to write.
        folder: to make for it; empty for a file that was named.
        biased: a file, or the name of a denoiser or of an image of the frame.
        halves: files of sub-buffers.
        features: files or layers, by `FEATURES`.
        wrong: why it cannot be combined; None if it can.
    """

    frame: str
    target: str
    folder: str
    biased: str | None
    halves: tuple[str, ...]
    features: dict[str, str]
    wrong: ValueError | None = None

    @property
    def beside(self) -> list[str]:
        """The files that are read beside the frame's."""
        given = [self.biased, *self.halves, *self.features.values()]
        return [file for file in given if file is not None and is_path(file)]


def is_path(given: str) -> bool:
    """Return whether a file is meant, not a denoiser or a layer.

    Args:
        given: to an option that takes both.
    """
    return given not in methods.METHODS and os.path.exists(given)


class Sources:
    """All files of a job, each looked at once."""

    def __init__(self, job: Job):
        """Look at the headers, and make digests.

        Args:
            job: with files that exist.
        """
        self.job, self._found = job, {}
        self.frame = self[job.frame]

    def __getitem__(self, path: str) -> Any:
        """The source of a path."""
        key = os.path.realpath(path)
        if key not in self._found:
            self._found[key] = exr.open_source(path, digests=True)
        return self._found[key]

    def files(self) -> list[str]:
        """All files that were looked at."""
        return [file for source in self._found.values() for file in source.files]

    def made_from(self, options: Options, version: str) -> dict[str, Any]:
        """What distinguishes one combination from another: contents, not dates."""
        job = self.job
        digests = lambda path: self[path].digests()
        known = lambda given: digests(given) if is_path(given) else given
        return {
            "jscomb": version,
            "frame": os.path.basename(os.path.abspath(job.frame)),
            "files": digests(job.frame),
            "biased": None if job.biased is None else known(job.biased),
            "halves": [digests(half) for half in job.halves],
            "features": {name: known(given) for name, given in job.features.items()},
            "options": options._asdict(),
        }


class Loaded(NamedTuple):
    """A frame that is ready to be combined.

    Attributes:
        contents: of its file.
        frame: with the images that were given.
        biased: name of the biased image; None for any.
        notes: lines for the user.
    """

    contents: Contents
    frame: Frame
    biased: str | None
    notes: list[str]


def load(sources: Sources, options: Options, max_bytes: int) -> Loaded:
    """Return the frame of a job; raise if its parts do not fit together."""
    job = sources.job
    layers = {n: g for n, g in job.features.items() if not is_path(g)}
    common: dict[str, Any] = {"samples": options.samples, "max_bytes": max_bytes}
    contents = exr.read_contents(
        sources.frame,
        layer=options.layer,
        everything=options.layers == "all",
        **layers,
        **common,
    )
    notes = list(contents.notes)
    if "made from" in contents.provenance and options.layer is None:
        raise ValueError(
            f"{job.frame}: is a result of jscomb combine: combine the render that it "
            "was made of"
        )
    if contents.frame is None:
        raise ValueError(f"{job.frame}: has only a denoised image, no noisy one")
    frame = contents.frame
    for name, given in job.features.items():
        if name not in layers:
            frame = _with_feature(frame, name, sources[given], contents, notes, common)
    if job.halves:
        frame = _with_halves(sources, frame, contents, notes, options.layer, common)
    if contents.missing and frame.buffers.variance is None:
        if frame.sub_buffers < 2 and _needs_variance(options.method, contents.dialect):
            raise ValueError(contents.missing)
        notes.append(f"no variance: {contents.missing}")
    frame, biased = _with_biased(sources, frame, contents, notes, max_bytes)
    return Loaded(contents, frame, biased, notes)


def _needs_variance(method: str, dialect: str) -> bool:
    """Whether a method takes a variance, or a tier one that a renderer surely wrote."""
    chosen = methods.METHODS.get(method)
    if chosen is None:
        return dialect != "layers"
    return chosen.needs.variance or chosen.takes == "estimates"


def _with_feature(
    frame: Frame,
    name: str,
    source: Any,
    contents: Contents,
    notes: list[str],
    common: dict[str, Any],
) -> Frame:
    """The frame with a feature or the variance from another file."""
    if common["samples"] is None and frame.samples is not None:
        common = common | {"samples": float(frame.samples)}
    image, said = exr.align(exr.read_feature(source, name, **common), contents)
    notes += said
    if name == "variance":
        k = frame.sub_buffers
        buffer = jnp.broadcast_to(k * image, (k, *image.shape))
    else:
        buffer = image[None, ..., : CHANNELS[name]]
    return frame._replace(buffers=frame.buffers._replace(**{name: buffer}))


def _with_halves(
    sources: Sources,
    frame: Frame,
    contents: Contents,
    notes: list[str],
    layer: str | None,
    common: dict[str, Any],
) -> Frame:
    """The frame whose sub-buffers are renders of other seeds."""
    job, frames, colors = sources.job, [], []
    paths = [os.path.realpath(half) for half in job.halves]
    own = os.path.realpath(job.frame)
    takes_part = own not in paths and len(paths) % 2 == 1
    if takes_part:
        frames, colors = [frame], [frame.color]
    for path, given in zip(paths, job.halves, strict=True):
        if path == own:
            frames.append(frame)
            colors.append(frame.color)
            continue
        other = exr.read_contents(sources[given], layer=layer, **common)
        if other.frame is None:
            raise ValueError(f"{given}: has only a denoised image, no noisy one")
        color, said = exr.convert(other.frame.color, other, contents)
        notes += said
        same = [np.array_equal(color, each, equal_nan=True) for each in colors]
        if any(same):
            raise ValueError(
                f"{given}: is the same image as another half: render it with another "
                "seed"
            )
        frames.append(_fitting(other.frame, color))
        colors.append(color)
    if len(frames) % 2:
        raise ValueError(
            f"--halves: needs an even number of renders, the frame among them, has "
            f"{len(frames)}: add one with another seed"
        )
    if not takes_part and own not in paths:
        _check_mean(job.frame, frame.color, colors)
    return _of_sub_buffers(frame, frames, colors)


def _check_mean(path: str, color: Image, colors: list[Image]) -> None:
    """Raise unless a frame is the mean of its halves, but for rounding."""
    mean = jnp.mean(jnp.stack(colors), axis=0)
    known = np.isfinite(mean) & np.isfinite(color)
    difference = np.abs(np.where(known, mean - color, 0)).mean()
    if difference > _ROUNDING * np.abs(np.where(known, mean, 0)).mean():
        raise ValueError(
            f"--halves: {path} is neither one of the {len(colors)} renders nor their "
            "mean"
        )


def _fitting(frame: Frame, color: Image) -> Frame:
    """The frame without buffers, where its colour had to be moved or converted."""
    if np.array_equal(frame.color, color, equal_nan=True):
        return frame
    return make_frame(color)._replace(samples=frame.samples)


def _of_sub_buffers(frame: Frame, frames: list[Frame], colors: list[Image]) -> Frame:
    """A frame of independent renders, each of as many samples."""
    counts = [each.samples for each in frames]
    known = [float(count) for count in counts if count is not None]
    if len(set(known)) > 1:
        listed = ", ".join(f"{count:g}" for count in known)
        raise ValueError(f"--halves: renders of {listed} samples; they must be equal")
    whole = len(known) == len(frames)
    buffers = {}
    for name in ("variance", *CHANNELS):
        each = [part.buffers._asdict()[name] for part in frames]
        images = [None if image is None else jnp.mean(image, axis=0) for image in each]
        if name == "variance":
            images = [
                None if image is None else image / part.sub_buffers
                for image, part in zip(images, frames, strict=True)
            ]
        fits = [
            i for i in images if i is not None and i.shape[:2] == colors[0].shape[:2]
        ]
        if len(fits) == len(frames):
            buffers[name] = jnp.stack(fits)
        elif name != "variance":
            buffers[name] = frame.buffers._asdict()[name]
            if buffers[name] is not None:
                buffers[name] = jnp.mean(buffers[name], axis=0)
    return make_frame(
        jnp.stack(colors),
        samples=sum(known) if whole else None,
        estimates=_estimates(frame, frames),
        reference=frame.reference,
        **buffers,
    )


def _estimates(frame: Frame, frames: list[Frame]) -> dict[str, Estimate]:
    """The frame's estimates; with halves where there are two renders that have them."""
    found = {}
    for name, (image, halves) in frame.estimates.items():
        parts = [
            part.estimates[name].image for part in frames if name in part.estimates
        ]
        if len(parts) == len(frames) == 2:
            found[name] = Estimate(jnp.mean(jnp.stack(parts), axis=0), jnp.stack(parts))
        else:
            found[name] = Estimate(image, halves)
    return found


def _with_biased(
    sources: Sources,
    frame: Frame,
    contents: Contents,
    notes: list[str],
    max_bytes: int,
) -> tuple[Frame, str | None]:
    """The frame with the biased image, and its name; None for any."""
    biased, path = sources.job.biased, sources.job.frame
    if biased is None or biased in frame.estimates or biased in methods.METHODS:
        return frame, biased
    held = ", ".join(frame.estimates) or "none"
    if not os.path.exists(biased):
        raise ValueError(
            f"--biased {biased}: neither a file, nor a denoiser, nor a biased image in "
            f"{path} (it holds {held})"
        )
    if os.path.realpath(biased) == os.path.realpath(path):
        raise ValueError(
            f"--biased {biased}: is the frame itself; name one of its images ({held})"
        )
    other = exr.read_contents(sources[biased], statistics=False, max_bytes=max_bytes)
    image = _biased_image(biased, other)
    notes += [f"{biased}: {note}" for note in other.notes]
    image, said = exr.convert(image, other, contents)
    notes += said
    missing = int(np.isnan(image).any(axis=-1).sum())
    if missing and other.window != contents.window:
        notes.append(f"{biased}: lacks {missing} pixels; they stay as they are")
    if np.array_equal(image, frame.color, equal_nan=True):
        notes.append(f"{biased}: is the same image as the noisy one")
    name = os.path.basename(os.path.abspath(biased))
    return frame.with_estimate(name, Estimate(image)), name


def _biased_image(biased: str, other: Contents) -> Image:
    """The denoised image of a file; raise where only noise is known."""
    if other.denoised is not None or other.dialect == "result":
        return other.image
    assert other.frame is not None
    held = other.frame.estimates
    if len(held) > 1:
        raise ValueError(f"{biased}: holds several biased images: {', '.join(held)}")
    if held:
        return next(iter(held.values())).image
    if other.color is not None and other.color.rank("noisy") is not None:
        raise ValueError(f"{biased}: has only a noisy image, {other.color.shown}")
    return other.image
