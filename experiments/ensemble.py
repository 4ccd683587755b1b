"""What does an ensemble of denoisers gain, and by which part of it?

    python -m experiments.ensemble FOLDER --results FILE.json

Every archive in the folder (see `frames`), at every sample count. Bases: Open Image
Denoise with and without features, joint bilateral, Gaussian, non-local means; and the
unbiased image. Relative L2, less the reference's noise, at an exposure of 1, divided by
that of the best base: of the plain average, of one-hot choices, of weights from single
pixels, windows, the frame and all scales, filtered or not, with each channel by itself,
of either sign, and with the unbiased image among the bases. Then every subset of the
bases with the same method, ranked as in the paper's table 3. Results are kept in the
file as they come, and what is in it is not measured again.
"""

import dataclasses
import itertools
import json
import pathlib
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments import frames
from jscomb import ensemble
from jscomb.denoisers import bilateral, nonlocal_means, oidn, smoothing
from jscomb.frame import Biased, Frame
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


BASES = ("oidn", "oidn, no features", "bilateral", "gaussian", "non-local means")
SCALED = {"solver": "multi-scale", "filter": False}

means = jax.jit(nonlocal_means.denoise)
gaussian = jax.jit(smoothing.gaussian)


def bases_of(frame: Frame) -> list[Biased]:
    """The bases of a frame and of its halves, in the order of `BASES`.

    Args:
        frame: with halves, variances, and Open Image Denoise's image.

    Returns:
        the biased images, with halves.
    """

    def each(denoise: Callable[[Frame], Image]) -> Biased:
        full, *halves = (denoise(part) for part in (frame, *frame.halves()))
        return Biased(full, jnp.stack(halves))

    return [
        frame.biased["oidn"],
        oidn.denoise_frame(frame, features=False),
        bilateral.denoise_frame(frame),
        each(lambda part: gaussian(part.color)),
        each(lambda part: means(part.color, part.color, part.variance)),
    ]


def stacked(bases: Sequence[Biased]) -> tuple[Image, Image, Image]:
    """Full images, and those of both halves, [N,H,W,C] each."""
    full, a, b = zip(*((i.full, *i.halves) for i in bases), strict=True)
    return jnp.stack(full), jnp.stack(a), jnp.stack(b)


def combined(**options) -> Callable:
    """`ensemble.combine` with some options, compiled."""
    return jax.jit(
        lambda full, a, b, xa, xb, albedo, normal: ensemble.combine(
            full, a, b, xa, xb, albedo=albedo, normal=normal, **options
        )
    )


def weighed(weigh: Callable) -> Callable:
    """The ensemble with weights from the halves, compiled."""
    return jax.jit(
        lambda full, *halves_and_guides: ensemble.average(
            full, jnp.broadcast_to(weigh(*halves_and_guides[:4]), full.shape)
        )
    )


def over(*windows: int, whole_frame: bool = False) -> Callable:
    """Weights of least error over one window, or the frame."""
    return lambda *halves: simplex.quadratic(
        ensemble.error_matrix(*halves, windows=windows, whole_frame=whole_frame)
    )


def one_hot(window: int) -> Callable:
    """The base of least error over a window."""

    def weigh(*halves):
        matrix = ensemble.error_matrix(*halves, windows=(window,), whole_frame=False)
        return ensemble.one_hot(jnp.stack([m[k] for k, m in enumerate(matrix)]))

    return weigh


METHODS = {
    "average": weighed(lambda a, *_: jnp.full_like(a, 1 / len(a))),
    "one-hot, pixel": weighed(one_hot(1)),
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
)


def measure(frame: Frame) -> dict[str, float]:
    """Relative L2 of the bases, of all methods, and of all subsets."""
    assert frame.reference is not None
    r, noise = frame.reference
    error = lambda image: float(rel_l2(image, r, half_difference=noise))
    x_a, x_b = (half.color for half in frame.halves())
    rest = x_a, x_b, frame.albedo, frame.normal
    bases = bases_of(frame)
    unbiased = Biased(frame.color, jnp.stack([x_a, x_b]))
    row = {"path tracing": error(frame.color)}
    row |= {n: error(b.full) for n, b in zip(BASES, bases, strict=True)}
    some, more = stacked(bases), stacked([*bases, unbiased])
    for name, method in METHODS.items():
        row[name] = error(method(*some, *rest))
        if name in WITH_UNBIASED:
            row[f"{name} and x"] = error(method(*more, *rest))
    for count in range(2, len(BASES)):
        for subset in itertools.combinations(range(len(BASES)), count):
            images = stacked([bases[k] for k in subset])
            name = " + ".join(BASES[k] for k in subset)
            row[name] = error(METHODS["multi-scale"](*images, *rest))
    chosen = ensemble.select_bases(some[1], some[2], x_a, x_b).kept
    images = stacked([bases[k] for k in chosen])
    row["selected"] = error(METHODS["multi-scale"](*images, *rest))
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
    cases = frames.cases(config.folder, quick=config.quick)
    found: dict[str, dict[str, float]] = {}
    if config.results is not None and config.results.exists():
        found = json.loads(config.results.read_text())
    for path, samples in tqdm(cases, unit="frame"):
        name = f"{path.stem} {samples}"
        if name in found:
            continue
        frame = frames.load(path, samples)
        found[name] = measure(frame.scaled(1 / frame.exposure))
        if config.results is not None:
            config.results.write_text(json.dumps(found, indent=1))
    return found


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
    counts = sorted({int(name.split()[-1]) for name in found})
    at = {c: [r for n, r in found.items() if n.endswith(f" {c}")] for c in counts}
    best = lambda row: min(row[base] for base in BASES)
    methods = [n for n in rows[0] if n in METHODS or n.endswith(" and x")]
    print(f"{'error / best base':<40}", end="")
    print("".join(f"{c:>9}" for c in counts) + "    worst")
    for name in (*methods, "selected"):
        ratios = {c: [r[name] / best(r) for r in some] for c, some in at.items()}
        means_of = [np.exp(np.mean(np.log(each))) for each in ratios.values()]
        worst = max(max(each) for each in ratios.values())
        print(f"{name:<40}" + "".join(f"{m:>9.3f}" for m in means_of), end="")
        print(f"{worst:>9.2f}")
    number = np.mean([row["selected, number"] for row in rows])
    print(f"selected: {number:.1f} of {len(BASES)} bases")
    subsets = [n for n in rows[0] if " + " in n] + [*BASES, "multi-scale"]
    print(f"\nscores of {len(subsets)} candidates, the best first; by sample count")
    each = {c: scores(some, subsets) for c, some in at.items()}
    for name, score in scores(rows, subsets).items():
        by_count = "".join(f"{scored[name]:>7.1f}" for scored in each.values())
        print(f"{name:<70}{score:>7.1f}{by_count}")


if __name__ == "__main__":
    main()
