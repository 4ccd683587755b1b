"""How much of the error of uncorrelated kernels and of others is bias?

Hundreds of independent realisations of synthetic frames (`synthetic`) and of rendered
ones: four sub-averages of independent and four of common random numbers, and four more
independent ones for the methods that have no use for common numbers. With the standard
error of the squared bias over groups of realisations:

    bias^2, variance, error   means over pixels, relative to squared radiance
    skewness                  Pearson's median skewness of the correlated estimates and
                              of their differences within windows, mean of its size
"""

import dataclasses
import functools
import itertools
import pathlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.data import synthetic
from experiments.uncorrelated.error import with_gradients
from jscomb import james_stein, uncorrelated
from jscomb.denoisers import bilateral, oidn
from jscomb.features import stack
from jscomb.frame import Frame, make_frame
from jscomb.rendering import Launcher, Pass, Settings
from jscomb.typing import Image, Key

SYNTHETIC = {"synthetic, symmetric": 0.0, "synthetic, skewed": 8.0}
RENDERED = "cornell-glass", "cornell-glossy"
CORRELATION = 0.9
REACH = 7  # of differences whose skewness is measured
FEATURE_SPP = 64
METHODS = (
    "path tracing",
    "uniform",
    "crosswise",
    "uncorrelated",
    "L2, uncorrelated",
    "oidn",
    "bilateral",
    "james-stein",
)
_EPSILON = 0.01  # of the relative error, squared normalised radiance


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render, and how often.

    Attributes:
        work: folder that keeps the realisations.
        groups: of realisations, at least 3; errors of means are judged by them.
        of_each: realisations in a group.
        samples: samples a pixel of one sub-average.
        size: width and height in pixels.
        window: width of the windows of methods with kernels.
    """

    work: tyro.conf.Positional[pathlib.Path]
    groups: int = 10
    of_each: int = 30
    samples: int = 16
    size: int = 96
    window: int = 15

    def __post_init__(self) -> None:
        """Groups are compared with each other."""
        if self.groups < 3 or self.of_each < 2:
            raise ValueError(
                "there must be at least 3 groups of 2 realisations, got "
                f"{self.groups} of {self.of_each}"
            )


class Group(NamedTuple):
    """What a group of realisations leaves.

    Attributes:
        mean: mean image of each method, [M,H,W,C].
        variance: of a realisation of each method, [M,H,W,C].
        control: an unbiased image made of all samples, or the truth, [H,W,C].
        correlated: mean correlated image of each realisation, [R,H,W,C].
        gamma: that was chosen in each realisation, [R].
    """

    mean: np.ndarray
    variance: np.ndarray
    control: np.ndarray
    correlated: np.ndarray
    gamma: np.ndarray


def methods(
    guide: Frame, samples: int, window: int
) -> Callable[[Array, Array], dict[str, Image]]:
    """All images of one realisation, and gamma, of normalised radiance.

    Args:
        guide: a frame whose features guide the denoisers.
        samples: samples a pixel of one sub-average.
        window: width of the windows of kernels.

    Returns:
        a function of [8,H,W,C] independent and [4,H,W,C] correlated sub-averages.
    """
    features = stack(guide)

    select, uniform, crosswise, combine, decorrelated = (
        functools.partial(function, window=window)
        for function in (
            uncorrelated.select_gamma,
            uncorrelated.combine_uniform,
            uncorrelated.combine_crosswise,
            uncorrelated.combine,
            uncorrelated.combine_decorrelated,
        )
    )

    def combined(independent: Array, z: Array) -> dict[str, Image]:
        y, n = independent[:4], float(samples)
        x = jnp.mean(independent, axis=0)
        v = jnp.var(independent, axis=0, ddof=1) / len(independent)
        halves = [jnp.mean(i.reshape(2, 2, *i.shape[1:]), axis=1) for i in (y, z)]
        gamma, z_l2 = select(y, z, n), jax.vmap(with_gradients)(y, z)
        denoised = oidn.denoise_normalised(x, albedo=guide.albedo, normal=guide.normal)
        return {
            "path tracing": x,
            "uniform": uniform(y, z),
            "crosswise": crosswise(y, z, select(y, z, n, crosswise=True), n),
            "uncorrelated": combine(*halves, gamma, 2 * n),
            "L2, uncorrelated": decorrelated(y, z_l2, select(y, z_l2, n), n),
            "oidn": denoised,
            "bilateral": bilateral.denoise(x, v, features),
            "james-stein": james_stein.combine(
                x, denoised, james_stein.robust_variance(v), window=7, whiten=True
            ),
            "gamma": gamma,
        }

    return combined


def synthetic_groups(config: Config, skewness: float, skip: int = 0) -> Iterator[Group]:
    """Groups of realisations of the synthetic frame, each by one vmap over keys."""
    scene, n = synthetic.make_scene(config.size), config.samples
    region = jax.nn.one_hot(scene.region, 3, dtype=jnp.float32)
    guide = make_frame(scene.truth.astype(jnp.float32), albedo=region)
    combined = methods(guide, n, config.window)

    def draws(key: Key, count: int, correlation: float) -> Array:
        draw = lambda k: synthetic.draw(
            k, scene, n, correlation=correlation, skewness=skewness
        )
        return jax.vmap(draw)(jax.random.split(key, count)).astype(jnp.float32)

    @jax.jit
    @jax.vmap
    def realise(key: Key) -> tuple[dict[str, Image], Image]:
        of_y, of_z = jax.random.split(key)
        z = draws(of_z, 4, CORRELATION)
        return combined(draws(of_y, 8, 0.0), z), jnp.mean(z, axis=0)

    for number in range(skip, config.groups):
        keys = jax.random.split(jax.random.key(number), config.of_each)
        images, correlated = realise(keys)
        yield _group(images, np.asarray(correlated), np.asarray(scene.truth))


def rendered_groups(config: Config, name: str, skip: int = 0) -> Iterator[Group]:
    """Groups of realisations of an own scene; streams of numbers go by the group."""
    of = lambda numbers: Launcher(name, Settings(size=config.size, numbers=numbers))
    independent, common = of("independent"), of("common")
    aov = independent(Pass("aov", FEATURE_SPP, 0, "aov"))
    first = independent(Pass("color", FEATURE_SPP, 0, "path"))
    guide = make_frame(
        np.float32(first),
        albedo=np.float32(aov[..., :3].clip(0, 1)),
        normal=np.float32(aov[..., 3:6]),
        depth=np.float32(aov[..., 6:7]),
    )
    combined = jax.jit(methods(guide, config.samples, config.window))
    unit = float(guide.median_luminance)

    def draws(launch: Callable, seeds: Iterator[int], count: int) -> Array:
        each = [
            launch(Pass("", config.samples, next(seeds), "path")) for _ in range(count)
        ]
        return jnp.asarray(np.stack(each) / unit, "float32")

    for number in range(skip, config.groups):
        seeds = itertools.count(1 + number * 10**6)
        images, correlated = [], []
        for _ in tqdm(range(config.of_each), desc=f"{name}, {number}", leave=False):
            y, z = draws(independent, seeds, 8), draws(common, seeds, 4)
            images.append(jax.tree.map(np.asarray, combined(y, z)))
            correlated.append(np.mean(z, axis=0))
        stacked = {k: np.stack([i[k] for i in images]) for k in images[0]}
        yield _group(stacked, np.stack(correlated), None)


def _group(
    images: dict[str, Image], correlated: np.ndarray, truth: np.ndarray | None
) -> Group:
    """The statistics of realisations stacked on the first axis."""
    images = {name: np.asarray(each, np.float64) for name, each in images.items()}
    control = images["path tracing"].mean(axis=0) if truth is None else truth
    each = [images[method] for method in METHODS]
    return Group(
        np.stack([i.mean(axis=0) for i in each]),
        np.stack([i.var(axis=0, ddof=1) for i in each]),
        control,
        correlated,
        images["gamma"],
    )


def kept(config: Config, name: str) -> list[Group]:
    """All groups of a frame; those on disk are not made again."""
    if name in SYNTHETIC:
        make = lambda skip: synthetic_groups(config, SYNTHETIC[name], skip)
    else:
        make = lambda skip: rendered_groups(config, name, skip)
    size = f"{config.size}-{config.samples}-{config.of_each}-{config.window}"
    files = [config.work / f"{name}-{size}-{k}.npz" for k in range(config.groups)]
    done = next((k for k, file in enumerate(files) if not file.exists()), len(files))
    for file, group in zip(files[done:], make(done), strict=True):
        np.savez(file, **group._asdict())
    return [Group(**np.load(file)) for file in files]


class Summary(NamedTuple):
    """What all groups say of one method.

    Attributes:
        bias: squared, relative; without what chance adds to it.
        bias_error: its standard error.
        variance: relative, of one realisation.
        map: relative bias of each pixel, mean over channels, noisy, [H,W].
    """

    bias: float
    bias_error: float
    variance: float
    map: np.ndarray


def summary(groups: list[Group], method: int) -> Summary:
    """Bias and variance of one method, by number."""
    truth = np.mean([g.control for g in groups], axis=0)
    weight = 1 / (truth.mean(axis=-1, keepdims=True) ** 2 + _EPSILON)
    away = np.stack([g.mean[method] - g.control for g in groups])

    def squared(away: np.ndarray) -> float:
        # Products of different groups: their errors are independent.
        k, total, same = len(away), away.sum(axis=0) ** 2, (away**2).sum(axis=0)
        return float(np.mean(weight * (total - same)) / (k * (k - 1)))

    without = [squared(np.delete(away, k, axis=0)) for k in range(len(away))]
    error = np.std(without) * (len(away) - 1) ** 0.5  # jackknife
    return Summary(
        squared(away),
        float(error),
        float(np.mean([np.mean(weight * g.variance[method]) for g in groups])),
        (away.mean(axis=0) * weight**0.5).mean(axis=-1),
    )


def skewness(samples: np.ndarray) -> np.ndarray:
    """Size of Pearson's median skewness over the first axis; 0 where nothing varies."""
    mean, deviation = samples.mean(axis=0), samples.std(axis=0)
    some = deviation > 0
    away = 3 * abs(mean - np.median(samples, axis=0))
    return np.where(some, away / np.where(some, deviation, 1), 0)


