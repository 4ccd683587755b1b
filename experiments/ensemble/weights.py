"""What does an ensemble of denoisers gain, and by which part of it?

Every frame of the folders (`archives`). Bases: Open Image Denoise with and without
features, joint bilateral, non-local means, RDFC and NFOR; and the unbiased image. Of
each base and method: relative L2, less the reference's noise, of normalised frames,
divided by that of the best base; structural dissimilarity (DSSIM) after tone mapping,
divided likewise; the share of pixels that are fireflies, see `errors.fireflies`; and
time. Methods: the plain average, one-hot choices, weights of single pixels, windows,
the frame and all scales, filtered or not, of each channel or shared, of at least zero
or either sign, and with the unbiased image among the bases.

No constant of these methods was set on frames of the data set (`test`, `validate`); the
windows of multi-scale weights were set on other renderings of the archives' scenes.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping

import numpy as np
import tyro

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.errors import Row
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.ensemble import methods
from experiments.ensemble.bases import BASES, bases_of, best, measured, unbiased_of
from experiments.ensemble.methods import METHODS, OURS, PAPER, Inputs, Method
from jscomb import ensemble
from jscomb.frame import Frame
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folders: of NumPy archives or EXR frames.
        results: file that results are kept in; None to keep none.
        repeats: timed calls of each method.
    """

    folders: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    results: pathlib.Path | None = None
    repeats: int = 1


SELECTED, NOISY = "selected", "path tracing"
SECONDS, DSSIM, FIREFLIES = ", seconds", ", DSSIM", ", fireflies"
WITH_UNBIASED = PAPER, "31x31", "frame", OURS, "multi-scale, filtered"
ALL = *METHODS, *(f"{name} and x" for name in WITH_UNBIASED), SELECTED
PAIRS = (
    ("fig. 4", methods.EITHER, methods.UNFILTERED),
    ("fig. 4", methods.EITHER_FILTERED, PAPER),
    ("fig. 5", methods.ITERATIVE, PAPER),
    ("fig. 7", methods.UNFILTERED, methods.SHARED_UNFILTERED),
    ("fig. 7", PAPER, methods.SHARED),
    ("fig. 7", methods.EACH_CHANNEL, OURS),
    ("fig. 8", PAPER, methods.UNFILTERED),
    ("fig. 8", "multi-scale, filtered", OURS),
    ("the authors' program", methods.BLURRED, PAPER),
    ("the authors' program", methods.CLIPPED, PAPER),
    ("the authors' program", methods.STANDARD, PAPER),
    ("the authors' program", methods.ALL_THREE, PAPER),
    ("fig. 9", PAPER, methods.AVERAGE),
    ("fig. 10", PAPER, methods.CROSS),
    ("fig. 10", PAPER, methods.MEANS),
    ("fig. 10", PAPER, methods.AFTER),
    ("eq. 22-26", f"{PAPER} and x", PAPER),
    ("ours", OURS, PAPER),
    ("ours", OURS, methods.AFTER),
)


def judged(name: str, image: Image, frame: Frame) -> dict[str, float]:
    """All that is measured of an image, under its name."""
    return {
        name: errors.relative_l2(image, frame),
        name + DSSIM: errors.dssim(image, frame),
        name + FIREFLIES: errors.fireflies(image, frame),
    }


