"""Frames to train on: random scenes, each at some sample counts, with a reference.

Every frame is an EXR file by `jscomb render`: two half buffers with variances
and features, Open Image Denoise of the frame and of its halves, and a reference. The
sample counts of a scene are drawn from powers of two between 4 and 256 and its frames
share one reference; their noise is independent of it and of each other. The same
command resumes an interrupted run, and with more scenes adds to the existing ones.

A reference of 1024 samples is itself noisy, which does not matter to a squared error:
with a reference r + e, E[e] = 0 and e independent of the inputs, the expected loss is
that of r plus the variance of e, whatever the network's output, so its gradient is
unbiased. It is slightly biased for absolute errors, and by the weights that a relative
error takes from r; less so with more samples.
"""

import concurrent.futures
import dataclasses
import multiprocessing
import pathlib
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import tool
from jscomb.cli import render_file
from jscomb.denoisers import oidn
from jscomb.rendering import Settings

COUNTS = (4, 8, 16, 32, 64, 128, 256)
SCENES_A_PROCESS = 10
STREAMS = 100_000  # difference of the seeds of one scene's frames


@dataclasses.dataclass(frozen=True)
class Config:
    """Which frames.

    Attributes:
        out: folder of the frames.
        scenes: how many scenes.
        counts: sample counts of each.
        size: width and height in pixels.
        reference_spp: samples a pixel of each scene's reference.
        seed: of the first scene; the others' follow.
    """

    out: tyro.conf.Positional[pathlib.Path]
    scenes: int = 100
    counts: int = 2
    size: int = 128
    reference_spp: int = 1024
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise for options out of range."""
        if not 1 <= self.counts <= len(COUNTS):
            raise ValueError(f"counts must be 1 to {len(COUNTS)}, got {self.counts}")
        if self.scenes < 1 or self.reference_spp < 1024:
            raise ValueError(
                "dataset wants at least one scene and references of at least 1024 "
                f"samples, got {self.scenes} and {self.reference_spp}"
            )


class Job(NamedTuple):
    """One frame's scene, file, settings, and the file that holds its reference."""

    scene: str
    out: pathlib.Path
    settings: Settings
    reference_from: pathlib.Path | None


def jobs(config: Config, scene: int) -> Iterator[Job]:
    """Return what to render of one scene; the first frame's reference is shared.

    Args:
        config: which frames.
        scene: seed of the scene.

    Yields:
        one frame each, most samples first.
    """
    rng = np.random.default_rng([scene, 0xC0417])
    counts = sorted(rng.choice(COUNTS, config.counts, replace=False), reverse=True)
    first = None
    for number, spp in enumerate(counts):
        out = config.out / f"random-{scene:05d}-{spp}.exr"
        settings = Settings(
            spp=int(spp),
            size=config.size,
            reference_spp=0 if first else config.reference_spp,
            seed=number * STREAMS,
        )
        yield Job(f"random-{scene}", out, settings, first)
        first = first or out


def run(config: Config) -> list[pathlib.Path]:
    """Render the frames that do not exist yet.

    Args:
        config: which frames.

    Returns:
        all frames' files.

    Raises:
        ImportError: without Open Image Denoise.
        RuntimeError: if the renderer crashed; the same command resumes.
    """
    if not oidn.available():
        raise ImportError('a dataset needs a denoiser: pip install "jscomb[oidn]"')
    config.out.mkdir(parents=True, exist_ok=True)
    start, seeds = time.monotonic(), range(config.seed, config.seed + config.scenes)
    every = {seed: list(jobs(config, seed)) for seed in seeds}
    todo = {s: [f for f in fs if not f.out.exists()] for s, fs in every.items()}
    # One process for a few scenes: Dr.Jit keeps every scene's compiled code, and was
    # observed to crash after about ninety.
    with concurrent.futures.ProcessPoolExecutor(
        max_workers=1,
        mp_context=multiprocessing.get_context("spawn"),
        max_tasks_per_child=SCENES_A_PROCESS,
    ) as process:
        rendered = process.map(_render_all, filter(None, todo.values()))
        missing = sum(map(bool, todo.values()))
        made = sum(tqdm(rendered, total=missing, unit="scene", desc="dataset"))
    files = [frame.out for frames in every.values() for frame in frames]
    megabytes = sum(f.stat().st_size for f in files) / 1e6
    minutes = (time.monotonic() - start) / 60
    print(f"{len(files)} frames, {megabytes:.0f} MB; {made} made in {minutes:.1f} min")
    return files


def _render_all(frames: list[Job]) -> int:
    """Render frames, and return how many."""
    for scene, out, settings, reference in frames:
        render_file(scene, out, settings, reference_from=reference)
    return len(frames)


if __name__ == "__main__":
    tool(Config, run)