def skewness_of_differences(samples: np.ndarray, reach: int) -> float:
    """Mean size of the skewness of D_ci z over all pairs of pixels in one window."""
    _, h, w, _ = samples.shape
    total, count = 0.0, 0
    for dy in range(min(reach, h - 1) + 1):
        for dx in range(-reach, reach + 1):
            if (dy, dx) <= (0, 0) or abs(dx) >= w:  # each pair once
                continue
            left, right = max(0, -dx), max(0, dx)
            c = samples[:, : h - dy, left : w - right]
            i = samples[:, dy:, right : w - left]
            found = skewness(i - c)
            total, count = total + found.sum(), count + found.size
    return total / count


class Measured(NamedTuple):
    """What is known of a frame.

    Attributes:
        methods: a summary each.
        skewness: of the correlated estimates, and of their differences.
        gamma: those chosen, and how often.
    """

    methods: dict[str, Summary]
    skewness: tuple[float, float]
    gamma: dict[float, int]


def run(config: Config) -> dict[str, Measured]:
    """Make and measure all realisations.

    Args:
        config: what, and where to keep it.

    Returns:
        what is known, by frame.

    Raises:
        ImportError: if Open Image Denoise or Mitsuba is missing.
        ValueError: if there is no LLVM for common random numbers.
    """
    config.work.mkdir(parents=True, exist_ok=True)
    names = [*SYNTHETIC, *RENDERED]
    if config.quick:
        config = dataclasses.replace(config, groups=3, of_each=4, size=24, window=5)
        names = [names[1], names[2]]
    return {name: measure(kept(config, name)) for name in tqdm(names, unit="frame")}


