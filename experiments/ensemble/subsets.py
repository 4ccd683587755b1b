"""Which bases together, and is an ensemble better than one base a pixel?

Every frame of the folders (`archives`), every subset of two or more of the six bases.
Of each: relative L2, less the reference's noise, and structural dissimilarity (DSSIM),
of the paper's weights, of multi-scale ones, of the plain average, and of the base of
minimum estimated error at each pixel, with errors filtered before (cross-bilateral, or
by non-local means) or the selection after. A case is a subset on a frame. The paper has
eight bases, 31 subsets and 30 scenes.

Scores are as in the paper's table 3: on each frame as many points as there are
candidates (the noisy image, the bases, all subsets) for the least error, 1 for the
largest; means over the frames of a sample count, then over sample counts.
"""

import dataclasses
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import tyro

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.errors import Row
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.ensemble import methods
from experiments.ensemble.bases import BASES, bases_of, measured
from experiments.ensemble.methods import AFTER, AVERAGE, CROSS, MEANS, OURS, PAPER
from jscomb.frame import Frame

NOISY, DSSIM = "path tracing", ", DSSIM"
SUBSETS = {
    " + ".join(some): some
    for count in range(2, len(BASES) + 1)
    for some in itertools.combinations(BASES, count)
}
FORMS = AVERAGE, CROSS, MEANS, AFTER, PAPER, OURS
GROWING = "oidn-color + rdfc", "oidn + oidn-color + rdfc", "oidn + rdfc"
GROWING += "oidn + oidn-color + rdfc + nfor", "oidn + bilateral + rdfc + nfor"
GROWING += "oidn + oidn-color + bilateral + rdfc + nfor", " + ".join(BASES)
FEW = "oidn + rdfc"  # the paper's less successful case, at 4 samples


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folders: of NumPy archives or EXR frames.
        results: file that results are kept in; None to keep none.
    """

    folders: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    results: pathlib.Path | None = None


def measure(frame: Frame) -> dict[str, float]:
    """Errors of the bases and of all subsets of one normalised frame."""
    bases = bases_of(frame)
    images = {NOISY: frame.color} | {n: base.image for n, base in bases.items()}
    for name, some in SUBSETS.items():
        given = methods.inputs_of(frame, {base: bases[base] for base in some})
        images |= {f"{name}: {f}": methods.METHODS[f](given) for f in FORMS}
    row = {name: errors.relative_l2(image, frame) for name, image in images.items()}
    row |= {name + DSSIM: errors.dssim(image, frame) for name, image in images.items()}
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors by "folder/scene samples" and image.

    Raises:
        ValueError: if a folder holds no frame.
    """
    return measured(config.folders, measure, results=config.results, quick=config.quick)


def scores(rows: Sequence[Row], names: Sequence[str]) -> dict[str, float]:
    """Mean score of each candidate: as many as there are for the best, 1 for the worst.

    Args:
        rows: errors of each frame by candidate.
        names: of the candidates.

    Returns:
        the scores by name, the best first.
    """
    each = np.array([[row[name] for name in names] for row in rows])
    ranks = each.argsort(axis=1).argsort(axis=1)
    mean = (len(names) - ranks).mean(axis=0)
    found = dict(zip(names, mean.tolist(), strict=True))
    return dict(sorted(found.items(), key=lambda each: -each[1]))


def scored(
    rows: Mapping[str, Row], form: str, kind: str = ""
) -> dict[str, dict[object, float]]:
    """Scores of the noisy image, the bases and all subsets in one form.

    Args:
        rows: by "folder/scene samples".
        form: of the ensembles.
        kind: of the error; "" for relative L2.

    Returns:
        scores by samples, and "mean" over these, by candidate, the best first.
    """
    labels = {name: name + kind for name in (NOISY, *BASES)}
    labels |= {name: f"{name}: {form}{kind}" for name in SUBSETS}
    groups = errors.by_samples(rows)
    each = {s: scores(some, [*labels.values()]) for s, some in groups.items()}
    found: dict[str, dict[object, float]] = {}
    for name, label in labels.items():
        of = {samples: score[label] for samples, score in each.items()}
        found[name] = {**of, "mean": float(np.mean([*of.values()]))}
    return dict(sorted(found.items(), key=lambda item: -item[1]["mean"]))


def share(rows: Sequence[Row], count: int, won: Callable[[Row, str], bool]) -> float:
    """The share of cases of so many bases that are won; of any number if 0."""
    some = [n for n, bases in SUBSETS.items() if count in (0, len(bases))]
    return float(np.mean([won(row, name) for row in rows for name in some]))


def beats(form: str, *others: str, kind: str = "") -> Callable[[Row, str], bool]:
    """Whether one form of a subset has less error than all others."""
    of = lambda row, name, f: row[f"{name}: {f}{kind}"]
    return lambda row, name: (
        of(row, name, form) < min(of(row, name, other) for other in others)
    )


