"""Make the frames that come with the package, and the small ones that the tests use.

Renders the glass scene with 64, 256 and 1024 samples a pixel and a reference of 32768,
and the plain scene with 64 and 4096, into the work folder (resumable, about 12 minutes
on two cores with LLVM). Writes `jscomb/data/`: two frames with two sub-buffers, and a
part of the third, for `jscomb demo`, with all four; in 16 bits where no error is
measured. Writes 64x64 crops with all four to `tests/data/`, beside small frames of
random scenes of the test split of `experiments.data.dataset`, photon mapped too.
Crops are cut from frames that were denoised whole (`tests/data/README.md`).
"""

import dataclasses
import functools
import pathlib
from collections.abc import Iterator
from typing import Any

import jax

from experiments.common.command import tool
from jscomb import exr
from jscomb.cli import render_file
from jscomb.frame import Frame
from jscomb.rendering import PHOTONS, Settings

ROOT = pathlib.Path(__file__).parents[2]
HALF = ("albedo", "normal", "depth", "visibility", "estimate_halves", "half_difference")
# Top and left of each crop.
CAUSTIC, BOX = (112, 96), (64, 40)  # under the glass sphere; the back of a box
CROPS = {
    "cornell-glass-64": CAUSTIC,
    "cornell-glass-1024": CAUSTIC,
    "cornell-box-64": BOX,
}
CROP = 64
DEMO = (58, 36, 128)  # top, left and side: the boxes, the sphere and their floor
UNSEEN = ("random-3001", "random-3004", "random-3007")  # no network is trained on them
UNSEEN_SPP = (256, 16)  # the first brings the reference and the photon-mapped image


@dataclasses.dataclass(frozen=True)
class Config:
    """Where to render.

    Attributes:
        work: folder for the rendered frames; finished ones are not rendered again.
        size: width and height in pixels.
        buffers: sub-buffers to render.
    """

    work: pathlib.Path
    size: int = 192
    buffers: int = 4


def run(config: Config) -> list[pathlib.Path]:
    """Render what is missing, then write all bundled files.

    Args:
        config: where to render.

    Returns:
        the files written.
    """
    config.work.mkdir(parents=True, exist_ok=True)
    of = functools.partial(Settings, size=config.size, buffers=config.buffers)
    glass = config.work / "cornell-glass-1024.exr"
    shown = config.work / "cornell-glass-256.exr"
    recipes = {
        glass: (of(spp=1024, seed=10_000, reference_spp=32_768), None),
        config.work / "cornell-glass-64.exr": (of(spp=64), glass),
        shown: (of(spp=256, seed=20_000), glass),
        config.work / "cornell-box-64.exr": (of(spp=64, reference_spp=4096), None),
    }
    written = []
    for out, (settings, reference) in recipes.items():
        if not out.exists():
            scene = out.stem.rpartition("-")[0]
            render_file(scene, out, settings, reference_from=reference)
        frame, provenance = exr.read_frame(out), exr.read_provenance(out)
        targets = {}
        if out.stem.startswith("cornell-glass"):
            # Of the demo's a part, with all sub-buffers.
            part = crop(frame, *DEMO) if out == shown else frame.merged(2)
            targets[ROOT / "jscomb" / "data" / out.name] = part
        if out.stem in CROPS:
            targets[ROOT / "tests" / "data" / out.name] = crop(frame, *CROPS[out.stem])
        for path, kept in targets.items():
            written.append(_write(path, kept, provenance))
    return written + [path for scene in UNSEEN for path in _unseen(config, scene)]


def _unseen(config: Config, scene: str) -> Iterator[pathlib.Path]:
    """Render a scene's small frames, which share a reference and the photons."""
    first = None
    for number, spp in enumerate(UNSEEN_SPP):
        out = config.work / f"{scene}-{spp}.exr"
        more = {"reference_spp": 16_384, "photons": 100_000, "passes": 16}
        settings = Settings(
            spp=spp,
            size=CROP,
            buffers=config.buffers,
            seed=number * 10**6,
            **({} if first else more),
        )
        if not out.exists():
            render_file(scene, out, settings, reference_from=first)
        frame = exr.read_frame(out)
        if first:
            photons = exr.read_frame(first).estimates[PHOTONS]
            frame = frame.with_estimate(PHOTONS, photons)
        first = first or out
        path = ROOT / "tests" / "data" / f"unseen-{out.name}"
        yield _write(path, frame, exr.read_provenance(out))


def _write(path: pathlib.Path, frame: Frame, provenance: Any) -> pathlib.Path:
    """Write a file, features and halves of estimates in 16 bits, and say its size."""
    path.parent.mkdir(exist_ok=True)
    exr.write_frame(path, frame, provenance=provenance, half=HALF)
    print(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1e6:.2f} MB")
    return path


def crop(frame: Frame, top: int, left: int, side: int = CROP) -> Frame:
    """A square of some pixels of every image of a frame."""
    rows, columns = slice(top, top + side), slice(left, left + side)
    return jax.tree.map(lambda a: a[..., rows, columns, :] if a.ndim > 2 else a, frame)


if __name__ == "__main__":
    tool(Config, run)
