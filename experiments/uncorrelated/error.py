"""What are uncorrelated kernels worth on rendered scenes, and what do they cost?

Every SCENES/NAME/scene.xml with a REFERENCES/NAME.npz (`archives`) is rendered: eight
sub-averages of independent and eight of common random numbers, and eight more
independent ones for the methods that have no use for common numbers, so that all spend
the same. Windows have 15x15 pixels. Errors are less the reference's noise, and divided
by those of path tracing with all samples independent.

    uncorrelated        two sub-averages, gamma of the extended candidates
    the paper's gammas  the same, gamma of the paper's ten, every row judged
    guides              of the weights: differences of y, or of z and y
    N sub-averages      eq. 8 with the mean square of all pairs' differences
    median kernel       the median square in its place, of eight sub-averages
    median of 4         `combine_median`, of eight sub-averages
    regions             gamma by the square of so many pixels around each
    L2                  reconstruction, from differences of z
    ensemble            of a few denoisers; of independent samples alone, or of half of
                        them with the uncorrelated result as one more base
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.errors import geometric_mean, means, relative_l2, squared_error
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.uncorrelated import rendered
from experiments.uncorrelated.rendered import SubAverages, merged
from jscomb import combine, uncorrelated
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.methods import METHODS
from jscomb.numerics.poisson import reconstruct
from jscomb.typing import Image
from jscomb.uncorrelated import MULTIPLES, PAPER_MULTIPLES, UNIT

SAMPLES = 16, 128, 1024  # of each kind
Guides = Literal["correlated", "independent", "both"]
Made = tuple[Image, Any]  # and gamma, or none
PAPERS = "the paper's gammas"
ENSEMBLE, WITH_IT = "ensemble", "ensemble with uncorrelated"
SAID = "uncorrelated", "uniform", "crosswise", "L2", "oidn"
_MEAN_OVER_MEDIAN = 2.198  # of the square of a normal number


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render and to measure.

    Attributes:
        scenes: folder of folders with a Mitsuba scene.xml each.
        references: folder of archives with references of the same names.
        work: folder that keeps what is rendered, and the results.
        samples: samples a pixel of each kind, multiples of eight.
        repeats: timed calls of each function.
        size: side of the image that is timed.
    """

    scenes: tyro.conf.Positional[pathlib.Path]
    references: tyro.conf.Positional[pathlib.Path]
    work: tyro.conf.Positional[pathlib.Path]
    samples: tuple[int, ...] = SAMPLES
    repeats: int = 3
    size: int = 192


def with_gradients(independent: Image, correlated: Image) -> Image:
    """L2 reconstruction from differences of correlated estimates."""
    differences = (jnp.diff(correlated, axis=axis) for axis in (1, 0))
    return reconstruct(independent, *differences)


def kernel(
    y: SubAverages,
    z: SubAverages,
    n: float,
    *,
    sub_averages: int = 2,
    guides: Guides = "correlated",
    region: int | None = None,
    median: bool = False,
    multiples: Sequence[int] = MULTIPLES,
    stride: int = 4,
) -> Made:
    """Select gamma and combine.

    Args:
        y: eight independent sub-averages.
        z: eight correlated ones.
        n: samples a pixel in each.
        sub_averages: B; gamma is selected by twice as many, but by no more than eight.
        guides: as for `uncorrelated.combine`.
        region: of `select_gamma_map`; None for one gamma.
        median: by `combine_median`, whose combinations have two sub-averages each.
        multiples: candidates of gamma.
        stride: of the rows that are judged.

    Returns:
        the image, and gamma.
    """
    count = 4 if median else min(2 * sub_averages, len(y))
    given = merged(y, count), merged(z, count), n * len(y) / count
    options = {"multiples": multiples, "stride": stride, "guides": guides}
    if region is None:
        gamma = uncorrelated.select_gamma(*given, **options)
    else:
        gamma = uncorrelated.select_gamma_map(*given, region=region, **options)
    by = uncorrelated.combine_median if median else uncorrelated.combine
    parts = merged(y, sub_averages), merged(z, sub_averages)
    return by(*parts, gamma, n * len(y) / sub_averages, guides=guides), gamma


def median_kernel(y: SubAverages, z: SubAverages, n: float) -> Made:
    """Weights by the median of all pairs, gamma that of the mean for normal noise."""
    gamma = _MEAN_OVER_MEDIAN * uncorrelated.select_gamma(y, z, n)
    by_median = uncorrelated.median_kernel(gamma, n)
    return uncorrelated.combine_with(by_median, y, z), gamma


