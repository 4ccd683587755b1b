"""What are the tiers of the default method worth, and are they ever worse?

Frames of `experiments.data.development`, which have four sub-buffers. Errors (relative
L2 of the normalised frame, less the reference's noise) are divided by those of the
better of path tracing and Open Image Denoise, frame by frame, and by those of its best
single setting, the variant of least mean error over all frames.

What took part in setting what: the windows and the weights of pixels are of five other
renderings of the first five scenes; the strength of the bands at few samples and the
members of the tiers are of all scenes here, so `experiments.comparison.members` says
what members do on a scene that did not choose them. `LATE` scenes were rendered when
everything but strength and members was set.

    tiers      the errors of every tier and of what it is made of.
    ablation   of `best` without each of its estimates, without the noise in the
               weights of pixels, with weights of one window.
    estimate   the estimated error beside the true one: the factor between both, and
               the rank correlation of the map with the true error over 8x8 blocks.
    changes    the change of the halves' error against `oidn`, estimated from the other
               half, beside the true one: slope, rank correlation and share of wrong
               signs; and the same with noisy pixels weighted less.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.data import development
from jscomb import ensemble, exr, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame
from jscomb.methods import METHODS, TIERS, combine_tier
from jscomb.methods._inputs import inputs, with_inputs
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image

LATE = "cornell-glossy", "dining-room", "living-room-2"
BASELINES = "path tracing", "oidn"
ALSO = "oidn-turned", "whitened", "njs", "dsc"
BLOCK = 8
_EPSILON = 0.01


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of development frames.
        results: file that the frames' results are kept in; None to keep none.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None


def weighted(frame: Frame, estimates: Mapping[str, Estimate], **options) -> Image:
    """An ensemble with other options than the default's."""
    bases = ensemble.stack_estimates(estimates)
    a, b = frame.halves()
    options = {"variance_a": a.variance, "variance_b": b.variance, **options}
    windows = options.pop("windows", (29, 61))
    combine = compiled(
        ensemble.combine, solver="multi-scale", filter=False, windows=windows
    )
    return combine(*bases, a.color, b.color, **options)


def ablation(frame: Frame, estimates: dict[str, Estimate]) -> dict[str, float]:
    """Errors of `best` with something taken away."""
    error = lambda image: errors.relative_l2(image, frame)
    found = {
        f"without {name}": error(
            weighted(frame, {n: e for n, e in estimates.items() if n != name})
        )
        for name in estimates
    }
    equal = weighted(frame, estimates, variance_a=None, variance_b=None)
    found["pixels of equal weight"] = error(equal)
    found["one window of 29"] = error(weighted(frame, estimates, windows=(29,)))
    mean = jnp.mean(jnp.stack([e.image for e in estimates.values()]), axis=0)
    return found | {"equal weights": error(mean)}


def judged(frame: Frame, made: Estimate, found: metrics.ErrorEstimate) -> dict:
    """The estimated error beside the true one."""
    assert frame.reference is not None
    r, noise = frame.reference
    true = errors.relative_l2(made.image, frame)
    weight = jnp.square(jnp.mean(r, axis=-1, keepdims=True)) + _EPSILON
    square = jnp.square(made.image - r)
    if noise is not None:
        square = square - jnp.square(noise) / 4
    maps = (errors.block_means(i, BLOCK) for i in (square / weight, found.map))
    return {
        "estimated": float(found.mean) / true,
        "standard error": float(found.standard_error) / true,
        "map": errors.rank_correlation(*maps),
    }


def measure(frame: Frame, *, quick: bool) -> dict[str, float]:
    """Everything of one normalised frame."""
    assert frame.reference is not None
    key, error = jax.random.key(0), functools.partial(errors.relative_l2, frame=frame)
    flip = lambda image: metrics.flip(image, frame.reference.image)
    row = {"path tracing": error(frame.color), "path tracing FLIP": flip(frame.color)}
    tiers = [*TIERS][: 2 if quick else None]
    for tier in tiers:
        made = combine_tier(key, frame, tier=tier)
        image = made.estimate.image
        row |= {tier: error(image), f"{tier} FLIP": flip(image)}
        if made.error is not None:
            of = judged(frame, made.estimate, made.error)
            row |= {f"{tier} {name}": value for name, value in of.items()}
    members = [*TIERS[tiers[-1]].bases]
    names, _ = inputs(frame, biased=[*members, *(() if quick else ALSO)])
    frame = with_inputs(key, frame, names)
    row |= {name: error(frame.estimates[name].image) for name in names}
    row |= {"oidn FLIP": flip(frame.estimates["oidn"].image)}
    row |= changes(frame, names)
    if not quick:
        row |= ablation(frame, {n: frame.estimates[n] for n in names if n in members})
    return row


