"""What does an ensemble of denoisers gain, and by which part of it?

Every archive in the folder (`archives`), at every sample count. Bases: Open Image
Denoise with and without features, joint bilateral, Gaussian, non-local means and RDFC;
and the unbiased image. Relative L2, less the reference's noise, of normalised frames,
divided by that of the best base, and time: of the plain average, of one-hot choices, of
weights from single pixels, windows, the frame and all scales, filtered or not, with
each channel by itself, of either sign, and with the unbiased image among the bases.
Then every subset of the bases with the same method, ranked as in the paper's table 3.
Results are kept in the file as they come, and what is in it is not measured again.
"""

import dataclasses
import functools
import itertools
import pathlib
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.common import archives, errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.ensemble.bases import BASES, bases_of, unbiased_of
from jscomb import ensemble
from jscomb.denoisers import nonlocal_means
from jscomb.frame import Frame
from jscomb.numerics import simplex
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that results are kept in; None to keep none.
        repeats: timed calls of each method.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    repeats: int = 3


PAPER, OURS, SELECTED = "pixel, filtered (the paper)", "multi-scale", "selected"
SECONDS = ", seconds"


def combined(**options) -> Callable:
    """`ensemble.combine` with some options, compiled."""
    return jax.jit(
        lambda full, a, b, xa, xb, v, albedo, normal: ensemble.combine(
            full, a, b, xa, xb, albedo=albedo, normal=normal, **options
        )
    )


def selected(**options) -> Callable:
    """One base a pixel by eq. 36 and 37, compiled."""
    return jax.jit(
        lambda full, a, b, xa, xb, v, albedo, normal: ensemble.combine(
            *(full, a, b, xa, xb),
            solver="one-hot",
            variance_a=2 * v,
            variance_b=2 * v,
            albedo=albedo,
            normal=normal,
            **options,
        )
    )


def weighed(weigh: Callable) -> Callable:
    """The ensemble with weights from the halves, compiled."""
    return jax.jit(
        lambda full, *rest: ensemble.average(
            full, jnp.broadcast_to(weigh(*rest[:4]), full.shape)
        )
    )


def over(*windows: int, whole_frame: bool = False) -> Callable:
    """Weights of least error over one window, or the frame."""
    return lambda *halves: simplex.quadratic(
        ensemble.error_matrix(*halves, windows=windows, whole_frame=whole_frame)
    )


def one_hot(window: int) -> Callable:
    """The base of least error over a window, of all channels and relative."""

    def weigh(*halves):
        matrix = ensemble.error_matrix(*halves, windows=(window,), whole_frame=False)
        return ensemble.one_hot(jnp.stack([m[k] for k, m in enumerate(matrix)]))

    return weigh


def smooth(images, z, noise, albedo, normal):
    """Images of all bases under the filter for weights."""
    return ensemble.filter_weights(images, z, noise, albedo=albedo, normal=normal)


@jax.jit
def one_hot_bilateral(full, a, b, xa, xb, v, albedo, normal):
    """The base of least error, errors filtered like weights, by the noisy image."""
    found = ensemble.selection_errors(a, b, xa, xb, 2 * v, 2 * v)
    found = smooth(found, (xa + xb) / 2, v, albedo, normal)
    return ensemble.average(full, ensemble.one_hot(found))


@jax.jit
def one_hot_means(full, a, b, xa, xb, v, albedo, normal):
    """The base of least error, errors filtered by non-local means."""
    found = ensemble.selection_errors(a, b, xa, xb, 2 * v, 2 * v)
    found = jnp.moveaxis(found, 0, 2)
    flat = found.reshape(*xa.shape[:2], -1)
    filtered = nonlocal_means.denoise(flat, (xa + xb) / 2, v).reshape(found.shape)
    return ensemble.average(full, ensemble.one_hot(jnp.moveaxis(filtered, 2, 0)))


METHODS = {
    "average": weighed(lambda a, *_: jnp.full_like(a, 1 / len(a))),
    "one-hot, pixel": selected(filter=False),
    "one-hot, errors cross-bilateral": one_hot_bilateral,
    "one-hot, errors non-local means": one_hot_means,
    "one-hot, weights filtered": selected(filter=True),
    "one-hot, 31x31": weighed(one_hot(31)),
    "pixel (the paper), no filter": combined(solver="hull", filter=False),
    PAPER: combined(solver="hull", filter=True),
    **{
        f"{PAPER}, {name}": combined(solver="hull", filter=ensemble.Filter(**options))
        for name, options in {
            "variance blurred": {"blur": 2.0},
            "weights clipped": {"clip": 1.0},
            "normals standardised": {"standardise": True},
            "all three": {"blur": 2.0, "clip": 1.0, "standardise": True},
        }.items()
    },
    **{f"{w}x{w}": weighed(over(w)) for w in (7, 15, 31, 63)},
    "frame": weighed(over(whole_frame=True)),
    OURS: combined(solver="multi-scale", filter=False),
    "multi-scale, filtered": combined(solver="multi-scale", filter=True),
    "multi-scale, each channel": combined(
        solver="multi-scale", filter=False, shared=False
    ),
    "31x31, either sign": weighed(
        lambda *halves: simplex.affine(
            ensemble.error_matrix(*halves, windows=(31,), whole_frame=False)
        )
    ),
}
WITH_UNBIASED = PAPER, "31x31", "frame", OURS, "multi-scale, filtered"
ALL = *METHODS, *(f"{name} and x" for name in WITH_UNBIASED), SELECTED


