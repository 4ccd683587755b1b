"""How much of the error of uncorrelated kernels and of others is bias?

Of many independent realisations (`realisations`) of synthetic and of rendered frames,
with the standard error of the squared bias over groups of them, in normalised radiance:

    bias^2, variance, error   means over pixels, relative to squared radiance
    plain bias^2              the mean that is not relative
    skewness                  Pearson's median skewness of the correlated estimates and
                              of their differences within windows: mean of its size, as
                              in the paper, to which few realisations add; and root mean
                              square without that, from two halves of the realisations
    falls                     bias^2 and variance at the fewest over those at the most
                              samples
"""

import dataclasses
import pathlib
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.uncorrelated.realisations import (
    METHODS,
    RENDERED,
    SYNTHETIC,
    Group,
    Plan,
    kept,
)

STEPS = 1, 3, 5, 7  # of differences whose skewness is measured, in pixels
_EPSILON = 0.01  # of the relative error, squared normalised radiance


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render, and how often.

    Attributes:
        work: folder that keeps the realisations.
        groups: of realisations, at least 3; errors of means are judged by them.
        of_each: realisations in a group.
        samples: samples a pixel of one sub-average, each in turn.
        size: width and height in pixels.
        window: width of the windows of methods with kernels.
        frames: which of the synthetic and rendered ones.
    """

    work: tyro.conf.Positional[pathlib.Path]
    groups: int = 10
    of_each: int = 30
    samples: tuple[int, ...] = (4, 16)
    size: int = 96
    window: int = 15
    frames: tuple[str, ...] = (*SYNTHETIC, *RENDERED)

    def __post_init__(self) -> None:
        """Groups are compared with each other; frames have known names."""
        if self.groups < 3 or self.of_each < 2:
            raise ValueError(
                "there must be at least 3 groups of 2 realisations, got "
                f"{self.groups} of {self.of_each}"
            )
        if unknown := {*self.frames} - {*SYNTHETIC, *RENDERED}:
            known = ", ".join([*map(repr, SYNTHETIC), *map(repr, RENDERED)])
            raise ValueError(f"no frame {min(unknown)!r}; there are {known}")


class Summary(NamedTuple):
    """What all groups say of one method.

    Attributes:
        bias: squared, relative; without what chance adds to it.
        bias_error: its standard error.
        plain: squared bias that is not relative, squared normalised radiance.
        variance: relative, of one realisation.
        map: relative bias of each pixel, mean over channels, noisy, [H,W].
    """

    bias: float
    bias_error: float
    plain: float
    variance: float
    map: np.ndarray


def summary(groups: list[Group], method: int) -> Summary:
    """Bias and variance of one method, by number."""
    truth = np.mean([g.control for g in groups], axis=0)
    weight = 1 / (truth.mean(axis=-1, keepdims=True) ** 2 + _EPSILON)
    away = np.stack([g.mean[method] - g.control for g in groups])

    def squared(away: np.ndarray, weight: np.ndarray | float = weight) -> float:
        # Products of different groups: their errors are independent.
        k, total, same = len(away), away.sum(axis=0) ** 2, (away**2).sum(axis=0)
        return float(np.mean(weight * (total - same)) / (k * (k - 1)))

    without = [squared(np.delete(away, k, axis=0)) for k in range(len(away))]
    error = np.std(without) * (len(away) - 1) ** 0.5  # jackknife
    return Summary(
        squared(away),
        float(error),
        squared(away, 1.0),
        float(np.mean([np.mean(weight * g.variance[method]) for g in groups])),
        (away.mean(axis=0) * weight**0.5).mean(axis=-1),
    )


def median_skewness(samples: np.ndarray) -> np.ndarray:
    """Pearson's median skewness over the first axis; 0 where nothing varies."""
    mean, deviation = samples.mean(axis=0), samples.std(axis=0)
    some = deviation > 0
    away = 3 * (mean - np.median(samples, axis=0))
    return np.where(some, away / np.where(some, deviation, 1), 0)


class Skewness(NamedTuple):
    """Skewness of many pixels, over realisations.

    Attributes:
        size: mean of its size.
        root: root mean square, without what chance adds to it.
    """

    size: float
    root: float


def skewness(images: Iterable[np.ndarray]) -> Skewness:
    """That of all pixels of images, or of differences of images, [R,...] each."""
    size = square = count = 0.0
    for samples in images:
        halves = median_skewness(samples[::2]), median_skewness(samples[1::2])
        size += abs(median_skewness(samples)).sum()
        square += (halves[0] * halves[1]).sum()
        count += halves[0].size
    return Skewness(size / count, max(square / count, 0.0) ** 0.5)


def differences(samples: np.ndarray) -> Iterator[np.ndarray]:
    """D_ci z of all pairs of pixels that are some `STEPS` apart, each pair once."""
    _, h, w, _ = samples.shape
    across = sorted({0, *STEPS, *(-step for step in STEPS)})
    for dy in (0, *STEPS):
        for dx in across:
            if (dy, dx) <= (0, 0) or dy >= h or abs(dx) >= w:
                continue
            left, right = max(0, -dx), max(0, dx)
            c = samples[:, : h - dy, left : w - right]
            yield samples[:, dy:, right : w - left] - c


class Measured(NamedTuple):
    """What is known of a frame.

    Attributes:
        methods: a summary each.
        skewness: of the correlated estimates, and of their differences.
        gamma: those chosen, and how often.
    """

    methods: dict[str, Summary]
    skewness: tuple[Skewness, Skewness]
    gamma: dict[float, int]


