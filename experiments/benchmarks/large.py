"""What does a large frame cost, as a whole and by crops?

The frame is mirrored until it is as large as asked. Every method combines it by crops
that keep to a memory budget and, up to a size, as a whole: seconds of the second run,
the most memory that the process ever held (the frame included), and the largest
difference between the two, relative to the brightest pixel.
"""

import dataclasses
import pathlib
import resource
import time
from typing import NamedTuple

import jax
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import apart
from jscomb import exr, methods
from jscomb.frame import Frame
from jscomb.numerics import tiles
from tests.battery.rendering import mirrored


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        frame: EXR file with a biased image `oidn`.
        sizes: widths and heights in pixels.
        methods: of `jscomb.methods`.
        budget: mebibytes of a crop's program.
        whole: largest size that is also combined as a whole.
    """

    frame: tyro.conf.Positional[pathlib.Path]
    sizes: tuple[int, ...] = (1024, 2048, 8192)
    methods: tuple[str, ...] = ("whitened", "njs")
    budget: int = 512
    whole: int = 2048


class Row(NamedTuple):
    """One method at one size.

    Attributes:
        tile: width of its tiles in pixels.
        seconds: by crops.
        memory: mebibytes by crops.
        whole: seconds as a whole; None where that was left out.
        whole_memory: mebibytes as a whole, likewise.
        difference: relative to the brightest pixel, likewise.
    """

    tile: int
    seconds: float
    memory: float
    whole: float | None
    whole_memory: float | None
    difference: float | None


def enlarged(frame: Frame, size: int) -> Frame:
    """A frame of `size` x `size` pixels.

    Args:
        frame: smaller.
        size: in pixels.

    Returns:
        the frame, mirrored at its borders, as one buffer: four would fill the memory.
        Its biased image is without halves, so that no method makes it anew.
    """
    y = frame.estimates["oidn"]._replace(halves=None)
    alone = frame._replace(estimates={"oidn": y}, reference=None).merged(1)
    return mirrored(alone, size)


def measure(
    config: Config, size: int, method: str, whole: bool
) -> tuple[int, float, float, np.ndarray]:
    """One way of combining, in a process of its own.

    Args:
        config: frame and budget.
        size: in pixels.
        method: of `jscomb.methods`.
        whole: at once, not by crops.

    Returns:
        width of a tile, seconds, mebibytes, and the image.
    """
    frame = enlarged(exr.read_frame(config.frame), size)
    found = methods.plan(jax.random.key(0), frame, method=method, biased="oidn")
    tile = size
    if not whole:
        tile = tiles.tile_within(**found._asdict(), budget=config.budget * 2**20)
    made = np.empty((size, size, 3), np.float32)
    for _ in range(2):
        start = time.perf_counter()
        if whole:
            made[:] = found.whole()
        else:
            for where, part in tiles.stream_crops(**found._asdict(), tile=tile):
                made[where] = part
        seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return tile, seconds, peak, made


def run(config: Config) -> dict[tuple[str, int], Row]:
    """Measure everything.

    Args:
        config: what to measure.

    Returns:
        rows by method and size.
    """
    sizes = (256,) if config.quick else config.sizes
    rows = {}
    cases = [(method, size) for method in config.methods for size in sizes]
    for method, size in tqdm(cases, unit="case"):
        ways = (False, True) if size <= config.whole else (False,)
        found = [apart(measure, config, size, method, whole) for whole in ways]
        (tile, seconds, memory, image), *rest = found
        as_whole = None, None, None
        if rest:
            _, other, needed, same = rest[0]
            difference = float(np.max(np.abs(image - same)) / np.max(np.abs(same)))
            as_whole = other, needed, difference
        rows[method, size] = Row(tile, seconds, memory, *as_whole)
    return rows


def report(rows: dict[tuple[str, int], Row]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        a line for each method and size.
    """
    largest = max(size for _, size in rows)
    each = [
        f"{method} {row.seconds:.1f} s and {row.memory / 1024:.1f} GiB"
        for (method, size), row in rows.items()
        if size == largest
    ]
    apart = [row.difference for row in rows.values() if row.difference is not None]
    answer = (
        f"By crops {largest}x{largest} pixels take {', '.join(each)}, the frame "
        f"included; where both were done, crops and the whole differ by "
        f"{max(apart):.1g} of the brightest pixel at most."
    )
    header = "method", "size", "tile", "s", "MiB", "whole: s", "MiB", "difference"
    cells = [[method, size, *row] for (method, size), row in rows.items()]
    return Report(answer, table(header, cells))


if __name__ == "__main__":
    main(Config, run, report)