def changes(frame: Frame, names: Sequence[str]) -> dict[str, float]:
    """Changes of the halves' errors against `oidn`, relative to its error.

    The true one, that estimated from the other half as it is, and with noisy pixels
    weighted less, as the ensemble's weights see it.
    """
    assert frame.reference is not None
    a, b = frame.halves()
    x, y = jnp.stack([a.color, b.color]), frame.estimates["oidn"].halves
    r, noise = frame.reference
    error = lambda halves: float(
        np.mean([metrics.rel_l2(i, r, half_difference=noise) for i in halves])
    )
    of = compiled(ensemble.error_matrix, windows=())
    before, row = error(y), {}
    for name in names:
        z = frame.estimates[name].halves
        if name == "oidn" or z is None:
            continue
        pair = jnp.stack([z, y])
        images = pair[:, 0], pair[:, 1], *x
        matrix = of(*images, variance_a=a.variance, variance_b=b.variance)
        weighted = matrix[0, 0, 0, 0, 0] - matrix[1, 1, 0, 0, 0]
        row |= {
            f"{name} true": (error(z) - before) / before,
            f"{name} plain": float(metrics.rel_l2_change(z, y, x).mean) / before,
            f"{name} weighted": float(weighted) / before,
        }
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure all frames.

    Args:
        config: what to measure.

    Returns:
        numbers by "scene samples".

    Raises:
        ValueError: if the folder holds no frame.
    """
    kept, found = Results(config.results), {}
    every = list(development.frames(config.folder))[: 1 if config.quick else None]
    for scene, samples, path in tqdm(every, unit="frame"):
        name = f"{scene} {samples}"
        of = lambda p=path: measure(_read(p), quick=config.quick)
        found[name] = kept.get(name, of)
    return found


def _read(path: pathlib.Path) -> Frame:
    """A normalised frame."""
    return exr.read_frame(path).normalised()


def report(found: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        the tables named above.
    """
    first = next(iter(found.values()))
    late = {n: r for n, r in found.items() if n.split()[0] in LATE} or found
    tiers = [tier for tier in TIERS if tier in first]
    single = [n for n in (*oidn.VARIANTS,) if n in first]
    better = lambda row: min(row[name] for name in BASELINES)
    mean = lambda rows, name, base: errors.geometric_mean(
        row[name] / base(row) for row in rows.values()
    )
    setting = min(single, key=lambda name: mean(found, name, lambda row: row["oidn"]))
    by_setting = lambda row: row[setting]
    alone = [n for n in METHODS if n in first and n not in tiers]
    parts = [
        n
        for n in first
        if n.startswith("without ")
        or n in ("pixels of equal weight", "equal weights")
        or n.startswith("one window")
    ]
    shown = ["path tracing", "oidn", *tiers]
    held = lambda row, tier: [n for n in TIERS[tier].bases if n in row]
    least = lambda row, tier: min(row[name] for name in held(row, tier))
    estimated = lambda row: lambda name: row.get(f"{name} weighted", 0.0)  # of `oidn` 0
    chosen = lambda row, tier: row[min(held(row, tier), key=estimated(row))]
    over = lambda of: errors.means(
        {n: {t: r[t] / of(r, t) for t in tiers} for n, r in found.items()},
        tiers,
        lambda row: 1.0,
        title="tier",
    )
    worst = lambda name: max(r[name] / better(r) for r in found.values())
    said = [
        f"{tier} {mean(found, tier, better):.2f} (worst {worst(tier):.2f}; over "
        f"{setting} {mean(found, tier, by_setting):.2f})"
        for tier in tiers
    ]
    answer = (
        f"Relative L2 over the better of path tracing and OIDN, geometric mean of "
        f"{len(found)} frames of {len({n.split()[0] for n in found})} scenes: "
        f"{', '.join(said)}."
    )
    title = lambda rows, of: errors.means(rows, [*tiers, *alone], of, title="method")
    body = [
        "Over the better of path tracing and OIDN:",
        title(found, better),
        f"The same over {setting}:",
        errors.means(found, tiers, by_setting, title="tier"),
        "Late scenes only, over the better of path tracing and OIDN:",
        errors.means(late, tiers, better, title="tier"),
        "All scenes, over the member of the tier of least true error (regret):",
        over(least),
        "The same over the member of least error as the halves estimate it:",
        over(chosen),
        table(
            ["frame", *tiers, "the best single method"],
            [
                [name, *(r[t] / better(r) for t in tiers), min(alone, key=r.get)]
                for name, r in found.items()
            ],
        ),
    ]
    if parts:
        complete = {n: r for n, r in found.items() if all(p in r for p in parts)}
        of_best = lambda row: row["best"]
        body += [
            "`best` with less, over `best`:",
            errors.means(complete, parts, of_best, title="ablation"),
        ]
    body += [
        "FLIP (tone mapped), over that of `oidn`:",
        errors.means(
            {n: {t: r[f"{t} FLIP"] for t in shown} for n, r in found.items()},
            shown,
            lambda row: row["oidn"],
            title="image",
        ),
        _estimates(found, tiers),
        _changes(found, alone),
    ]
    plot = {"The estimated error beside the true one": estimates_plot(found, tiers)}
    return Report(answer, "\n\n".join(body), plot)


