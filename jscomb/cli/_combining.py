"""`jscomb combine`: a frame, or a sequence of them, from file to file."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

import jscomb
from jscomb import exr, methods, metrics
from jscomb.cli import _tables as tables
from jscomb.frame import Estimate, Frame
from jscomb.numerics.tiles import Local, stream_crops, tile_within
from jscomb.typing import Image

FramePath = tyro.conf.Positional[Path]
SampleCount = Annotated[int | None, tyro.conf.arg(metavar="N")]
_Frames = tyro.conf.Positional[tuple[Path, ...]]
_Biased = Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")]
_Method = Annotated[str, tyro.conf.arg(metavar="NAME")]
_Budget = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
_Memory = Annotated[int, tyro.conf.arg(metavar="MIB")]
AUTO = "auto"
LARGE = 2**21  # pixels; larger frames are combined by crops


def combine(
    frames: _Frames,
    /,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    biased: _Biased = None,
    method: _Method = AUTO,
    budget: _Budget = None,
    samples: SampleCount = None,
    memory: _Memory = 2048,
) -> None:
    """Combine path-traced frames with biased images into better images.

    Several frames are written to a folder, under their names. A result that is there,
    made of the same files in the same way, is not made again; a frame that cannot be
    combined is reported at the end, after all others.

    Tiers of the default method: {tiers}. Methods: {methods}.

    Args:
        frames: EXR files of any known renderer, or Tungsten directories.
        out: EXR file to write; for several frames, or if such a folder exists, the
            folder.
        biased: EXR file of the biased image, its name within the frame, or a denoiser
            of the methods. By default a tier makes its own, and adds those of the
            frame; a method takes the frame's only one, or Open Image Denoise.
        method: a tier, one of the methods, or auto: the best tier within the budget, an
            ensemble whose weights the half buffers tell; for a frame without them the
            tier fast.
        budget: seconds that a tier may take, without compilation; unlimited by default.
        samples: samples a pixel, where the file does not say.
        memory: mebibytes that a method may take beside the images; a large frame is
            combined by crops as large as that allows. A tier takes what it needs.
    """
    options = Options(biased, method, budget, samples, memory)
    if method not in (known := [AUTO, *methods.TIERS, *methods.METHODS]):
        known = ", ".join(known)
        raise ValueError(f"--method {method}: expected one of {known}")
    if len(frames) == 1 and not out.is_dir():
        _combine_file(frames[0], out, options)
    else:
        _combine_sequence(frames, out, options)


class Options(NamedTuple):
    """The options of `combine`."""

    biased: str | None
    method: str
    budget: float | None
    samples: int | None
    memory: int


def _combine_sequence(frames: Sequence[Path], folder: Path, options: Options) -> None:
    """Combine every frame into the folder, and report those that fail."""
    targets = [folder / f"{path.stem}.exr" for path in frames]
    if twice := {t.name for t in targets if targets.count(t) > 1}:
        raise ValueError(f"several frames would be written as {', '.join(twice)}")
    folder.mkdir(parents=True, exist_ok=True)
    failed = []
    pairs = list(zip(frames, targets, strict=True))
    for path, target in tqdm(pairs, unit="frame", disable=None):
        try:
            if _is_done(path, target, options):
                print(f"{target} is there already")
            else:
                _combine_file(path, target, options)
        except (ValueError, OSError, ImportError, RuntimeError) as error:
            print(f"{path}: {error}", file=sys.stderr)
            failed.append(path.name)
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(frames)} frames failed: {', '.join(failed)}"
        )


def _is_done(path: Path, target: Path, options: Options) -> bool:
    """Whether the target was made of this very file with these options."""
    if not target.exists():
        return False
    try:
        provenance = exr.read_provenance(target)
    except (ValueError, OSError):
        return False  # another program's, or damaged
    return provenance.get("made from") == _made_from(path, options)


def _made_from(path: Path, options: Options) -> dict[str, Any]:
    """What distinguishes one combination from another."""
    biased = options.biased or ""
    files = [path, *([biased] if os.path.exists(biased) else [])]
    changed = [os.stat(file).st_mtime_ns for file in files]
    return {"frame": path.name, "changed": changed, **options._asdict()}


def _combine_file(path: Path, out: Path, options: Options) -> None:
    """Combine one frame."""
    loaded = exr.read_frame(path, samples=options.samples)
    made_from = _made_from(path, options)
    try:
        frame, name = _with_biased(path, loaded, options.biased)
        made = _combined(frame, name, options)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    provenance = {
        "jscomb": jscomb.__version__,
        "method": made.method,
        "frame": path.name,
        "biased": made.bases,
        "made from": made_from,
        "input": exr.read_provenance(path) if path.is_file() else {},
    }
    error = None if made.error is None else made.error.map
    if made.error is not None:
        provenance["estimated relative L2"] = [float(i) for i in made.error[1:]]
    exr.write_image(out, made.image, error=error, provenance=provenance)
    of = f" of {', '.join(made.bases)}" if made.bases else ""
    print(f"wrote {out}: {tables.size(loaded)}, {made.method}{of}")
    if loaded.reference is not None:
        held = {name: estimate.image for name, estimate in frame.estimates.items()}
        images = {"input": loaded.color, **held, made.method: made.image}
        tables.print_table({"relative L2": tables.errors(images, loaded)})


class Made(NamedTuple):
    """An image, by which method or tier, of which estimates, and its error."""

    method: str
    image: Image
    bases: list[str]
    error: metrics.ErrorEstimate | None = None


def _combined(frame: Frame, name: str | None, options: Options) -> Made:
    """Combine a frame by a tier or a method."""
    key, method = jax.random.key(0), options.method
    if method == AUTO or method in methods.TIERS:
        return by_tier(frame, None if method == AUTO else method, name, options.budget)
    if methods.METHODS[method].takes == "nothing":
        name = None
    local = methods.plan(key, frame, method=method, biased=name)
    image = _evaluated(local, options.memory * 2**20)
    return Made(method, image, _made_of(frame, name, method))


def by_tier(
    frame: Frame,
    tier: str | None,
    name: str | None = None,
    budget: float | None = None,
) -> Made:
    """Combine a frame by a tier, and print what it is made of and its error."""
    made = methods.combine_tier(
        jax.random.key(0), frame, tier=tier, biased=name, budget=budget
    )
    if made.reason:
        print(made.reason)
    for skipped, reason in made.skipped.items():
        print(f"{skipped}: skipped: {reason}")
    if made.error is not None:
        _, mean, deviation = made.error
        count = f"ensemble of {len(made.bases)} estimates"
        print(f"{count}: estimated relative L2 {mean:.2g} ± {deviation:.1g}")
    return Made(made.tier, made.estimate.image, list(made.bases), made.error)


def _made_of(frame: Frame, name: str | None, method: str) -> list[str]:
    """The names of the estimates that a method combines."""
    chosen = methods.METHODS[method]
    if chosen.takes == "estimates":
        return list(methods.inputs(frame.normalised(), biased=name, method=method)[0])
    if chosen.takes == "nothing":
        return [chosen.denoiser] if chosen.denoiser else []
    return [methods.input_name(frame, biased=name)]


def _evaluated(local: Local, memory: int) -> Image:
    """The image of a local function; a large one by crops that keep to the memory."""
    first = jax.tree.leaves(local.images)[0]
    height, width = first.shape[:2]
    if height * width <= LARGE or not local.halo:
        return local.whole()
    tile = tile_within(**local._asdict(), budget=memory)
    image = np.empty((height, width, 3), np.float32)
    parts = stream_crops(**local._asdict(), tile=tile)
    count = -(-height // tile) * -(-width // tile)
    for where, part in tqdm(parts, total=count, unit="crop", disable=None):
        image[where] = part
    return jnp.asarray(image)


def _with_biased(
    path: Path, frame: Frame, biased: str | None
) -> tuple[Frame, str | None]:
    """The frame with the biased image, and its name; None for any."""
    if biased is None or biased in frame.estimates or biased in methods.METHODS:
        return frame, biased
    held = ", ".join(frame.estimates) or "none"
    if not os.path.exists(biased):
        raise ValueError(
            f"--biased {biased}: neither a file, nor a denoiser, nor a biased image in "
            f"{path} (it holds {held})"
        )
    image = exr.read_image(biased)
    if image.shape != frame.color.shape:
        raise ValueError(f"{biased} is {image.shape}, {path} {frame.color.shape}")
    name = Path(biased).name
    return frame.with_estimate(name, Estimate(image)), name
