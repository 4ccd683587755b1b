"""What does an ensemble of denoisers gain, and by which part of it?

    python -m experiments.ensemble.ensemble FOLDER --results FILE.json

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

from experiments.common import archives
from experiments.common.timing import medians
from experiments.ensemble.bases import BASES, bases_of, unbiased_of
from jscomb import ensemble
from jscomb.denoisers import nonlocal_means
from jscomb.frame import Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import simplex
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that results are kept in; None to keep none.
        quick: only the first archive, at its least sample count.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    quick: bool = False


SCALED = {"solver": "multi-scale", "filter": False}

means = jax.jit(nonlocal_means.denoise)


def combined(**options) -> Callable:
    """`ensemble.combine` with some options, compiled."""
    return jax.jit(
        lambda full, a, b, xa, xb, v, albedo, normal: ensemble.combine(
            full, a, b, xa, xb, albedo=albedo, normal=normal, **options
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


def errors_of(*halves, window: int = 1, shared: bool = False):
    """Estimated error of each base over a window, relative, [N,H,W,C or 1]."""
    matrix = ensemble.error_matrix(
        *halves, windows=(window,), whole_frame=False, shared=shared
    )
    return jnp.stack([m[k] for k, m in enumerate(matrix)])


def one_hot(window: int) -> Callable:
    """The base of least error over a window."""
    return lambda *halves: ensemble.one_hot(
        errors_of(*halves, window=window, shared=True)
    )


def smooth(images, a, b, albedo, normal):
    """Images of all bases under the filter for weights, guided by the bases' mean."""
    z, z_a, z_b = (jnp.mean(i, axis=0) for i in ((a + b) / 2, a, b))
    noise = jnp.square(z_a - z_b) / 2
    return ensemble.filter_weights(images, z, noise, albedo=albedo, normal=normal)


@jax.jit
def one_hot_bilateral(full, a, b, xa, xb, v, albedo, normal):
    """The base of least error, errors filtered like weights."""
    errors = smooth(errors_of(a, b, xa, xb), a, b, albedo, normal)
    return ensemble.average(full, ensemble.one_hot(errors))


@jax.jit
def one_hot_means(full, a, b, xa, xb, v, albedo, normal):
    """The base of least error, errors filtered by non-local means."""
    errors = jnp.moveaxis(errors_of(a, b, xa, xb), 0, 2)
    flat = errors.reshape(*xa.shape[:2], -1)
    filtered = means(flat, (xa + xb) / 2, v).reshape(errors.shape)
    return ensemble.average(full, ensemble.one_hot(jnp.moveaxis(filtered, 2, 0)))


@jax.jit
def one_hot_after(full, a, b, xa, xb, v, albedo, normal):
    """The base of least error, and then its weights filtered."""
    weights = ensemble.one_hot(errors_of(a, b, xa, xb))
    return ensemble.average(full, smooth(weights, a, b, albedo, normal))


METHODS = {
    "average": weighed(lambda a, *_: jnp.full_like(a, 1 / len(a))),
    "one-hot, pixel": weighed(one_hot(1)),
    "one-hot, errors cross-bilateral": one_hot_bilateral,
    "one-hot, errors non-local means": one_hot_means,
    "one-hot, weights filtered": one_hot_after,
    "one-hot, 31x31": weighed(one_hot(31)),
    "pixel (the paper), no filter": combined(filter=False),
    "pixel, filtered (the paper)": combined(),
    **{f"{w}x{w}": weighed(over(w)) for w in (7, 15, 31, 63)},
    "frame": weighed(over(whole_frame=True)),
    "multi-scale": combined(**SCALED),
    "multi-scale, filtered": combined(solver="multi-scale"),
    "multi-scale, each channel": combined(**SCALED, shared=False),
    "31x31, either sign": weighed(
        lambda *halves: simplex.affine(
            ensemble.error_matrix(*halves, windows=(31,), whole_frame=False)
        )
    ),
}
WITH_UNBIASED = (
    "pixel, filtered (the paper)",
    "31x31",
    "frame",
    "multi-scale",
    "multi-scale, filtered",
)
SECONDS = ", seconds"
SHOWN = (
    "average",
    "one-hot, 31x31",
    "pixel (the paper), no filter",
    "pixel, filtered (the paper)",
    "7x7",
    "15x15",
    "31x31",
    "63x63",
    "frame",
    "multi-scale",
    "multi-scale, filtered",
    "multi-scale and x",
    "multi-scale, filtered and x",
    "selected",
)


