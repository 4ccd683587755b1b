"""`jscomb combine`: a frame, or a sequence of them, from file to file."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

import jscomb
from jscomb import choice, exr
from jscomb.cli import tables
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame
from jscomb.numerics import tiles
from jscomb.typing import Image

FramePath = tyro.conf.Positional[Path]
SampleCount = Annotated[int | None, tyro.conf.arg(metavar="N")]
_Frames = tyro.conf.Positional[tuple[Path, ...]]
_Biased = Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")]
_Budget = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
_Memory = Annotated[int, tyro.conf.arg(metavar="MIB")]
_Method = Literal["auto", "kept", "james-stein", "whitened", "njs", "pd", "dsc"]
LARGE = 2**21  # pixels; frames with more are combined by crops
SAMPLED = 512  # pixels along a side of each piece of a large frame that is judged


def combine(
    frames: _Frames,
    /,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    biased: _Biased = None,
    method: _Method = "auto",
    budget: _Budget = None,
    samples: SampleCount = None,
    memory: _Memory = 2048,
) -> None:
    """Combine path-traced frames with biased images into better images.

    Several frames are written to a folder, under their names. What is there already,
    made of the same files in the same way, is not made again; a frame that cannot be
    combined is reported at the end, when all others are done.

    Args:
        frames: EXR files of any known renderer, or Tungsten directories.
        out: EXR file to write; for several frames, or if there is such a folder, the
            folder.
        biased: EXR file of the biased image, or its name within the frame. By default
            the frame's only one; a frame without any is denoised by Open Image Denoise.
        method: kept, the biased image as it is; whitened, or james-stein as in the
            paper without its network; by a trained network njs (James-Stein), dsc
            (double shrinkage, needs halves) or pd (progressive, needs Open Image
            Denoise); auto is the one of least error by the half buffers, and whitened
            where there are none.
        budget: seconds that the method of auto may take; any by default.
        samples: samples a pixel, where the file does not say.
        memory: mebibytes that combining may take beside the images; a large frame is
            combined by as large crops as that allows.
    """
    asked = _Asked(biased, method, budget, samples, memory)
    if len(frames) == 1 and not out.is_dir():
        _combine_file(frames[0], out, asked)
    else:
        _combine_sequence(frames, out, asked)


class _Asked(NamedTuple):
    """The options of `combine`."""

    biased: str | None
    method: str
    budget: float | None
    samples: int | None
    memory: int


def _combine_sequence(frames: Sequence[Path], folder: Path, asked: _Asked) -> None:
    """Every frame into the folder, past those that fail."""
    targets = [folder / f"{path.stem}.exr" for path in frames]
    if twice := {t.name for t in targets if targets.count(t) > 1}:
        raise ValueError(f"several frames would be written as {', '.join(twice)}")
    folder.mkdir(parents=True, exist_ok=True)
    failed = []
    pairs = list(zip(frames, targets, strict=True))
    for path, target in tqdm(pairs, unit="frame", disable=None):
        try:
            if _is_done(path, target, asked):
                print(f"{target} is there already")
            else:
                _combine_file(path, target, asked)
        except (ValueError, OSError, ImportError, RuntimeError) as error:
            print(f"{path}: {error}", file=sys.stderr)
            failed.append(path.name)
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(frames)} frames failed: {', '.join(failed)}"
        )


def _is_done(path: Path, target: Path, asked: _Asked) -> bool:
    """Whether the target was made of this very file in this very way."""
    if not target.exists():
        return False
    try:
        return exr.read_provenance(target).get("made from") == _made_from(path, asked)
    except (ValueError, OSError):
        return False  # not ours, or damaged: made anew


def _made_from(path: Path, asked: _Asked) -> dict[str, Any]:
    """What tells one combination from another."""
    files = [path, *([asked.biased] if os.path.exists(asked.biased or "") else [])]
    changed = [os.stat(file).st_mtime_ns for file in files]
    return {"frame": path.name, "changed": changed, **asked._asdict()}


def _combine_file(path: Path, out: Path, asked: _Asked) -> None:
    """One frame."""
    loaded = exr.read_frame(path, samples=asked.samples)
    made_from = _made_from(path, asked)
    try:
        _ = loaded.variance
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    name, image = _biased_image(path, loaded, asked.biased)
    whole = loaded.with_estimate(name, image)
    automatic = asked.method == "auto"
    chosen = choose(whole, name, asked.budget) if automatic else asked.method
    try:
        found = choice.local(jax.random.key(0), whole, name, method=chosen)
        combined = _made(found, asked.memory * 2**20)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    about = {
        "jscomb": jscomb.__version__,
        "method": chosen,
        "frame": path.name,
        "biased": name,
        "made from": made_from,
        "input": exr.read_provenance(path) if path.is_file() else {},
    }
    exr.write_image(out, combined, provenance=about)
    print(f"wrote {out}: {tables.size(loaded)}, {name} {chosen}")
    if loaded.reference is not None:
        images = {"input": loaded.color, name: image.image, chosen: combined}
        tables.print_table({"relative L2": tables.errors(images, loaded)})


def _made(found: tiles.Local, memory: int) -> Image:
    """A combination; of a large frame by crops, of which each keeps to the memory."""
    first = jax.tree.leaves(found.images)[0]
    height, width = first.shape[:2]
    if height * width <= LARGE:
        return found.function(found.images)
    tile = tiles.tile_within(**found._asdict(), budget=memory)
    made = np.empty((height, width, 3), np.float32)
    parts = tiles.stream_crops(**found._asdict(), tile=tile)
    count = -(-height // tile) * -(-width // tile)
    for where, part in tqdm(parts, total=count, unit="crop", disable=None):
        made[where] = part
    return jnp.asarray(made)


def choose(frame: Frame, name: str, budget: float | None) -> str:
    """The method that the half buffers choose; says why."""
    found = choice.choose(_sampled(frame), name=name, budget=budget)
    if not found.trials:
        print("without half buffers of both images it is not known whether this helps")
    for trial in found.trials:
        print(f"by the half buffers, {trial.method:<12}{_said(trial)}")
    return found.method


def _sampled(frame: Frame) -> Frame:
    """The frame; of a large one four pieces put together, which tell as much."""
    height, width = frame.color.shape[:2]
    if height * width <= LARGE or min(height, width) < 2 * SAMPLED:
        return frame
    of = lambda size: np.concatenate(
        [np.arange(SAMPLED) + (k * size - 2 * SAMPLED) // 4 for k in (1, 3)]
    )
    rows, columns = of(height), of(width)
    cut = lambda leaf: leaf[..., rows, :, :][..., columns, :] if leaf.ndim > 2 else leaf
    return jax.tree.map(cut, frame)


def _said(trial: choice.Trial) -> str:
    """What was found out about a method, in a line."""
    if trial.change is None:
        return f"is not known: {trial.reason}"
    mean, error = map(float, trial.change)
    late = f", but {trial.reason}" if trial.reason else ""
    return f"adds {mean:+.2g} +- {error:.1g} relative L2{late}"


def _biased_image(path: Path, frame: Frame, choice: str | None) -> tuple[str, Estimate]:
    """Name and image of what to combine with."""
    held = ", ".join(frame.estimates) or "none"
    if choice in frame.estimates:
        return choice, frame.estimates[choice]
    if choice is not None:
        if not os.path.exists(choice):
            raise ValueError(
                f"--biased {choice}: neither a file nor a biased image in {path} "
                f"(it holds {held})"
            )
        image = exr.read_image(choice)
        if image.shape != frame.color.shape:
            raise ValueError(f"{choice} is {image.shape}, {path} {frame.color.shape}")
        return Path(choice).name, Estimate(image)
    if len(frame.estimates) > 1:
        raise ValueError(f"{path} holds several biased images, choose --biased: {held}")
    for name, image in frame.estimates.items():
        return name, image
    if not oidn.available():
        raise ImportError(
            f"{path} holds no biased image: give --biased FILE, or pip install "
            '"jscomb[oidn]" to denoise it here'
        )
    return "oidn", oidn.denoise_frame(frame)