def estimates_plot(found: Mapping[str, errors.Row], tiers: Sequence[str]) -> Figure:
    """Draw every frame's estimated relative L2 against its true one."""
    figure, axes = plt.subplots(figsize=(5, 5))
    limits = [np.inf, 0.0]
    for tier in tiers:
        some = [r for r in found.values() if f"{tier} estimated" in r]
        if not some:
            continue
        true = np.array([r[tier] for r in some])
        said = true * [r[f"{tier} estimated"] for r in some]
        spread = true * [r[f"{tier} standard error"] for r in some]
        axes.errorbar(true, said, spread, fmt="o", markersize=4, label=tier)
        limits = [min(limits[0], true.min()), max(limits[1], true.max())]
    axes.plot(limits, limits, color="grey", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="true", ylabel="estimated")
    axes.legend()
    return figure


def _estimates(found: Mapping[str, Mapping[str, float]], tiers: list[str]) -> str:
    """How far estimated errors are from the true ones."""
    rows = []
    for tier in tiers:
        some = [r for r in found.values() if f"{tier} estimated" in r]
        if not some:
            continue
        ratio = np.array([max(r[f"{tier} estimated"], 1e-3) for r in some])
        rows.append(
            [
                tier,
                float(np.exp(np.mean(np.log(ratio)))),
                float(np.exp(np.mean(np.abs(np.log(ratio))))),
                float(ratio.min()),
                float(ratio.max()),
                float(np.mean([r[f"{tier} map"] for r in some])),
            ]
        )
    header = ["tier", "estimated / true", "factor between", "least", "most"]
    return table([*header, "rank correlation of the map"], rows)


def _changes(found: Mapping[str, Mapping[str, float]], names: list[str]) -> str:
    """How estimated changes against `oidn` go with the true ones."""
    rows = []
    for name in names:
        some = [r for r in found.values() if f"{name} true" in r]
        if len(some) < 2:
            continue
        true, plain, weighted = (
            np.array([r[f"{name} {kind}"] for r in some])
            for kind in ("true", "plain", "weighted")
        )
        slope = float(np.sum(plain * true) / np.sum(true**2))
        row = [name, slope]
        for said in (plain, weighted):
            row.append(errors.rank_correlation(true, said))
            row.append(float(np.mean(np.sign(said) != np.sign(true))))
        rows.append(row)
    header = ["change against oidn", "slope", "rank correlation", "wrong signs"]
    return table([*header, "weighted: rank correlation", "wrong signs"], rows)


if __name__ == "__main__":
    main(Config, run, report)