Found = dict[str, dict[int, Measured]]


def run(config: Config) -> Found:
    """Make and measure all realisations.

    Args:
        config: what, and where to keep it.

    Returns:
        what is known, by frame and samples.

    Raises:
        ImportError: if Open Image Denoise or Mitsuba is missing.
        ValueError: if there is no LLVM for common random numbers.
    """
    config.work.mkdir(parents=True, exist_ok=True)
    names = config.frames
    plan = Plan(
        config.work, config.groups, config.of_each, 0, config.size, config.window
    )
    if config.quick:
        plan = plan._replace(groups=3, of_each=4, size=24, window=5)
        names = names[1:3]
    return {
        name: {
            n: measure(kept(plan._replace(samples=n), name))
            for n in sorted(config.samples)
        }
        for name in tqdm(names, unit="frame")
    }


def measure(groups: list[Group]) -> Measured:
    """All that the groups of one frame say."""
    z = np.concatenate([g.correlated for g in groups])
    gamma = np.concatenate([g.gamma for g in groups]).round(6)
    values, counts = np.unique(gamma, return_counts=True)
    return Measured(
        {m: summary(groups, k) for k, m in enumerate(METHODS)},
        (skewness([z]), skewness(differences(z))),
        dict(zip(values.tolist(), counts.tolist(), strict=True)),
    )


def maps(found: dict[str, Measured]) -> Figure:
    """Maps of the bias: a row for each frame, a column for each method."""
    size = 1.4 * len(METHODS), 1.75 * len(found)
    figure = Figure(figsize=size, layout="compressed")
    axes = figure.subplots(len(found), len(METHODS), squeeze=False)
    for row, (name, result) in zip(axes, found.items(), strict=True):
        for axis, (method, one) in zip(row, result.methods.items(), strict=True):
            drawn = axis.imshow(100 * one.map, cmap="RdBu_r", vmin=-10, vmax=10)
            axis.set_title(f"{method}\n{one.bias:.1e}", fontsize=8)
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(name, fontsize=8)
    figure.colorbar(drawn, ax=axes, label="relative bias, %; above: its mean square")
    return figure


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        tables for each frame, and a row of maps at the most samples.
    """
    least, most = (of(next(iter(found.values()))) for of in (min, max))
    last = {name: by_samples[most] for name, by_samples in found.items()}

    def said(name: str, methods: dict[str, Summary]) -> str:
        ours, denoised = methods["uncorrelated"], methods["oidn"]
        share = max(ours.bias, 0) / (max(ours.bias, 0) + ours.variance)
        return (
            f"{share:.1%} of the error on {name} ({ours.bias / denoised.bias:.2g}, "
            f"plain {ours.plain / denoised.plain:.2g})"
        )

    each = "; ".join(said(name, result.methods) for name, result in last.items())
    answer = (
        "Squared bias of uncorrelated kernels, and in brackets its ratio to that of "
        f"Open Image Denoise, at {most} samples in each sub-average: {each}."
    )
    parts = [fall(found)] if least < most else []
    for name, by_samples in found.items():
        parts += [
            part
            for n, one in by_samples.items()
            for part in (_errors(f"{name}, {n} samples", one), _skewed(one))
        ]
    return Report(answer, "\n\n".join(parts), {"Maps of the bias": maps(last)})


def _errors(title: str, one: Measured) -> str:
    """A row for each method."""
    ours = one.methods["uncorrelated"]
    header = "bias^2", "its standard error", "/ uncorrelated's", "plain bias^2"
    more = "/ uncorrelated's", "variance", "error"
    cells = []
    for m, s in one.methods.items():
        plain = s.plain, s.plain / ours.plain
        relative = s.bias, s.bias_error, s.bias / ours.bias
        cells.append([m, *relative, *plain, s.variance, s.bias + s.variance])
    return table([title, *header, *more], cells)


def _skewed(one: Measured) -> str:
    """Skewness and gamma in a sentence."""
    of_z, of_differences = one.skewness
    chosen = ", ".join(f"{g:g} ({n} times)" for g, n in one.gamma.items())
    times = of_z.size / of_differences.size
    return (
        f"Size of the skewness {of_z.size:.3f}, of differences "
        f"{of_differences.size:.3f} ({times:.2f} times less); root mean "
        f"square {of_z.root:.3f} and {of_differences.root:.3f}; gamma {chosen}."
    )


def fall(found: Found) -> str:
    """How much less squared bias and variance are at the most samples."""
    names = "uncorrelated", "L2, uncorrelated", "oidn"
    rows = []
    for frame, by_samples in found.items():
        least, most = min(by_samples), max(by_samples)
        for method in names:
            few, many = (by_samples[n].methods[method] for n in (least, most))
            rows.append(
                [
                    f"{frame}, {method}",
                    f"{most / least:g}",
                    few.variance / many.variance,
                    few.bias / many.bias,
                    few.bias_error / few.bias,
                    many.bias_error / many.bias,
                    few.bias / few.variance,
                    many.bias / many.variance,
                ]
            )
    header = (
        *("falls", "samples", "variance", "bias^2"),
        *("relative error of the first bias^2", "of the second"),
        *("bias^2 / variance, few", "many"),
    )
    return table(header, rows)


if __name__ == "__main__":
    main(Config, run, report)