def beats_bases(form: str, kind: str = "") -> Callable[[Row, str], bool]:
    """Whether a subset has less error than each of its own bases."""
    return lambda row, name: (
        row[f"{name}: {form}{kind}"] < min(row[base + kind] for base in SUBSETS[name])
    )


def rates(rows: Mapping[str, Row], won: Callable[[Row, str], bool]) -> str:
    """Shares of cases won by number of bases and samples, in per cent."""
    groups = {**errors.by_samples(rows), "all": [*rows.values()]}
    cells = (
        [
            number or "all",
            *(f"{100 * share(g, number, won):.1f}" for g in groups.values()),
        ]
        for number in (*range(2, len(BASES) + 1), 0)
    )
    return table(["bases", *groups], cells)


def over(rows: Mapping[str, Row], subset: str, title: str) -> str:
    """Errors of all forms of a subset over its best base's, by samples."""
    best = lambda row: min(row[base] for base in SUBSETS[subset])
    named = {
        name: {form: row[f"{subset}: {form}"] for form in FORMS} | {"best": best(row)}
        for name, row in rows.items()
    }
    return errors.means(named, FORMS, lambda row: row["best"], title=title)


def growth(rows: Mapping[str, Row]) -> str:
    """Table 3: the bases and some ensembles, the means of all of a size."""
    found = scored(rows, PAPER)
    columns = [*next(iter(found.values()))]
    cells = [[n, *(found[n][c] for c in columns)] for n in (NOISY, *BASES, *GROWING)]
    for number in range(2, len(BASES) + 1):
        some = [found[n] for n, bases in SUBSETS.items() if len(bases) == number]
        means = [float(np.mean([s[c] for s in some])) for c in columns]
        cells.append([f"mean of all of {number}", *means])
    return table(["score of", *columns], cells)


def ranking(rows: Mapping[str, Row]) -> str:
    """Fig. 14: all candidates, by both errors and both kinds of weights."""
    kinds = {
        f"{form}{kind}": (form, kind) for form in (PAPER, OURS) for kind in ("", DSSIM)
    }
    each = {title: scored(rows, *kind) for title, kind in kinds.items()}
    first = next(iter(each.values()))
    return table(
        ["candidate", *each],
        [[name, *(found[name]["mean"] for found in each.values())] for name in first],
    )


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        rates, errors over the best base's, and scores.
    """
    every, groups = [*rows.values()], errors.by_samples(rows)
    rate = lambda won: f"{100 * share(every, 0, won):.1f} %"
    said = lambda test: (
        f"{rate(test(PAPER))} (by DSSIM {rate(test(PAPER, DSSIM))}; multi-scale "
        f"weights {rate(test(OURS))}, {rate(test(OURS, DSSIM))})"
    )
    before = lambda form, kind="": beats(form, CROSS, MEANS, kind=kind)
    after = lambda form, kind="": beats(form, AFTER, kind=kind)
    found = {form: scored(rows, form) for form in (PAPER, OURS)}
    sizes = {n: len(bases) for n, bases in SUBSETS.items()}
    mean = lambda form, number: np.mean(
        [s["mean"] for n, s in found[form].items() if sizes.get(n) == number]
    )
    grown = lambda form: ", ".join(
        f"{mean(form, number):.1f}" for number in range(2, len(BASES) + 1)
    )
    top = {form: next(iter(by_name)) for form, by_name in found.items()}
    answer = (
        f"In {len(rows) * len(SUBSETS)} cases ({len(rows)} frames, {len(SUBSETS)} "
        f"subsets) the paper's ensemble has less relative L2 than both one-hot forms "
        f"that filter errors before in {said(before)}, than that which filters the "
        f"selection after in {said(after)}, and than each of its own bases in "
        f"{said(beats_bases)}. Mean scores of 2 to {len(BASES)} bases among "
        f"{len(found[PAPER])} candidates are {grown(PAPER)} (best: {top[PAPER]}), with "
        f"multi-scale weights {grown(OURS)} (best: {top[OURS]})."
    )
    least = min(groups)
    fails = ", ".join(
        f"{np.mean([not beats_bases(form)(r, FEW) for r in groups[least]]):.0%} "
        f"({form})"
        for form in (PAPER, OURS)
    )
    body = []
    for title, test in (
        ("both one-hot forms that filter errors before (table 1)", before),
        ("the one-hot form that filters the selection after (table 2)", after),
        ("each of its own bases (fig. 13)", beats_bases),
    ):
        for form in (PAPER, OURS):
            body += [f"Cases where `{form}` beats {title}, in per cent:"]
            body += [rates(rows, test(form))]
    body += [
        f"`{FEW}` at {least} samples: share of {len(groups[least])} frames where it is "
        f"worse than its best base, {fails}.",
        over(rows, FEW, f"{FEW}: error / best base"),
        over(rows, " + ".join(BASES), "all six: error / best base"),
        "Scores with the paper's weights, by relative L2.",
        growth(rows),
        "Scores of all candidates.",
        ranking(rows),
    ]
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
