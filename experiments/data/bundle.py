"""Make the frames that come with the package, and the crops that the tests use.

Renders the glass scene with 64 and with 1024 samples a pixel and a reference of 32768,
and the plain scene with 64 and 4096, into the work folder (resumable, about 12 minutes
on two cores with LLVM). Writes `jscomb/data/` with two sub-buffers, in 16 bits where no
error is measured, and 64x64 crops with all four to `tests/data/`.
"""

import dataclasses
import functools
import pathlib

import jax

from experiments.common.command import tool
from jscomb import exr
from jscomb.cli import render_file
from jscomb.frame import Frame
from jscomb.rendering import Settings

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
    recipes = {
        glass: (of(spp=1024, seed=10_000, reference_spp=32_768), None),
        config.work / "cornell-glass-64.exr": (of(spp=64), glass),
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
            targets[ROOT / "jscomb" / "data" / out.name] = frame.merged(2)
        if out.stem in CROPS:
            targets[ROOT / "tests" / "data" / out.name] = crop(frame, *CROPS[out.stem])
        for path, kept in targets.items():
            path.parent.mkdir(exist_ok=True)
            exr.write_frame(path, kept, provenance=provenance, half=HALF)
            print(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1e6:.2f} MB")
            written.append(path)
    return written


def crop(frame: Frame, top: int, left: int) -> Frame:
    """A square of `CROP` pixels of every image of a frame."""
    rows, columns = slice(top, top + CROP), slice(left, left + CROP)
    return jax.tree.map(lambda a: a[..., rows, columns, :] if a.ndim > 2 else a, frame)


if __name__ == "__main__":
    tool(Config, run)
