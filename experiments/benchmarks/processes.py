"""What do several processes gain on a sequence of frames?

A frame is mirrored until it is as large as asked, and its file has several names, so
that reading takes no disk. The command `jscomb combine` makes all results in one
process, then each of several processes makes its share, on cores of its own as a
scheduler's array job does. A run before, which is not counted, compiles what there is
to compile.
"""

import dataclasses
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import NamedTuple

import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb import exr
from tests.battery.rendering import mirrored


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        frame: EXR file.
        size: width and height in pixels.
        frames: of the sequence.
        processes: how many share it.
        method: a tier or a method.
    """

    frame: tyro.conf.Positional[pathlib.Path]
    size: int = 512
    frames: int = 8
    processes: tuple[int, ...] = (1, 2)
    method: str = "balanced"


class Found(NamedTuple):
    """What one way took.

    Attributes:
        processes: that shared the sequence.
        cores: of each process.
        seconds: until the last one was done, start and files included.
        frames: of the sequence.
    """

    processes: int
    cores: int
    seconds: float
    frames: int


def shares(frames: Sequence[pathlib.Path], count: int) -> list[list[pathlib.Path]]:
    """Every count-th frame, from each of the first.

    Args:
        frames: of the sequence.
        count: of processes.

    Returns:
        the frames of each process.
    """
    return [[*frames[number::count]] for number in range(count)]


def combined(
    frames: Sequence[pathlib.Path], out: pathlib.Path, method: str, cores: set[int]
) -> subprocess.Popen:
    """Start the command on some frames and some cores."""
    bound = ["taskset", "--cpu-list", ",".join(map(str, cores))]
    words = [sys.executable, "-m", "jscomb", "combine", *map(str, frames)]
    return subprocess.Popen(
        [*bound, *words, "--method", method, "--quiet", "-o", f"{out}/"]
    )


def measure(
    frames: Sequence[pathlib.Path], out: pathlib.Path, method: str, count: int
) -> Found:
    """Combine a sequence by several processes.

    Args:
        frames: of the sequence.
        out: folder of the results, which is not there.
        method: a tier or a method.
        count: of processes.

    Returns:
        what it took.

    Raises:
        RuntimeError: if a process failed.
    """
    cores = sorted(os.sched_getaffinity(0))
    each = max(1, len(cores) // count)
    start = time.perf_counter()
    started = [
        combined(share, out, method, {*cores[number * each :][:each]} or {*cores})
        for number, share in enumerate(shares(frames, count))
    ]
    if any([process.wait() for process in started]):
        raise RuntimeError("jscomb combine failed; its message stands above")
    return Found(count, each, time.perf_counter() - start, len(frames))


def run(config: Config) -> list[Found]:
    """Measure all numbers of processes.

    Args:
        config: what to measure.

    Returns:
        what each took.
    """
    if config.quick:
        config = dataclasses.replace(config, size=96, frames=2, method="whitened")
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        frame = exr.read_frame(config.frame)._replace(estimates={}, reference=None)
        frames = [folder / f"{number:03}.exr" for number in range(config.frames)]
        exr.write_frame(frames[0], mirrored(frame, config.size))
        for path in frames[1:]:
            path.hardlink_to(frames[0])
        found = []
        for count in tqdm(config.processes, unit="way"):
            # Programs are kept by the number of cores that they are compiled for.
            measure(frames[:count], folder / f"first-{count}", config.method, count)
            out = folder / f"all-{count}"
            found.append(measure(frames, out, config.method, count))
    return found


def report(found: list[Found]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        frames a minute of each way.
    """
    rate = lambda each: 60 * each.frames / each.seconds
    first, *others = found
    gains = ", ".join(
        f"{each.processes} processes {rate(each) / rate(first):.2f} times"
        for each in others
    )
    answer = (
        f"One process combines {rate(first):.2f} frames a minute, {gains} as many "
        f"({first.frames} frames)."
    )
    header = "processes", "cores of each", "s", "frames a minute"
    rows = [[f.processes, f.cores, f.seconds, rate(f)] for f in found]
    return Report(answer, table(header, rows))


if __name__ == "__main__":
    main(Config, run, report)