def crosswise(y: SubAverages, z: SubAverages, n: float) -> Made:
    """The paper's unbiased kernel, of four sub-averages."""
    given = merged(y, 4), merged(z, 4)
    gamma = uncorrelated.select_gamma(*given, 2 * n, crosswise=True)
    return uncorrelated.combine_crosswise(*given, gamma, 2 * n), gamma


def of_reconstructions(y: SubAverages, z: SubAverages, n: float) -> Made:
    """Kernels of L2 reconstructions, of four sub-averages."""
    y, z = merged(y, 4), merged(z, 4)
    z = jax.vmap(with_gradients)(y, z)
    gamma = uncorrelated.select_gamma(y, z, 2 * n)
    return uncorrelated.combine_decorrelated(y, z, gamma, 2 * n), gamma


def _form(**options: Any) -> Callable[..., Made]:
    return functools.partial(kernel, **options)


KERNELS: dict[str, Callable[[SubAverages, SubAverages, float], Made]] = {
    "uniform": lambda y, z, n: (uncorrelated.combine_uniform(y, z), None),
    "crosswise": crosswise,
    "uncorrelated": kernel,
    PAPERS: _form(multiples=PAPER_MULTIPLES, stride=1),
    "guides y": _form(guides="independent"),
    "guides both": _form(guides="both"),
    "4 sub-averages": _form(sub_averages=4),
    "8 sub-averages": _form(sub_averages=8),
    "median kernel": median_kernel,
    "median of 4": _form(sub_averages=8, median=True),
    "regions of 33": _form(region=33),
    "regions of 65": _form(region=65),
    "L2": lambda y, z, n: (with_gradients(merged(y, 1)[0], merged(z, 1)[0]), None),
    "L2, uncorrelated": of_reconstructions,
}
COMPILED = {name: jax.jit(function) for name, function in KERNELS.items()}
_SLOW = "median kernel"  # to compile: not in the short version


def ensembles(every: Frame, y_frame: Frame, z_frame: Frame) -> dict[str, Image]:
    """The ensembles of all independent samples, and of half of them and both kinds."""
    key, bases = jax.random.key(0), METHODS["neural-ensemble"].bases
    by = functools.partial(combine, key, method="ensemble")
    ours = uncorrelated.combine_frame(y_frame, z_frame)
    both = y_frame.with_estimate("uncorrelated", ours)
    return {
        ENSEMBLE: by(every, biased=bases).image,
        WITH_IT: by(both, biased=[*bases, "uncorrelated"]).image,
    }