def measure(frame: Frame, repeats: int) -> dict[str, float]:
    """The bases and all methods of one normalised frame."""
    bases = bases_of(frame)
    row = judged(NOISY, frame.color, frame)
    for name, base in bases.items():
        row |= judged(name, base.image, frame)
    some = methods.inputs_of(frame, bases)
    more = methods.inputs_of(frame, bases | {"x": unbiased_of(frame)})

    def add(name: str, method: Method, given: Inputs) -> None:
        nonlocal row
        call = functools.partial(method, given)
        row |= judged(name, call(), frame)
        row[name + SECONDS] = medians({name: call}, repeats)[name]

    for name, method in METHODS.items():
        add(name, method, some)
        if name in WITH_UNBIASED:
            add(f"{name} and x", method, more)
    select = lambda: ensemble.select_bases(*some.halves).kept
    chosen = [list(BASES)[k] for k in select()]
    needed = methods.inputs_of(frame, {name: bases[name] for name in chosen})
    add(SELECTED, METHODS[OURS], needed)
    row["selecting" + SECONDS] = medians({"": select}, 1)[""]
    row["selected, number"] = len(chosen)
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        numbers by "folder/scene samples" and method.

    Raises:
        ValueError: if a folder holds no frame.
    """
    of = functools.partial(measure, repeats=1 if config.quick else config.repeats)
    return measured(config.folders, of, results=config.results, quick=config.quick)


def best_dssim(row: Row) -> float:
    """Dissimilarity of the best base."""
    return min(row[base + DSSIM] for base in BASES)


def share(some: np.ndarray) -> str:
    """How many of these are true, in per cent."""
    return f"{np.mean(some):.0%}"


def pairs(rows: Mapping[str, Row]) -> str:
    """Each of two methods' errors over the other's, and how often it is below."""
    cells = []
    for where, one, other in PAIRS:
        cell = [where, one, other]
        for kind in ("", DSSIM):
            ratios = np.array([r[one + kind] / r[other + kind] for r in rows.values()])
            cell += [errors.geometric_mean(ratios), share(ratios < 1)]
        cells.append(cell)
    header = ["in the paper", "one", "other", "relative L2: one / other"]
    header += ["frames below", "DSSIM: one / other", "frames below"]
    return table(header, cells)


def by_folder(rows: Mapping[str, Row]) -> str:
    """Means of each folder's frames by themselves."""
    folders = sorted({name.partition("/")[0] for name in rows})
    of = lambda f: [r for name, r in rows.items() if name.partition("/")[0] == f]
    mean = lambda name, f: errors.geometric_mean(r[name] / best(r) for r in of(f))
    some = (methods.AVERAGE, methods.AFTER, methods.UNFILTERED, PAPER, OURS, SELECTED)
    cells = ([name, *(mean(name, f) for f in folders)] for name in some)
    header = [f"{f}, {len(of(f))} frames" for f in folders]
    return table(["error / best base", *header], cells)


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        means beside times, pairs of methods, folders, and every frame.
    """
    every = list(rows.values())

    def time(name: str, unit: str = methods.AVERAGE) -> float | None:
        if name in BASES:
            return None
        return float(np.median([r[name + SECONDS] / r[unit + SECONDS] for r in every]))

    def dissimilar(name: str) -> float:
        return errors.geometric_mean(r[name + DSSIM] / best_dssim(r) for r in every)

    def bright(name: str) -> str:
        return f"{100 * np.mean([r[name + FIREFLIES] for r in every]):.3f}"

    def said(name: str) -> str:
        ratios = [r[name] / best(r) for r in every]
        low = share(np.array(ratios) < 1)
        mean = errors.geometric_mean(ratios)
        return f"{mean:.2f} (worst {max(ratios):.2f}; below 1 in {low} of the frames)"

    number = np.mean([row["selected, number"] for row in every])
    answer = (
        f"Over {len(rows)} frames an ensemble of {len(BASES)} bases has, in relative "
        f"L2 over that of the frame's best base (geometric means), {said(PAPER)} with "
        f"the paper's weights of single pixels, filtered, in {time(PAPER):.0f} times "
        f"the plain average's time; {said(methods.UNFILTERED)} with these unfiltered; "
        f"{said(OURS)} with multi-scale weights in {time(OURS):.0f} times; "
        f"{said(SELECTED)} with the {number:.1f} bases that `select_bases` leaves. Of "
        f"either sign at single pixels it is {said(methods.EITHER)}, with "
        f"{bright(methods.EITHER)} % of the pixels fireflies, "
        f"{bright(methods.UNFILTERED)} % at least zero."
    )
    shown = [methods.AVERAGE, methods.AFTER, methods.UNFILTERED, PAPER, OURS, SELECTED]
    frames = (
        [
            frame,
            *(row[n] for n in (NOISY, *BASES)),
            *(row[n] / best(row) for n in shown),
        ]
        for frame, row in rows.items()
    )
    tables = [
        errors.means(
            rows,
            [*BASES, *ALL],
            best,
            title="error / best base",
            beside={
                "DSSIM / best base": dissimilar,
                "fireflies, %": bright,
                "time / average": time,
            },
        ),
        f"Columns by samples a pixel have different scenes. Fireflies of the noisy "
        f"image: {bright(NOISY)} %.",
        "Two methods: geometric means over frames, and frames where one is below.",
        pairs(rows),
        by_folder(rows),
        "Every frame: errors of path tracing and of the bases, then ratios to the best "
        "base.",
        table(["frame", NOISY, *BASES, *shown], frames),
    ]
    return Report(answer, "\n\n".join(tables))


if __name__ == "__main__":
    main(Config, run, report)