def measure(frame: Frame, repeats: int) -> dict[str, float]:
    """Errors of the bases, of all methods with their time, and of all subsets."""
    x_a, x_b = (half.color for half in frame.halves())
    rest = x_a, x_b, frame.variance, frame.albedo, frame.normal
    bases, error = bases_of(frame), functools.partial(errors.relative_l2, frame=frame)
    row = {"path tracing": error(frame.color)}
    row |= {name: error(base.image) for name, base in bases.items()}
    some = ensemble.stack_estimates(bases)
    more = ensemble.stack_estimates(bases | {"x": unbiased_of(frame)})

    def add(name: str, method: Callable, images: Sequence[Image]) -> None:
        call = functools.partial(method, *images, *rest)
        row[name] = error(call())
        row[name + SECONDS] = medians({name: call}, repeats)[name]

    for name, method in METHODS.items():
        add(name, method, some)
        if name in WITH_UNBIASED:
            add(f"{name} and x", method, more)
    ours, names = METHODS[OURS], list(BASES)
    for count in range(2, len(names)):
        for subset in itertools.combinations(names, count):
            images = ensemble.stack_estimates({name: bases[name] for name in subset})
            row[" + ".join(subset)] = error(ours(*images, *rest))
    select = lambda: ensemble.select_bases(some.biased_a, some.biased_b, x_a, x_b)
    chosen = select().kept
    needed = {names[k]: bases[names[k]] for k in chosen}
    add(SELECTED, ours, ensemble.stack_estimates(needed))
    row["selecting" + SECONDS] = medians({"": lambda: select().kept}, 1)[""]
    row["selected, number"] = len(chosen)
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors and seconds by "frame samples" and method.

    Raises:
        ValueError: if the folder holds no archive.
    """
    of = functools.partial(measure, repeats=1 if config.quick else config.repeats)
    return archives.measured(
        config.folder, {"": of}, results=config.results, quick=config.quick
    )


def best(row: errors.Row) -> float:
    """Error of the best base."""
    return min(row[base] for base in BASES)


def scores(rows: Sequence[errors.Row], names: Sequence[str]) -> dict[str, float]:
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


def scored(rows: dict[str, dict[str, float]]) -> str:
    """Every subset of the bases, the best first."""
    every, groups = list(rows.values()), errors.by_samples(rows)
    subsets = [n for n in every[0] if " + " in n] + [*BASES, OURS]
    each = [scores(some, subsets) for some in groups.values()]
    cells = (
        ["all six" if name == OURS else name, score, *(s[name] for s in each)]
        for name, score in scores(every, subsets).items()
    )
    return table(["bases", "score", *groups], cells)


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        means beside times, every frame, and scores of all subsets.
    """
    every, groups = list(rows.values()), errors.by_samples(rows)

    def time(name: str, unit: str = "average") -> float | None:
        if name in BASES:
            return None
        return float(np.median([r[name + SECONDS] / r[unit + SECONDS] for r in every]))

    def said(name: str) -> str:
        ratios = [[row[name] / best(row) for row in g] for g in groups.values()]
        means = ", ".join(f"{errors.geometric_mean(g):.2f}" for g in ratios)
        return f"{means} (worst {max(map(max, ratios)):.2f})"

    number = np.mean([row["selected, number"] for row in every])
    answer = (
        f"At {', '.join(map(str, groups))} samples an ensemble of {len(BASES)} bases "
        f"has, in relative L2 divided by the best base's (geometric means of "
        f"{len(rows)} frames in all), {said(OURS)} with multi-scale weights in "
        f"{time(OURS):.0f} times the plain average's time; {said(SELECTED)} with the "
        f"{number:.1f} bases that `select_bases` leaves in {time(SELECTED):.0f} times, "
        f"selecting takes {time('selecting', OURS):.1f} times as long as combining all "
        f"six; {said('31x31')} with weights over 31x31 pixels; and {said(PAPER)} with "
        f"the paper's of single pixels, filtered, in {time(PAPER):.0f} times."
    )
    shown = [n for n in ALL if not n.startswith("one-hot, e") and n != "average"]
    frames = (
        [frame, *(row[n] for n in ("path tracing", *BASES))]
        + [row[n] / best(row) for n in shown]
        for frame, row in rows.items()
    )
    tables = [
        errors.means(
            rows,
            [*BASES, *ALL],
            best,
            title="error / best base",
            beside={"time / average": time},
        ),
        "Every frame: errors of path tracing and of the bases, then ratios to the best "
        "base.",
        table(["frame", "path tracing", *BASES, *shown], frames),
        "Scores of all subsets with multi-scale weights: as many as there are subsets "
        "for the best of a frame, 1 for the worst; means over frames.",
        scored(rows),
    ]
    return Report(answer, "\n\n".join(tables))


if __name__ == "__main__":
    main(Config, run, report)
