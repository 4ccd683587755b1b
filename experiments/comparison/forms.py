"""How do the forms of neural James-Stein and progressive denoising differ in error?

On every frame of a split of `experiments.data.dataset`, with Open Image Denoise: the
biased image y, or y* (cross-regressed halves); the dual form; an ensemble first, whose
halves have weights of their own, and James-Stein after it; path tracing blurred by a
15x15 box for y; progressive denoising with the frame's own estimate of the channels'
noise, with the paper's, and without its bound. Of the network of double shrinkage: how
eta^2, the prior's error that it predicts, ranks blocks of 8x8 pixels, and which share
of its result is the prior's.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.comparison.convergence import blurred, draw
from experiments.data import dataset
from jscomb import double_shrinkage, ensemble, exr, james_stein, metrics, progressive
from jscomb.denoisers import oidn
from jscomb.frame import Frame, with_halves
from jscomb.learning.recipes import shipped
from jscomb.numerics.kernels import predicted_mean
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image

TRACED, DENOISED = "path tracing", "oidn"
DISPLAYED = TRACED, DENOISED, "pd", "oidn-color", "pd of oidn-color"  # FLIP is slow
BLOCK = 8  # pixels
Row = dict[str, dict[str, float]]


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of `experiments.data.dataset`.
        split: that is measured.
        results: file that stores results as they come.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    split: str = "test"
    results: pathlib.Path | None = None


def james_steins(frame: Frame) -> Iterator[tuple[str, Image]]:
    """Yield James-Stein with y, with y*, dual, and with the network."""
    key, y = jax.random.key(0), frame.estimates[DENOISED]
    assert y.halves is not None
    star = james_stein.regress(key, frame, y, stride=2, always=True).estimate
    yield "y*", star.image
    for name, given in (("y", y), ("y*", star)):
        yield f"whitened, {name}", james_stein.combine_frame(frame, given).image
    network = shipped("njs")
    inputs = james_stein.neural_inputs(jax.random.clone(key), frame, y)
    combine = compiled(james_stein.neural_combine)
    yield "njs", combine(network, **inputs)
    yield "njs, y", combine(network, frame.color, y.image, y.image, frame.variance)
    assert star.halves is not None
    yield "njs, y*", combine(network, frame.color, *star.halves, frame.variance)
    halves = [half.color for half in frame.halves()]
    dual = compiled(james_stein.combine_dual, window=7, whiten=True)
    v = james_stein.robust_variance(frame.variance)
    yield "whitened, dual", dual(*halves, *y.halves, v)
    dual = compiled(james_stein.neural_combine_dual)
    yield "njs, dual", dual(network, *halves, *y.halves, frame.variance)


def ensembles(frame: Frame) -> Iterator[tuple[str, Image]]:
    """Yield ensembles with halves of their own, and James-Stein towards them."""
    own = lambda part: with_halves(part, lambda half: half.color)
    bases = {DENOISED: oidn.denoise_frame, "oidn-color": _of_color}
    for name, more in (("two denoisers", {}), ("and path tracing", {TRACED: own})):
        made = ensemble.combine_frame(frame, bases | more)
        yield f"ensemble, {name}", made.image
        if not more:
            after = james_stein.combine_frame(frame, made)
            yield "whitened after the ensemble", after.image
            after = james_stein.neural_combine_frame(
                jax.random.key(0), shipped("njs"), frame, made
            )
            yield "njs after the ensemble", after.image


def _of_color(frame: Frame):
    """Open Image Denoise by the colour alone."""
    return oidn.denoise_frame(frame, variant=oidn.VARIANTS["oidn-color"])


def blurs(frame: Frame) -> Iterator[tuple[str, Image]]:
    """Yield James-Stein towards a box blur, by its rules and by the network."""
    y = blurred(frame).estimates[DENOISED]
    yield "box", y.image
    for name, options in (
        ("james-stein, box", {"window": 15, "whiten": False}),
        ("whitened, box", {}),
    ):
        given = y._replace(halves=None)
        yield name, james_stein.combine_frame(frame, given, **options).image
    after = james_stein.neural_combine_frame(
        jax.random.key(0), shipped("njs"), frame, y
    )
    yield "njs, box", after.image


def mixes(frame: Frame) -> Iterator[tuple[str, Image]]:
    """Yield progressive denoising with features and by colour alone; its bounds."""
    combine = {
        bound: compiled(progressive.neural_combine, bound=bound)
        for bound in (True, False)
    }
    color = lambda image, part: oidn.denoise_color(
        image, part, variant=oidn.VARIANTS["oidn-color"]
    )
    for suffix, denoise in (("", oidn.denoise_color), (" of oidn-color", color)):
        inputs = progressive.neural_inputs(jax.random.key(0), denoise, frame)
        if suffix:
            yield "oidn-color", inputs["biased"]
        yield f"pd{suffix}", combine[True](shipped("pd"), **inputs)
        if not suffix:
            del inputs["noise"]
            yield "pd, the paper's bound", combine[True](shipped("pd"), **inputs)
            yield "pd, no bound", combine[False](shipped("pd"), **inputs)


def _told(network, inputs: dict[str, Image]) -> tuple[Image, Image]:
    """The error of its prior that a network predicts, and the prior's share."""
    names = "prior", "unbiased", "biased", "variance", "mse"
    kernels, eta = network(*(inputs[name] for name in names))
    v, m = predicted_mean(jnp.stack([inputs["variance"], inputs["mse"]]), kernels)
    return eta, double_shrinkage.factors(v, m, eta).prior


