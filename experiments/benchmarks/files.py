"""What do reading and writing of multi-layer files cost, beside plain OpenEXR?

A frame of 3840x2160 pixels with 70 channels of 16 bits, ZIP compressed: colour, alpha,
albedo, normal, depth, variance, and layers that make no frame. Plain OpenEXR decodes
the same channels, or all of them, into arrays, and writes them again. The functions
take turns; the memory is the most that a process of its own held, less what it held
before.
"""

import dataclasses
import os
import pathlib
import tempfile
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import OpenEXR

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import apart, medians
from jscomb import exr

LAYERS = {"": "RGBAZ", "albedo": "RGB", "N": "XYZ", "mse": "RGB"}
NEEDED = [f"{n}.{c}" if n else c for n, each in LAYERS.items() for c in each]


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        width: in pixels.
        height: in pixels.
        channels: of the file.
        repeats: timed calls of each function.
    """

    width: int = 3840
    height: int = 2160
    channels: int = 70
    repeats: int = 3


class Row(NamedTuple):
    """One way to read or write.

    Attributes:
        seconds: median.
        memory: mebibytes that it took.
    """

    seconds: float
    memory: float


def run(config: Config) -> dict[str, Row]:
    """Read and write one file in every way.

    Args:
        config: what to measure.

    Returns:
        cost by the name of the way.
    """
    if config.quick:
        config = dataclasses.replace(
            config, width=64, height=48, channels=20, repeats=1
        )
    with tempfile.TemporaryDirectory() as folder:
        path = make_file(pathlib.Path(folder), config)
        memory = {name: apart(memory_of, name, path) for name in WAYS}
        functions = {name: lambda name=name: WAYS[name](path) for name in WAYS}
        seconds = medians(functions, config.repeats)
    return {name: Row(seconds[name], memory[name]) for name in WAYS}


def make_file(folder: pathlib.Path, config: Config) -> str:
    """Write the file.

    Args:
        folder: for it.
        config: its size.

    Returns:
        its path.
    """
    random = np.random.default_rng(0)
    noise = random.integers(64, size=(3, config.height, config.width)) / 64
    planes = noise.astype(np.float16)
    others = [f"layer{n:02}.R" for n in range(config.channels - len(NEEDED))]
    names = [*NEEDED, *others]
    channels = {name: planes[number % 3] for number, name in enumerate(names)}
    path = os.fspath(folder / "frame.exr")
    _write(path, {"compression": OpenEXR.ZIP_COMPRESSION}, channels)
    return path


def memory_of(name: str, path: str) -> float:
    """Measure the memory of one way, in this process.

    Args:
        name: of the way.
        path: file to read.

    Returns:
        mebibytes.
    """
    exr.read_frame(exr.bundled()["cornell-glass-64"])  # JAX has started
    pathlib.Path("/proc/self/clear_refs").write_text("5")  # forget the most so far
    before = _most_memory()
    WAYS[name](path)
    return _most_memory() - before


def _most_memory() -> float:
    """Return the most mebibytes that this process held."""
    status = pathlib.Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def _write(path: str, header: dict, channels: dict) -> None:
    """Write one part by plain OpenEXR."""
    header = {**header, "type": OpenEXR.scanlineimage}
    OpenEXR.File([OpenEXR.Part(header, channels, "")]).write(path)


def _plain_some(path: str) -> list[bytes]:
    """Decode what a frame needs by plain OpenEXR."""
    return OpenEXR.InputFile(path).channels(NEEDED)


def _plain_all(path: str) -> OpenEXR.File:
    """Decode all channels by plain OpenEXR."""
    return OpenEXR.File(path, separate_channels=True)


def _plain_copy(path: str) -> None:
    """Decode all channels, and write them again."""
    (part,) = _plain_all(path).parts
    _write(path + ".plain.exr", dict(part.header), dict(part.channels))


def _frame(path: str) -> exr.Contents:
    """Read the frame."""
    return exr.read_contents(path)


def _everything(path: str) -> exr.Contents:
    """Read the frame and all other channels."""
    return exr.read_contents(path, everything=True)


def _copy(path: str) -> None:
    """Read everything, and write it with another colour."""
    contents = _everything(path)
    exr.write_contents(path + ".ours.exr", contents, np.asarray(contents.image))


WAYS: dict[str, Callable[[str], object]] = {
    "OpenEXR, what a frame needs": _plain_some,
    "jscomb, a frame": _frame,
    "OpenEXR, all channels": _plain_all,
    "jscomb, a frame and all channels": _everything,
    "OpenEXR, all read and written": _plain_copy,
    "jscomb, all read and written": _copy,
}
"""By name; one of OpenEXR's, then ours for the same."""


def report(found: dict[str, Row]) -> Report:
    """Say what it costs.

    Args:
        found: by `run`.

    Returns:
        seconds, memory, and ratios to plain OpenEXR.
    """
    rows, ratios, names = [], [], list(found)
    for plain, ours in zip(names[::2], names[1::2], strict=True):
        ratio = found[ours].seconds / found[plain].seconds
        ratios.append(ratio)
        rows.append([plain, *found[plain], None])
        rows.append([ours, *found[ours], ratio])
    shown = [
        [name, f"{seconds:.2f}", f"{memory:.0f}", ratio and f"{ratio:.2f}"]
        for name, seconds, memory, ratio in rows
    ]
    frame, all_, copy = (f"{ratio:.2f}" for ratio in ratios)
    answer = (
        f"Reading a frame takes {frame} times as long as decoding its channels by "
        f"OpenEXR alone, with all other channels {all_} times, and reading and writing "
        f"everything {copy} times."
    )
    head = ["", "s", "MiB", "times OpenEXR"]
    return Report(answer, table(head, shown))


if __name__ == "__main__":
    main(Config, run, report)
