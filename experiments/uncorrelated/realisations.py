"""Hundreds of realisations of a frame by every method, and what they leave on disk.

A frame is synthetic (`synthetic`) or an own scene, rendered; a realisation has four
sub-averages of independent and four of common random numbers, and four more independent
ones for the methods that have no use for common numbers.
"""

import functools
import itertools
import pathlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from experiments.data import synthetic
from experiments.uncorrelated.error import with_gradients
from jscomb import james_stein, uncorrelated
from jscomb.denoisers import bilateral, oidn
from jscomb.features import stack
from jscomb.frame import Frame, make_frame
from jscomb.rendering import Launcher, Pass, Settings
from jscomb.typing import Image, Key

SYNTHETIC = {"synthetic, symmetric": 0.0, "synthetic, skewed": 5.0}
RENDERED = "cornell-glass", "cornell-glossy"
CORRELATION = 0.9
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


class Plan(NamedTuple):
    """How many realisations of what size.

    Attributes:
        work: folder that keeps them.
        groups: of realisations.
        of_each: realisations in a group.
        samples: samples a pixel of one sub-average.
        size: width and height in pixels.
        window: width of the windows of methods with kernels.
    """

    work: pathlib.Path
    groups: int
    of_each: int
    samples: int
    size: int
    window: int


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


def synthetic_groups(plan: Plan, skewness: float, skip: int = 0) -> Iterator[Group]:
    """Groups of realisations of the synthetic frame, each by one vmap over keys."""
    scene, n = synthetic.make_scene(plan.size), plan.samples
    region = jax.nn.one_hot(scene.region, 3, dtype=jnp.float32)
    guide = make_frame(scene.truth.astype(jnp.float32), albedo=region)
    combined = methods(guide, n, plan.window)

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

    for number in range(skip, plan.groups):
        keys = jax.random.split(jax.random.key(number), plan.of_each)
        images, correlated = realise(keys)
        yield _group(images, np.asarray(correlated), np.asarray(scene.truth))


def rendered_groups(plan: Plan, name: str, skip: int = 0) -> Iterator[Group]:
    """Groups of realisations of an own scene; streams of numbers go by the group."""
    of = lambda numbers: Launcher(name, Settings(size=plan.size, numbers=numbers))
    independent, common = of("independent"), of("common")
    aov = independent(Pass("aov", FEATURE_SPP, 0, "aov"))
    first = independent(Pass("color", FEATURE_SPP, 0, "path"))
    guide = make_frame(
        np.float32(first),
        albedo=np.float32(aov[..., :3].clip(0, 1)),
        normal=np.float32(aov[..., 3:6]),
        depth=np.float32(aov[..., 6:7]),
    )
    combined = jax.jit(methods(guide, plan.samples, plan.window))
    unit = float(guide.median_luminance)

    def draws(launch: Callable, seeds: Iterator[int], count: int) -> Array:
        each = [
            launch(Pass("", plan.samples, next(seeds), "path")) for _ in range(count)
        ]
        return jnp.asarray(np.stack(each) / unit, "float32")

    for number in range(skip, plan.groups):
        seeds = itertools.count(1 + number * 10**6)
        images, correlated = [], []
        for _ in tqdm(range(plan.of_each), desc=f"{name}, {number}", leave=False):
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


def kept(plan: Plan, name: str) -> list[Group]:
    """All groups of a frame; those on disk are not made again."""
    if name in SYNTHETIC:
        make = lambda skip: synthetic_groups(plan, SYNTHETIC[name], skip)
    else:
        make = lambda skip: rendered_groups(plan, name, skip)
    size = f"{plan.size}-{plan.samples}-{plan.of_each}-{plan.window}"
    files = [plan.work / f"{name}-{size}-{k}.npz" for k in range(plan.groups)]
    done = next((k for k, file in enumerate(files) if not file.exists()), len(files))
    for file, group in zip(files[done:], make(done), strict=True):
        np.savez(file, **group._asdict())
    return [Group(**np.load(file)) for file in files]