def prior(frame: Frame) -> dict[str, float]:
    """Measure what the network of double shrinkage says of its prior."""
    assert frame.reference is not None
    inputs = double_shrinkage.neural_inputs(frame, frame.estimates[DENOISED])
    network = shipped("dsc")
    p, (eta, share) = inputs["prior"], compiled(_told)(network, inputs)
    true = jnp.mean(jnp.square(p - frame.reference.image), axis=-1, keepdims=True)
    blocks = [errors.block_means(each, BLOCK) for each in (eta, true, share)]
    weight = 1 / (jnp.square(frame.reference.image.mean(-1, keepdims=True)) + 0.01)
    told, truth = (float(jnp.mean(weight * each)) for each in (eta, true))
    return {
        "rank correlation of eta^2 and the prior's error": errors.rank_correlation(
            blocks[0], blocks[1]
        ),
        "eta^2 over that error": told / truth,
        "mean share of the prior": float(jnp.mean(share)),
        "rank correlation of its share and its error": errors.rank_correlation(
            blocks[2], blocks[1]
        ),
    }


def measure(path: pathlib.Path) -> Row:
    """Measure a frame.

    Args:
        path: of the frame.

    Returns:
        errors by metric and image; what `prior` says as "prior".
    """
    frame = exr.read_frame(path).normalised()
    assert frame.reference is not None
    reference = frame.reference.image
    images = {TRACED: frame.color, DENOISED: frame.estimates[DENOISED].image}
    for group in (james_steins, ensembles, blurs, mixes):
        images |= dict(group(frame))
    of: dict[str, tuple[Callable[[Image], object], tuple[str, ...]]] = {
        "relative L2": (lambda i: errors.relative_l2(i, frame), tuple(images)),
        "RMSE": (lambda i: metrics.rmse(i, reference), DISPLAYED),
        "SMAPE": (lambda i: metrics.smape(i, reference), DISPLAYED),
        "FLIP": (lambda i: metrics.flip(i, reference), DISPLAYED),
    }
    measured = {
        name: {each: float(metric(images[each])) for each in chosen}
        for name, (metric, chosen) in of.items()
    }
    return measured | {"prior": prior(frame)}


def run(config: Config) -> dict[str, Row]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        as `measure`, by "view samples".

    Raises:
        ValueError: if there are no frames.
    """
    first = 1 if config.quick else None
    where = config.folder, config.split
    return dataset.measured(*where, measure, config.results, first=first)


def curves(rows: dict[str, Row]) -> Figure:
    """Draw the mean errors of a few images against samples."""
    names = (TRACED, DENOISED, "njs", "njs, y*", "box", "james-stein, box", "njs, box")
    names = (*names, "ensemble, two denoisers", "njs after the ensemble", "pd")
    groups = errors.by_samples({k: row["relative L2"] for k, row in rows.items()})
    mean = lambda name: np.array(
        [errors.geometric_mean(r[name] for r in group) for group in groups.values()]
    )
    found = {name: (np.array([*groups]), mean(name)) for name in names}
    return draw({"geometric mean of frames": found}, "relative L2")


def report(rows: dict[str, Row]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        errors by sample count and metric, and the prior's share and error.
    """
    l2 = {name: row["relative L2"] for name, row in rows.items()}
    names = list(next(iter(l2.values())))
    below = {
        name: sum(row[name] < row[TRACED] for row in l2.values()) for name in names[2:]
    }
    better = lambda row: min(row[TRACED], row[DENOISED])
    first = errors.means(
        l2,
        names,
        better,
        title="relative L2 over the better input",
        beside={f"below path tracing, of {len(l2)}": lambda n: below.get(n)},
    )
    other = []
    for metric in ("RMSE", "SMAPE", "FLIP"):
        each = {name: row[metric] for name, row in rows.items()}
        for pair in (("pd", DENOISED), ("pd of oidn-color", "oidn-color")):
            ratios = [row[pair[0]] / row[pair[1]] for row in each.values()]
            low = sum(ratio < 1 for ratio in ratios)
            cells = [errors.geometric_mean(ratios), max(ratios), low]
            means = [np.mean([row[n] for row in each.values()]) for n in pair[::-1]]
            other.append([f"{metric}, {' over '.join(pair)}", *cells, *means])
    header = ["ratio", "mean", "worst", "below 1", "denoised, mean", "mixed, mean"]
    said = {
        name: [row["prior"][name] for row in rows.values()]
        for name in next(iter(rows.values()))["prior"]
    }
    priors = [
        [name, float(np.median(some)), min(some), max(some)]
        for name, some in said.items()
    ]
    box = sum(r["james-stein, box"] < r[TRACED] for r in l2.values())
    ratio = lambda a, b: errors.geometric_mean(r[a] / r[b] for r in l2.values())
    answer = (
        f"Relative L2, geometric mean of {len(l2)} frames: njs towards y* has "
        f"{ratio('njs, y*', 'njs, y'):.3f} of that towards y, the dual form "
        f"{ratio('njs, dual', 'njs'):.2f} of njs; after an ensemble njs has "
        f"{ratio('njs after the ensemble', 'ensemble, two denoisers'):.3f} of the "
        f"ensemble's; towards a blurred image James-Stein is below path tracing in "
        f"{box}; pd has {ratio('pd', 'pd, no bound'):.3f} of itself without its bound."
    )
    body = [
        first,
        table(header, other),
        table(["of the network dsc", "median", "least", "greatest"], priors),
    ]
    return Report(answer, "\n\n".join(body), {"Errors against samples": curves(rows)})


if __name__ == "__main__":
    main(Config, run, report)
