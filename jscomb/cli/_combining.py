"""`jscomb combine`: a frame, or a sequence of them, from file to file."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jscomb
from jscomb import exr, methods
from jscomb.cli import _tables as tables
from jscomb.cli._frames import FEATURES, Job, Loaded, Options, Sources, load
from jscomb.cli._making import Made, by_tier, made_of, remedy
from jscomb.cli._matching import expand, is_several, match
from jscomb.cli._outputs import (
    Force,
    check_folder,
    check_inputs_stay,
    path_from,
    state,
    targets,
)
from jscomb.cli._telling import Teller, as_json, voice
from jscomb.frame import Frame
from jscomb.numerics.tiles import Local, stream_crops, tile_within
from jscomb.typing import Image

FramePath = tyro.conf.Positional[Path]
SampleCount = Annotated[int | None, tyro.conf.arg(metavar="N")]
LayerName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
MaxMemory = Annotated[int, tyro.conf.arg(metavar="MIB")]
_Frames = tyro.conf.Positional[tuple[str, ...]]
_Biased = Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME|PATTERN")]
_Halves = Annotated[tuple[str, ...], tyro.conf.arg(metavar="FILE|PATTERN")]
_Feature = Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE|PATTERN")]
_Method = Annotated[str, tyro.conf.arg(metavar="NAME")]
_Budget = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
_Memory = Annotated[int, tyro.conf.arg(metavar="MIB")]
_Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
AUTO = "auto"
LARGE = 2**21  # pixels; larger frames are combined by crops
MAX_MEMORY = exr.MAX_BYTES // 2**20


def combine(
    frames: _Frames,
    /,
    out: Annotated[str, tyro.conf.arg(aliases=["-o"], metavar="PATH")],
    *,
    biased: _Biased = None,
    halves: _Halves = (),
    method: _Method = AUTO,
    budget: _Budget = None,
    samples: SampleCount = None,
    layer: LayerName = None,
    albedo: _Feature = None,
    normal: _Feature = None,
    variance: _Feature = None,
    layers: Literal["all", "color"] = "all",
    pixels: Literal["same", "half", "float"] = "same",
    memory: _Memory = 2048,
    max_memory: MaxMemory = MAX_MEMORY,
    force: Force = False,
    quiet: _Flag = False,
    verbose: _Flag = False,
    json: _Flag = False,
) -> None:
    """Combine path-traced frames with biased images into better images.

    The result has all that the frame's file has, with the combined colour in place of
    the noisy one and, where it can be estimated, its error as the layer error.Y: other
    layers, windows, pixel types, compression, attributes. What cannot be written is
    named.

    Several frames are written to a folder, under their names. A result that is there,
    made of files of the same content in the same way, is not made again; a frame that
    cannot be combined is reported at the end, after all others. An input is never
    replaced, and any other file that is not an older result of the frame only by
    --force.

    Files for a sequence are given as a folder or a pattern (denoised.####.exr), and
    belong to the frames of the same number.

    Tiers of the default method: {tiers}. Methods: {methods}.

    Args:
        frames: EXR files of any known renderer, or Tungsten directories.
        out: EXR file to write; for several frames, or with a slash at its end, or if
            such a folder exists, the folder.
        biased: EXR file of the biased image, its name within the frame, or a denoiser
            of the methods; for a sequence a folder or a pattern. By default a tier
            makes its own, and adds those of the frame; a method takes the frame's only
            one, or Open Image Denoise.
        halves: renders of the frame with other seeds and as many samples. An odd number
            are sub-buffers together with the frame, an even number by themselves. They
            give what a frame without variance lacks.
        method: a tier, one of the methods, or auto: the best tier within the budget, an
            ensemble whose weights the half buffers tell; for a frame without them the
            tier fast.
        budget: seconds that a tier may take, without compilation; unlimited by default.
        samples: samples a pixel, where the file does not say.
        layer: the noisy colour in a file of several, a stereo view, or a view layer.
        albedo: the layer with the albedo, or a file.
        normal: the layer with the normals, or a file.
        variance: the layer with the variance of the mean, or a file; NAME:sample if it
            is that of single samples.
        layers: all that the file has, or color: R, G, B and alpha alone.
        pixels: of the combined colour: the same type as the noisy one's, half, or
            float.
        memory: mebibytes that a method may take beside the images; a large frame is
            combined by crops as large as that allows. A tier takes what it needs.
        max_memory: mebibytes that the pixels of one file may take in memory.
        force: replace files that are not results of the frame.
        quiet: print errors only.
        verbose: print what was read and the seconds of each step, too.
        json: print one line of JSON a frame instead; null for what is not finite.
    """
    speaking = voice(quiet=quiet, verbose=verbose, json=json)
    options = Options(method, budget, samples, layer, layers, pixels)
    limits = Limits(memory * 2**20, max_memory * 2**20, force)
    _check(options, limits)
    if not frames and halves:  # each entry is a half; the first is written like
        frames = tuple(expand(halves[0])) if is_several(halves[0]) else halves[:1]
    if not frames:
        raise ValueError("no frame is given: jscomb combine FRAME.exr -o OUT.exr")
    given = {"albedo": albedo, "normal": normal, "variance": variance}
    jobs = _jobs(frames, out, biased, halves, given)
    inputs = [file for job in jobs for file in [job.frame, *job.beside]]
    check_inputs_stay([job.target for job in jobs], inputs)
    for job in jobs:
        if not job.folder:
            check_folder(job.target)
    with Teller(speaking, len(jobs)) as teller:
        if len(jobs) == 1:
            _combine_alone(jobs[0], options, limits, teller)
        else:
            _combine_sequence(jobs, options, limits, teller)


class Limits(NamedTuple):
    """What changes no result: memory for crops and for files, in bytes; force."""

    memory: int
    max_bytes: int
    force: bool


def _check(options: Options, limits: Limits) -> None:
    """Raise unless the options make sense, before any file is touched."""
    known = [AUTO, *methods.TIERS, *methods.METHODS]
    if options.method not in known:
        raise ValueError(
            f"--method {options.method}: expected one of {', '.join(known)}"
        )
    if options.budget is not None and not options.budget >= 0:
        raise ValueError(f"--budget {options.budget}: expected seconds, at least 0")
    for option, limit in (
        ("--memory", limits.memory),
        ("--max-memory", limits.max_bytes),
    ):
        if limit < 1:
            found = f"the budget is {limit // 2**20} MiB"
            raise ValueError(f"{option}: {found}, expected at least 1")


def _jobs(
    frames: Sequence[str],
    out: str,
    biased: str | None,
    halves: Sequence[str],
    features: dict[str, str | None],
) -> list[Job]:
    """What to do for each frame."""
    columns = [_matched("--biased", biased, frames)]
    columns += [_matched("--halves", half, frames) for half in halves]
    columns += [_matched(f"--{name}", features[name], frames) for name in FEATURES]
    jobs = []
    for number, (frame, target) in enumerate(
        zip(frames, targets(frames, out), strict=True)
    ):
        found = [column[number] for column in columns]
        wrong = next((each for each in found if isinstance(each, ValueError)), None)
        first, *others = [None if isinstance(f, ValueError) else f for f in found]
        files = tuple(half for half in others[: len(halves)] if half is not None)
        for half in files:
            if not os.path.exists(half):
                wrong = ValueError(f"--halves {half}: no such file")
        own = zip(FEATURES, others[len(halves) :], strict=True)
        named = {name: each for name, each in own if each is not None}
        folder = os.path.dirname(target) if target != out else ""
        jobs.append(Job(frame, target, folder, first, files, named, wrong))
    return jobs


def _matched(
    option: str, given: str | None, frames: Sequence[str]
) -> Sequence[str | ValueError | None]:
    """What is given to each frame."""
    if given is None or (option == "--biased" and given in methods.METHODS):
        return [given] * len(frames)
    return match(option, given, frames)


_FAILURES = ValueError, OSError, ImportError, RuntimeError


def _why(job: Job, error: Exception) -> str:
    """Why a frame failed, in one line that does not name the frame."""
    return " ".join(str(error).split()).removeprefix(f"{job.frame}: ")


def _combine_alone(job: Job, options: Options, limits: Limits, teller: Teller) -> None:
    """Combine the only frame; a failure is raised, and told to programs."""
    try:
        _combine_job(job, options, limits, teller)
    except _FAILURES as error:
        found = {"frame": job.frame, "out": job.target, "status": "failed"}
        teller.give(**found, error=_why(job, error))
        raise


def _combine_sequence(
    jobs: Sequence[Job], options: Options, limits: Limits, teller: Teller
) -> None:
    """Combine every frame into the folder, and report those that fail."""
    failed = []
    for job in jobs:
        name = os.path.basename(os.path.abspath(job.frame))
        with teller.frame(name):
            try:
                _combine_job(job, options, limits, teller)
            except _FAILURES as error:
                teller.fail(job.frame, job.target, _why(job, error))
                failed.append(name)
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(jobs)} frames failed: {', '.join(failed)}"
        )


def _combine_job(job: Job, options: Options, limits: Limits, teller: Teller) -> None:
    """Combine one frame, unless that is done already."""
    if job.wrong is not None:
        raise job.wrong
    teller.begin("reading")
    sources = Sources(job)
    made_from = sources.made_from(options, jscomb.__version__)
    check_inputs_stay([job.target], sources.files())
    if state(job.target, job.frame, made_from, force=limits.force) == "done":
        teller.say(f"{job.target} is there already")
        teller.give(frame=job.frame, out=job.target, status="there already")
        return
    loaded = load(sources, options, limits.max_bytes)
    teller.say(*(f"{job.frame}: {note}" for note in loaded.notes))
    teller.say_more(f"read {job.frame}: {tables.frame_of(loaded.contents)}")
    teller.begin("combining")
    try:
        made = _combined(loaded.frame, loaded.biased, options, limits.memory, teller)
    except ValueError as error:
        raise ValueError(f"{job.frame}: {error}{remedy(loaded.frame)}") from None
    if job.folder:
        os.makedirs(job.folder, exist_ok=True)
    jax.block_until_ready(made.image)
    teller.begin("writing")
    lost = _write(job, loaded, made, options, made_from)
    _report(job, loaded, made, options, lost, teller)


def _report(
    job: Job,
    loaded: Loaded,
    made: Made,
    options: Options,
    lost: Sequence[str],
    teller: Teller,
) -> None:
    """Say what was done and why, and the errors if there is a reference."""
    frame, color = loaded.frame, loaded.contents.color
    teller.say(*(f"{job.target}: {line}" for line in lost))
    if made.by is not None:
        teller.say(made.sentence(frame))
    of = f" of {', '.join(made.bases)}" if made.bases else ""
    where = f", as {color.shown}" if color and color.name and _keeps(options) else ""
    size = tables.size(frame)
    teller.say(f"wrote {job.target}: {size}, {made.method}{of}{where}")
    errors, excluded = {}, ""
    if frame.reference is not None:
        held = {n: estimate.image for n, estimate in frame.estimates.items()}
        images = {"input": frame.color, **held, made.method: made.image}
        errors, excluded = tables.errors(images, frame)
        table = tables.table({"relative L2": tables.rounded(errors)})
        teller.say(*([excluded] if excluded else []), *table)
    teller.say_seconds()
    teller.give(
        frame=job.frame,
        out=job.target,
        status="written",
        **made.summary(frame),
        errors={name: as_json(error) for name, error in errors.items()} or None,
        notes=[*loaded.notes, *lost, *([excluded] if excluded else [])],
    )


def _keeps(options: Options) -> bool:
    """Whether the layers of the frame's file are written again."""
    return options.layers == "all"


def _write(
    job: Job, loaded: Loaded, made: Made, options: Options, made_from: dict[str, Any]
) -> list[str]:
    """Write the result as the frame's file has it; what is lost, in lines."""
    contents, frame = loaded.contents, loaded.frame
    provenance = {
        "jscomb": jscomb.__version__,
        "method": made.method,
        "frame": os.path.basename(os.path.abspath(job.frame)),
        "path": path_from(job.target, job.frame),
        "biased": made.bases,
        "made from": made_from,
        "input": contents.provenance,
    }
    found = None if made.by is None else made.by.error
    error = None if found is None else np.asarray(found.map)
    if found is not None:
        provenance["estimated relative L2"] = [float(i) for i in found[1:]]
    image, color = np.asarray(made.image), np.asarray(frame.color)
    image = np.where(np.isfinite(image), image, color)  # unknown: it stays as it is
    image = np.where(contents.empty, 0, image)
    error = None if error is None else np.where(contents.empty, 0, error)
    return exr.write_contents(
        job.target,
        contents,
        image,
        error=error,
        layers=options.layers,
        pixels=options.pixels,
        provenance=provenance,
    )


def _combined(
    frame: Frame, name: str | None, options: Options, memory: int, teller: Teller
) -> Made:
    """Combine a frame by a tier or a method."""
    key, method = jax.random.key(0), options.method
    if method == AUTO or method in methods.TIERS:
        tier = None if method == AUTO else method
        return by_tier(frame, tier, name, options.budget, progress=teller.begin)
    teller.begin(f"combining by {method}")
    if methods.METHODS[method].takes == "nothing":
        name = None
    local = methods.plan(key, frame, method=method, biased=name)
    image = _evaluated(local, memory, teller)
    return Made(method, image, made_of(frame, name, method))


def _evaluated(local: Local, memory: int, teller: Teller) -> Image:
    """The image of a local function; a large one by crops that keep to the memory."""
    first = jax.tree.leaves(local.images)[0]
    height, width = first.shape[:2]
    if height * width <= LARGE or not local.halo:
        return local.whole()
    tile = tile_within(**local._asdict(), budget=memory)
    image = np.empty((height, width, 3), np.float32)
    parts = stream_crops(**local._asdict(), tile=tile)
    count = -(-height // tile) * -(-width // tile)
    for where, part in teller.each(parts, count, "crop"):
        image[where] = part
    return jnp.asarray(image)