def measure(frame: Frame) -> dict[str, float]:
    """Relative L2 of the bases, of all methods with their time, and of all subsets."""
    assert frame.reference is not None
    r, noise = frame.reference
    error = lambda image: float(rel_l2(image, r, half_difference=noise))
    x_a, x_b = (half.color for half in frame.halves())
    rest = x_a, x_b, frame.variance, frame.albedo, frame.normal
    bases = bases_of(frame)
    row = {"path tracing": error(frame.color)}
    row |= {name: error(base.image) for name, base in bases.items()}
    some = ensemble.stack_estimates(bases)
    more = ensemble.stack_estimates(bases | {"x": unbiased_of(frame)})

    def add(name: str, method: Callable, images: Sequence[Image]) -> None:
        call = functools.partial(method, *images, *rest)
        row[name] = error(call())
        row[name + SECONDS] = medians({name: call}, 3)[name]

    for name, method in METHODS.items():
        add(name, method, some)
        if name in WITH_UNBIASED:
            add(f"{name} and x", method, more)
    ours, names = METHODS["multi-scale"], list(BASES)
    for count in range(2, len(names)):
        for subset in itertools.combinations(names, count):
            images = ensemble.stack_estimates({name: bases[name] for name in subset})
            row[" + ".join(subset)] = error(ours(*images, *rest))
    chosen = ensemble.select_bases(some.biased_a, some.biased_b, x_a, x_b).kept
    needed = {names[k]: bases[names[k]] for k in chosen}
    add("selected", ours, ensemble.stack_estimates(needed))
    row["selected, number"] = len(chosen)
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        relative L2 by "frame samples" and method.

    Raises:
        ValueError: if the folder holds no archive.
    """
    return archives.measured(
        config.folder, {"": measure}, results=config.results, quick=config.quick
    )


def scores(rows: Sequence[dict[str, float]], names: Sequence[str]) -> dict[str, float]:
    """Mean score of each candidate: as many as there are for the best, 1 for the worst.

    Args:
        rows: errors of each frame by candidate.
        names: of the candidates.

    Returns:
        the scores by name, the best first.
    """
    errors = np.array([[row[name] for name in names] for row in rows])
    ranks = errors.argsort(axis=1).argsort(axis=1)
    mean = (len(names) - ranks).mean(axis=0)
    order = (-mean).argsort()
    return {names[k]: float(mean[k]) for k in order}


def main() -> None:
    """Print the tables."""
    found = run(tyro.cli(Config, description=__doc__))
    rows = list(found.values())
    print_means(found)
    print_frames(found)
    print_scores(found)
    number = np.mean([row["selected, number"] for row in rows])
    share = np.median(
        [r["selected" + SECONDS] / r["multi-scale" + SECONDS] for r in rows]
    )
    print(f"\nselected: {number:.1f} of {len(BASES)} bases, {share:.2f} of the time")


def ratio(row: dict[str, float], name: str) -> float:
    """Error divided by that of the best base."""
    return row[name] / min(row[base] for base in BASES)


def by_count(found: dict[str, dict[str, float]]) -> dict[int, list[dict[str, float]]]:
    """The frames' errors by sample count, ascending."""
    counts = sorted({int(name.split()[-1]) for name in found})
    return {c: [r for n, r in found.items() if n.endswith(f" {c}")] for c in counts}


def print_means(found: dict[str, dict[str, float]]) -> None:
    """Geometric means over frames, the worst frame, and time."""
    at, rows = by_count(found), list(found.values())
    print("| error / best base |", " | ".join(map(str, at)), "| worst | time |")
    print("| --- " * (len(at) + 3) + "|")
    with_x = [f"{name} and x" for name in WITH_UNBIASED]
    for name in (*BASES, *METHODS, *with_x, "selected"):
        ratios = [[ratio(row, name) for row in some] for some in at.values()]
        means_of = " | ".join(f"{np.exp(np.mean(np.log(r))):.3f}" for r in ratios)
        own = [
            r[name + SECONDS] / r["average" + SECONDS]
            for r in rows
            if name not in BASES
        ]
        time = f"{np.median(own):.0f}" if own else ""
        print(f"| {name} | {means_of} | {max(map(max, ratios)):.2f} | {time} |")


def print_frames(found: dict[str, dict[str, float]]) -> None:
    """Every frame: errors of the bases, and what the ensembles make of them."""
    names = [n for n in SHOWN if n in next(iter(found.values()))]
    columns = ["frame", "path tracing", *BASES, *names]
    print("\n|", " | ".join(columns), "|\n" + "| --- " * len(columns) + "|")
    for frame, row in found.items():
        bases = " | ".join(f"{row[base]:.5f}" for base in ("path tracing", *BASES))
        ratios = " | ".join(f"{ratio(row, name):.3f}" for name in names)
        print(f"| {frame} | {bases} | {ratios} |")


def print_scores(found: dict[str, dict[str, float]]) -> None:
    """Every subset of the bases, the best first."""
    at, rows = by_count(found), list(found.values())
    subsets = [n for n in rows[0] if " + " in n] + [*BASES, "multi-scale"]
    print("\n| bases | score |", " | ".join(map(str, at)), "|")
    print("| --- " * (len(at) + 2) + "|")
    each = [scores(some, subsets) for some in at.values()]
    for name, score in scores(rows, subsets).items():
        shown = "all six" if name == "multi-scale" else name
        parts = " | ".join(f"{scored[name]:.1f}" for scored in each)
        print(f"| {shown} | {score:.1f} | {parts} |")


if __name__ == "__main__":
    main()
