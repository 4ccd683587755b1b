"""Development frames: real scenes and our own, with four sub-buffers and references.

Every frame is an EXR file by `jscomb render`, `SCENE-SPP.exr`: four sub-buffers with
variances and features, and the scene's reference, whose samples no frame shares. The
same command resumes an interrupted run. A method, constant or network is judged on
these frames by leaving out the scene: what was set on a scene says nothing on it.

A reference is the mean of two halves, whose difference says how noisy it is:
`noise` prints the relative L2 of every reference's own noise, which
`metrics.rel_l2` subtracts from what it measures.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import tyro
from tqdm import tqdm

from experiments.common.command import tool
from experiments.common.processes import in_fresh_processes
from experiments.common.tables import table
from jscomb import exr
from jscomb.cli import render_file
from jscomb.frame import Frame
from jscomb.rendering import SCENES, Settings

COUNTS = (16, 64, 256, 1024)
STREAMS = 100_000  # difference of the seeds of one scene's frames
BUFFERS = 4


class Scene(NamedTuple):
    """What is rendered of a scene.

    Attributes:
        name: a folder with a scene.xml, or one of `rendering.SCENES`.
        width: in pixels.
        height: in pixels.
        reference_spp: samples a pixel of the reference.
        counts: sample counts of its frames.
    """

    name: str
    width: int
    height: int
    reference_spp: int = 8192
    counts: tuple[int, ...] = COUNTS


# The fast ones first.
DEVELOPMENT = (
    Scene("veach-mis", 208, 117, 32768, (*COUNTS, 4096)),
    Scene("cornell-box", 160, 160, 32768, (*COUNTS, 4096)),
    Scene("glass-of-water", 208, 117),
    Scene("cornell-glass", 160, 160),
    Scene("veach-bidir", 160, 160),
    Scene("bathroom", 160, 160),
    Scene("cornell-glossy", 160, 160),
    Scene("dining-room", 208, 117),
    Scene("staircase2", 160, 160),
    Scene("living-room-2", 208, 117),
    Scene("living-room", 208, 117),
)


@dataclasses.dataclass(frozen=True)
class Config:
    """Where the frames go.

    Attributes:
        out: folder of the frames.
        scenes: folder of the real scenes, a folder with a scene.xml each.
        quick: one of our own scenes, of 16x16 pixels.
    """

    out: tyro.conf.Positional[pathlib.Path]
    scenes: pathlib.Path
    quick: bool = False


def run(config: Config) -> list[pathlib.Path]:
    """Render the frames that do not exist yet.

    Args:
        config: where.

    Returns:
        all frames' files.

    Raises:
        ValueError: if a scene is missing.
        RuntimeError: if the renderer crashed; the same command resumes.
    """
    config.out.mkdir(parents=True, exist_ok=True)
    chosen = DEVELOPMENT
    if config.quick:
        chosen = (Scene("cornell-glossy", 16, 16, 64, (16,)),)
    for scene in chosen:
        _source(config, scene)  # a missing one is found before hours of rendering
    # One process a scene: Dr.Jit keeps compiled code as long as a process lives.
    made = in_fresh_processes(functools.partial(_render, config), chosen)
    files = list(tqdm(made, total=len(chosen), unit="scene", desc="development"))
    rows = [
        (s.name, s.reference_spp, noise(f[0]))
        for s, f in zip(chosen, files, strict=True)
    ]
    print(table(["scene", "samples of the reference", "its own relative L2"], rows))
    return [path for paths in files for path in paths]


def frames(folder: pathlib.Path) -> Iterator[tuple[str, int, pathlib.Path]]:
    """List the frames of a folder.

    Args:
        folder: that `run` wrote.

    Yields:
        scene, samples a pixel and file, by name and samples.

    Raises:
        ValueError: if it holds none.
    """
    found = []
    for path in folder.glob("*.exr"):
        scene, _, samples = path.stem.rpartition("-")
        if samples.isdecimal():
            found.append((scene, int(samples), path))
    if not found:
        raise ValueError(f"{folder}: no frames there; experiments.data.development")
    yield from sorted(found)


def noise(path: pathlib.Path) -> float:
    """Measure how noisy a frame's reference is.

    Args:
        path: of a frame.

    Returns:
        relative L2 of the reference's own noise, as of normalised frames.
    """
    frame: Frame = exr.read_frame(path).normalised()
    assert frame.reference is not None
    image, difference = frame.reference
    assert difference is not None
    square = jnp.square(difference / 2) / (jnp.square(image) + 0.01)
    return float(jnp.mean(square))


def _source(config: Config, scene: Scene) -> str:
    """What `jscomb render` is given: a file, or the name of an own scene."""
    path = config.scenes / scene.name / "scene.xml"
    if path.is_file():
        return str(path)
    if scene.name not in SCENES:
        raise ValueError(f"{path}: no such file; it is scene {scene.name}")
    return scene.name


def _render(config: Config, scene: Scene) -> list[pathlib.Path]:
    """Render a scene's reference and frames."""
    source, size = _source(config, scene), (scene.width, scene.height)
    of = lambda spp, **more: Settings(
        spp=spp, width=size[0], height=size[1], buffers=BUFFERS, **more
    )
    reference = config.out / f"{scene.name}-reference.exr"
    if not reference.exists():
        settings = of(2 * BUFFERS, reference_spp=scene.reference_spp)
        render_file(source, reference, settings, denoise=False)
    files = []
    for number, spp in enumerate(scene.counts, 1):
        out = config.out / f"{scene.name}-{spp}.exr"
        if not out.exists():
            settings = of(spp, seed=number * STREAMS)
            render_file(source, out, settings, reference_from=reference, denoise=False)
        files.append(out)
    return files


if __name__ == "__main__":
    tool(Config, run)
