"""What are the variants of Open Image Denoise worth, alone, as an ensemble, as a map?

Every frame of the folder (`archives`), features and halves as they were rendered:

    variants   relative L2, less the reference's noise, of each variant, divided by that
               of `oidn`: geometric mean by samples a pixel, over all, and the worst.
    ensembles  the same of multi-scale ensembles of ever more of them, and of other
               denoisers.
    maps       rank correlation over 7x7 blocks of the true squared error of `oidn` with
               what needs no reference: the variance over its eight turns and over all
               variants, which need no half buffers either, SURE, and the error of one
               half's image against the other half.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.common import archives, errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb import ensemble, methods
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.numerics import sure

FEATURES = "oidn", "oidn-albedo", "oidn-color", "oidn-demodulated"
CLEAN = "oidn-clean", "oidn-clean-balanced"
TURNED = "oidn-turned", "oidn-clean-turned"
OTHERS = "bilateral", "rdfc"
ENSEMBLES = {
    "features": FEATURES,
    "features, clean": FEATURES + CLEAN,
    "features, clean, turned": FEATURES + CLEAN + TURNED,
    "features, clean, turned, pd": (*FEATURES, *CLEAN, *TURNED, "pd"),
    "all": (*FEATURES, *CLEAN, *TURNED, "pd", *OTHERS),
    "all but turned": (*FEATURES, *CLEAN, "pd", *OTHERS),
    "before: oidn, oidn-color, bilateral, rdfc, pd": (
        *("oidn", "oidn-color"),
        *("bilateral", "rdfc", "pd"),
    ),
}
MAPS = "turns", "variants", "SURE", "halves"
BLOCK = 7


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that the frames' results are kept in; None to keep none.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None


def maps(frame: Frame, family: dict) -> dict[str, float]:
    """Rank correlations with the true error, by map."""
    assert frame.reference is not None
    y, halves = family["oidn"]
    half_a, half_b = frame.halves()
    denoise = functools.partial(oidn.denoise_color, frame=frame)
    risk = sure.monte_carlo_sure(
        jax.random.key(0), denoise, frame.color, frame.variance, slope_limit=1.0
    )
    crossed = [
        jnp.square(halves[0] - half_b.color) - half_b.variance,
        jnp.square(halves[1] - half_a.color) - half_a.variance,
    ]
    found = {
        "turns": jnp.var(oidn.denoise_turns(frame), axis=0),
        "variants": jnp.var(jnp.stack([e.image for e in family.values()]), axis=0),
        "SURE": risk.squared_error,
        "halves": sum(crossed) / 2,
    }
    means = lambda image: errors.block_means(image, BLOCK)
    truth = means(jnp.square(y - frame.reference.image))
    return {n: errors.rank_correlation(means(found[n]), truth) for n in MAPS}


def measure(frame: Frame, titles: Iterable[str]) -> dict[str, float]:
    """Errors of variants and of some ensembles, and correlations of maps."""
    frame = frame._replace(estimates={})  # the archive's own has shared features
    names = list(oidn.VARIANTS)
    made = oidn.denoise_variants(frame, list(oidn.VARIANTS.values()))
    family = dict(zip(names, made, strict=True))
    bases = dict(family)
    for name in ("pd", *OTHERS):
        bases[name] = methods.METHODS[name].estimate(jax.random.key(0), frame)
    error = lambda image: errors.relative_l2(image, frame)
    row = {name: error(each.image) for name, each in bases.items()}
    for title in titles:
        some = {name: bases[name] for name in ENSEMBLES[title]}
        mixed = ensemble.combine_frame(frame, some)
        row[title] = error(mixed.image)
    return row | maps(frame, family)


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure all frames.

    Args:
        config: what to measure.

    Returns:
        by "frame samples": errors by variant and ensemble, correlations by map.

    Raises:
        ValueError: if the folder holds no archive.
    """
    titles = [*ENSEMBLES]
    measures = {"": functools.partial(measure, titles=[titles[0], titles[-1]])}
    if not config.quick:
        measures = {"": functools.partial(measure, titles=titles)}
    return archives.measured(
        config.folder, measures, results=config.results, quick=config.quick
    )


def report(found: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        the tables named above.
    """
    rows = list(found.values())
    titles = [title for title in ENSEMBLES if title in rows[0]]
    baseline = lambda row: row["oidn"]
    alone = [*oidn.VARIANTS, "pd", *OTHERS]
    correlations = {name: [row[name] for row in rows] for name in MAPS}
    body = [
        errors.means(found, alone, baseline, title="one image / oidn"),
        errors.means(found, titles, baseline, title="ensemble / oidn"),
        table(
            ["map", "mean rank correlation", "least"],
            [[name, float(np.mean(c)), min(c)] for name, c in correlations.items()],
        ),
    ]
    ratios = {
        name: [row[name] / row["oidn"] for row in rows] for name in (*alone, *titles)
    }
    mean = {name: errors.geometric_mean(each) for name, each in ratios.items()}
    best = min(titles, key=mean.__getitem__)
    single = min(oidn.VARIANTS, key=mean.__getitem__)
    before = titles[-1]
    answer = (
        f"The best ensemble ({best}) has {mean[best]:.2f} of the error of `oidn` "
        f"(geometric mean of {len(rows)} frames; worst {max(ratios[best]):.2f}), that "
        f"of before {mean[before]:.2f} ({max(ratios[before]):.2f}), the best single "
        f"variant (`{single}`) {mean[single]:.2f} ({max(ratios[single]):.2f}). The "
        f"variance over eight turns has a rank correlation of "
        f"{np.mean(correlations['turns']):.2f} with the true error, SURE "
        f"{np.mean(correlations['SURE']):.2f}, half buffers "
        f"{np.mean(correlations['halves']):.2f}."
    )
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