def measure(groups: list[Group]) -> Measured:
    """All that the groups of one frame say."""
    z = np.concatenate([g.correlated for g in groups])
    gamma = np.concatenate([g.gamma for g in groups]).round(6)
    values, counts = np.unique(gamma, return_counts=True)
    return Measured(
        {m: summary(groups, k) for k, m in enumerate(METHODS)},
        (float(skewness(z).mean()), skewness_of_differences(z, REACH)),
        dict(zip(values.tolist(), counts.tolist(), strict=True)),
    )


def maps(found: dict[str, Measured]) -> Figure:
    """Maps of the bias: a row for each frame, a column for each method."""
    size = 2 * len(METHODS), 2.3 * len(found)
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


def report(found: dict[str, Measured]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        a table and a row of maps for each frame.
    """

    def said(name: str, methods: dict[str, Summary]) -> str:
        ours, denoised = methods["uncorrelated"], methods["oidn"]
        share = max(ours.bias, 0) / (max(ours.bias, 0) + ours.variance)
        return f"{share:.0%} of the error on {name} ({ours.bias / denoised.bias:.2g})"

    each = "; ".join(said(name, result.methods) for name, result in found.items())
    answer = (
        "Squared bias of uncorrelated kernels, and in brackets its ratio to that of "
        f"Open Image Denoise: {each}."
    )
    header = "bias^2", "its standard error", "/ uncorrelated's", "variance", "error"
    parts = []
    for name, result in found.items():
        ours = result.methods["uncorrelated"].bias
        cells = [
            [m, s.bias, s.bias_error, s.bias / ours, s.variance, s.bias + s.variance]
            for m, s in result.methods.items()
        ]
        of_z, of_differences = result.skewness
        chosen = ", ".join(f"{g:g} ({n} times)" for g, n in result.gamma.items())
        parts.append(table([name, *header], cells))
        parts.append(
            f"Skewness {of_z:.3f}, of differences {of_differences:.3f} "
            f"({of_z / of_differences:.2f} times less); gamma {chosen}."
        )
    return Report(answer, "\n\n".join(parts), {"Maps of the bias": maps(found)})


if __name__ == "__main__":
    main(Config, run, report)