def measure(
    every: Frame, z_frame: Frame, names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Errors of these kernels and all else, and every gamma, of a pair of frames."""
    y_frame, _ = every.halves()
    assert y_frame.samples is not None
    y, z = y_frame.buffers.color, z_frame.buffers.color
    n = float(y_frame.samples) / len(y)
    made = {name: COMPILED[name](y, z, n) for name in names}
    images = {
        "path tracing": every.color,
        "oidn": oidn.denoise_frame(every).image,
        "common numbers": z_frame.color,
        "both kinds": (y_frame.color + z_frame.color) / 2,
        **{name: image for name, (image, _) in made.items()},
        **ensembles(every, y_frame, z_frame),
    }
    found = {name: gamma for name, (_, gamma) in made.items() if gamma is not None}
    halves = merged(y, 2), merged(z, 2)
    by = jax.jit(uncorrelated.combine)
    given = {_name(m): by(*halves, m * UNIT, 4 * n) for m in MULTIPLES}
    return {
        "relative L2": {k: relative_l2(image, every) for k, image in images.items()},
        "squared error": {k: squared_error(i, every) for k, i in images.items()},
        "gamma": {k: float(jnp.median(gamma)) for k, gamma in found.items()},
        "by gamma": {k: relative_l2(image, every) for k, image in given.items()},
    }


def speed(size: int, repeats: int, names: Sequence[str]) -> dict[str, float]:
    """Seconds of these kernels and of Open Image Denoise, without compilation."""
    keys = jax.random.split(jax.random.key(0))
    y, z = (
        jax.random.exponential(k, (rendered.SUB_AVERAGES, size, size, 3)) for k in keys
    )
    calls: dict[str, Callable] = {
        name: functools.partial(COMPILED[name], y, z, 8.0) for name in names
    }
    calls["oidn"] = lambda: oidn.denoise_normalised(
        y[0], albedo=jnp.clip(y[1], 0, 1), normal=z[1]
    )
    return medians(calls, repeats)


def run(config: Config) -> dict:
    """Render and measure everything.

    Args:
        config: what, and where to keep it.

    Returns:
        `frames`: errors and gammas by "scene samples"; `speed`: seconds by method.

    Raises:
        ValueError: if no scene has a reference.
    """
    paths = rendered.scene_files(config.scenes, config.references)
    names, size, repeats = [*COMPILED], config.size, config.repeats
    todo = rendered.named(paths, config.samples)
    if config.quick:
        todo, size, repeats = rendered.named(paths[:1], (8,)), 32, 1
        names.remove(_SLOW)
    kept = Results(config.work / "results.jsonl")
    config.work.mkdir(parents=True, exist_ok=True)

    def measured(path: pathlib.Path, samples: int) -> dict:
        reference = rendered.read_reference(path, config.references)
        pair = rendered.frame_pair(path, samples, reference, config.work)
        return measure(*pair, names)

    frames = {
        name: kept.get(name, functools.partial(measured, *each))
        for name, each in tqdm(todo.items(), unit="frame")
    }
    times = kept.get(f"speed {size}", lambda: speed(size, repeats, names))
    return {"frames": frames, "speed": times, "size": size}


def at_the_edge(frames: dict[str, dict]) -> str:
    """Say how often gamma is at an end of the candidates, and what more gain."""
    rows, papers = list(frames.values()), [_name(m) for m in PAPER_MULTIPLES]

    def edges(gammas: Sequence[str], low: str, high: str) -> str:
        counts = gammas.count(low), gammas.count(high)
        return f"{counts[0]} times at {low} and {counts[1]} times at {high}"

    best = [min(row["by gamma"], key=row["by gamma"].get) for row in rows]
    of_papers = [min(papers, key=row["by gamma"].get) for row in rows]
    gains = {
        "selected": [
            row["relative L2"]["uncorrelated"] / row["relative L2"][PAPERS]
            for row in rows
        ],
        "best": [
            row["by gamma"][a] / row["by gamma"][b]
            for row, a, b in zip(rows, best, of_papers, strict=True)
        ],
    }
    low, end, high = _name(MULTIPLES[0]), papers[0], papers[-1]
    chosen = {
        name: [f"{row['gamma'][name]:.3g}" for row in rows]
        for name in (PAPERS, "uncorrelated")
    }
    return (
        f"Of {len(rows)} frames gamma of the paper's candidates is "
        f"{edges(chosen[PAPERS], end, high)}, that of the extended ones "
        f"{edges(chosen['uncorrelated'], low, high)}; the one of least measured error "
        f"{edges(of_papers, end, high)}, and {edges(best, low, high)}. The extended "
        f"ones change the error to {_span(gains['selected'])} where gamma is selected, "
        f"{_span(gains['best'])} where it is the one of least measured error."
    )


def _name(multiple: int) -> str:
    return f"{multiple * UNIT:.3g}"


def _span(each: Sequence[float]) -> str:
    return f"{geometric_mean(each):.3f} ({min(each):.3f} to {max(each):.3f})"


def report(found: dict) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors, gammas and times.
    """
    frames, times = found["frames"], found["speed"]
    relative, plain = (
        {name: row[kind] for name, row in frames.items()}
        for kind in ("relative L2", "squared error")
    )
    traced = "path tracing"
    of = lambda rows, method: [r[method] / r[traced] for r in rows.values()]
    said = "; ".join(
        f"{method} {geometric_mean(of(relative, method)):.2f} "
        f"(worst {max(of(relative, method)):.2f})"
        for method in (*SAID, ENSEMBLE, WITH_IT)
    )
    answer = (
        f"Relative L2 over path tracing's at equal samples, geometric mean of "
        f"{len(frames)} frames: {said}. At {found['size']}x{found['size']} selecting "
        f"and combining take {times['uncorrelated']:.1f} s, Open Image Denoise "
        f"{times['oidn']:.1f} s."
    )
    beside = {
        "squared error": lambda method: geometric_mean(of(plain, method)),
        "its worst": lambda method: max(of(plain, method)),
        "seconds": times.get,
    }
    base = lambda row: row[traced]
    methods = list(next(iter(relative.values())))
    first = means(relative, methods, base, title="method", beside=beside)
    parts = [first, at_the_edge(frames)]
    every = {
        "relative L2": relative,
        **{
            kind: {name: row[kind] for name, row in frames.items()}
            for kind in ("gamma", "by gamma")
        },
    }
    for kind, rows in every.items():
        names = next(iter(rows.values()))
        cells = [[name, *(row[name] for row in rows.values())] for name in names]
        parts.append(table([kind, *rows], cells))
    return Report(answer, "\n\n".join(parts))


if __name__ == "__main__":
    main(Config, run, report)
