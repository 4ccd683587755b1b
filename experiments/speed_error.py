"""What does windowed regression cost, and what does it do to the error?

    python -m experiments.speed_error FOLDER

Three tables and a plot, from the archives in the folder (see `frames`):

    time     of the whole regression on random images, beside its parts timed alone in
             the same run: the weights, the products of features, both matrix products.
             The ceiling is a plain matrix product of that shape.
    error    of y and of y* (its mean over the halves) for each stride and window, with
             the time of each; relative L2 less the reference's noise, at an exposure
             of 1. The base y is Open Image Denoise, or non-local means, a weak one.
    choice   what the halves say of y*, and what the reference says.
"""

import dataclasses
import functools
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib import pyplot as plt
from tqdm import tqdm

from experiments import frames
from jscomb import james_stein
from jscomb.denoisers import nfor, nonlocal_means
from jscomb.features import select, stack
from jscomb.frame import Biased, Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import regression

WINDOW, FEATURES, CHANNELS = 51, 11, 3
SETTINGS = [(1, 51), (2, 51), (4, 51), (8, 51), (1, 31), (1, 21), (2, 21)]


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        size: width and height of the random images that are timed, in pixels.
        repeats: timed calls of each function; they take turns.
        plot: file to draw time against error in; None for no plot.
        quick: small images, one frame.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    size: int = 512
    repeats: int = 5
    plot: pathlib.Path | None = None
    quick: bool = False


def medians(functions: dict[str, Callable], repeats: int) -> dict[str, float]:
    """Median seconds of each function of no argument; they take turns.

    Args:
        functions: by name.
        repeats: timed calls of each, after one to warm up.

    Returns:
        seconds by name.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    for repeat in range(repeats + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in times.items()}


def parts(size: int) -> dict[str, Callable]:
    """The regression, and its parts for as many tiles, on random images."""
    key = jax.random.key(0)
    shape = lambda channels: (size, size, channels)
    t, g, f = (jax.random.uniform(key, shape(c)) for c in (CHANNELS, 3, FEATURES))
    grid = regression._grid(WINDOW, 1)
    tiles, batch = grid.tiles(size) ** 2, grid.batch
    n, m = grid.width(grid.reach) ** 2, grid.side**2
    basis = jax.random.normal(key, (batch, FEATURES + 1, n))
    target, weights = basis[:, :CHANNELS], jax.random.uniform(key, (batch, m, n))
    guide = jax.random.uniform(key, (batch, 3, n))
    inside = regression._inside(grid)
    phi = jax.vmap(regression._products)(basis, target)
    b = jax.random.normal(key, (batch, (FEATURES + 1) * CHANNELS + 1, m))

    def repeated(step: Callable, *arrays: jax.Array) -> Callable:
        """As often as there are tiles, in one compiled loop."""

        def loop(*arrays: jax.Array) -> tuple:
            def body(_: jax.Array, state: tuple) -> tuple:
                # Each turn feeds the next, and leaves all of its result: no turn and
                # no element can be left out.
                first, _ = state
                out = step(first, *arrays[1:])
                return first * (1 + 1e-20 * out.ravel()[0]), out

            out = jax.eval_shape(step, *arrays)
            start = arrays[0], jnp.zeros(out.shape, out.dtype)
            return jax.lax.fori_loop(0, tiles // batch, body, start)

        compiled = jax.jit(loop)
        return lambda: compiled(*arrays)

    def weigh(guide: jax.Array) -> jax.Array:
        side = int(np.sqrt(n))
        one = lambda g: regression._gaussian(g.reshape(3, side, side), grid)
        return jnp.where(inside, jax.vmap(one)(guide), 0.0)

    fit = lambda stride: jax.jit(
        functools.partial(regression.local_linear, bandwidth=0.1, stride=stride)
    )
    whole = {f"stride {s}": fit(s) for s in (1, 2, 4, 8)}
    run = lambda function: lambda: function(t, g, f)
    return {name: run(function) for name, function in whole.items()} | {
        "weights": repeated(weigh, guide),
        "products of features": repeated(jax.vmap(regression._products), basis, target),
        "moments, matrix product": repeated(
            lambda p, w: jnp.einsum("bpn,bmn->bpm", p, w), phi, weights
        ),
        "predictions, matrix product": repeated(
            lambda b, w: jnp.einsum("bpm,bmn->bpn", b, w), b, weights
        ),
    }


PARTS = (
    "weights",
    "products of features",
    "moments, matrix product",
    "predictions, matrix product",
)


def useful_operations(size: int) -> float:
    """2 (moments + predictions) for each pixel of each clipped window."""
    p = FEATURES + 1
    columns = p * (p + 1) // 2 + p * CHANNELS + p * CHANNELS + 1
    at = np.arange(size)
    r = WINDOW // 2
    along = np.minimum(at + r, size - 1) - np.maximum(at - r, 0) + 1
    return 2.0 * columns * float(along.sum()) ** 2


class Errors(NamedTuple):
    """One frame with one base image.

    Attributes:
        base: relative L2 of y.
        regressed: relative L2 of y* by (stride, window).
        seconds: median time of y* by (stride, window).
        change: estimated change of the error, with its standard error.
        true: the change by the reference, in the same weighting.
        dropped: features left out.
    """

    base: float
    regressed: dict[tuple[int, int], float]
    seconds: dict[tuple[int, int], float]
    change: tuple[float, float]
    true: float
    dropped: int


cross = jax.jit(james_stein.cross_regression, static_argnames=("window", "stride"))
worth = jax.jit(james_stein.worth_regressing, static_argnames=("window", "stride"))
means = jax.jit(nonlocal_means.denoise)


def weak_base(frame: Frame) -> Biased:
    """Non-local means of the frame, and of each half by itself."""
    full, *halves = (
        means(part.color, part.color, part.variance)
        for part in (frame, *frame.halves())
    )
    return Biased(full, jnp.stack(halves))


def errors_of(frame: Frame, base: Biased, settings: list, repeats: int) -> Errors:
    """Regress one base image of a frame with every setting."""
    assert frame.reference is not None
    assert base.halves is not None
    a, b = frame.halves()
    needed = select([stack(a), stack(b)])
    others = needed.of(stack(a)), needed.of(stack(b))
    inputs = (a.color, b.color, *base.halves, *others)
    r, noise = frame.reference
    error = lambda i, epsilon: float(
        rel_l2(i, r, half_difference=noise, epsilon=epsilon)
    )
    seconds = medians(
        {
            setting: functools.partial(
                cross, *inputs, stride=setting[0], window=setting[1]
            )
            for setting in settings
        },
        repeats,
    )
    images = {(s, w): sum(cross(*inputs, stride=s, window=w)) / 2 for s, w in settings}
    change = worth(jax.random.key(0), *inputs, a.variance, b.variance)
    first = images[settings[0]]
    return Errors(
        error(base.full, 0.01),
        {setting: error(image, 0.01) for setting, image in images.items()},
        seconds,
        (float(change.mean), float(change.standard_error)),
        error(first, 1.0) - error(base.full, 1.0),
        stack(a).shape[-1] - len(needed.channels),
    )


def run(
    config: Config,
) -> tuple[dict[str, float], dict[tuple[str, int, str], Errors], dict]:
    """Measure everything.

    Args:
        config: what to measure.

    Returns:
        seconds of the whole and its parts; errors by frame, sample count and base; and
        relative L2 of path tracing and NFOR by frame and sample count.

    Raises:
        ValueError: if the folder holds no archive.
    """
    paths = sorted(config.folder.glob("*.npz"))
    if not paths:
        raise ValueError(f"{config.folder}: no .npz archive there")
    size, repeats = (64, 1) if config.quick else (config.size, config.repeats)
    seconds = medians(parts(size), repeats)
    settings = SETTINGS[:2] if config.quick else SETTINGS
    cases = [(p, s) for p in paths for s in frames.sample_counts(p)]
    found, others = {}, {}
    for path, samples in tqdm(cases[:1] if config.quick else cases, unit="frame"):
        frame = frames.load(path, samples)
        frame = frame.scaled(1 / frame.exposure)
        assert frame.reference is not None
        for name, base in (
            ("oidn", frame.biased["oidn"]),
            ("non-local means", weak_base(frame)),
        ):
            found[path.stem, samples, name] = errors_of(frame, base, settings, 1)
        r, noise = frame.reference
        images = frame.color, nfor.denoise_frame(frame).full
        others[path.stem, samples] = [
            float(rel_l2(i, r, half_difference=noise)) for i in images
        ]
    return seconds, found, others


def draw(found: dict[tuple[str, int, str], Errors], path: pathlib.Path) -> None:
    """Time of y* against its error, relative to stride 1 and window 51."""
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    cases = [e for (*_, base), e in found.items() if base == "oidn"]
    for setting in cases[0].regressed:
        x, y = (
            np.exp(np.mean([np.log(of[setting] / of[SETTINGS[0]]) for of in all_]))
            for all_ in ([e.seconds for e in cases], [e.regressed for e in cases])
        )
        axes.plot(x, y, "o")
        axes.annotate(f" stride {setting[0]}, {setting[1]}x{setting[1]}", (x, y))
    axes.set(xscale="log", xlabel="time / that of stride 1, 51x51")
    axes.set(ylabel="relative L2 / that of stride 1, 51x51")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Print the tables."""
    config = tyro.cli(Config, description=__doc__)
    seconds, found, others = run(config)
    size = 64 if config.quick else config.size
    print(f"\n{size}x{size}, {FEATURES} features, window {WINDOW}")
    for name, each in seconds.items():
        print(f"{name:<28}{each:>9.3f} s{1e6 * each / size**2:>9.2f} s a megapixel")
    total = sum(seconds[name] for name in PARTS)
    rate = useful_operations(size) / seconds["stride 1"] / 1e9
    grid = regression._grid(WINDOW, 1)
    n, m, p = grid.width(grid.reach) ** 2, grid.side**2, FEATURES + 1
    executed = 2.0 * (p * (p + 1) // 2 + p * CHANNELS) * n * m
    executed *= grid.tiles(size) ** 2 // grid.batch * grid.batch
    ceiling = executed / seconds["moments, matrix product"] / 1e9
    print(f"whole / sum of parts {seconds['stride 1'] / total:.2f}")
    print(f"useful {rate:.1f} GFLOP/s of the product's {ceiling:.1f}", end="")
    print(f" = {rate / ceiling:.2f}")
    print(f"stride 2 {seconds['stride 1'] / seconds['stride 2']:.2f} x as fast")
    settings = list(next(iter(found.values())).regressed)
    columns = "".join(f"{f'y* {s}, {w}':>11}" for s, w in settings)
    print(f"\n{'frame':<13}{'spp':>5} {'base':<16}{'y':>9}{columns}  estimate; truth")
    for (frame, samples, base), e in found.items():
        row = "".join(f"{e.regressed[s]:>11.5f}" for s in settings)
        mean, error = e.change
        chosen = "regress" if mean + error < 0 else "keep"
        print(f"{frame:<13}{samples:>5} {base:<16}{e.base:>9.5f}{row}", end="")
        print(f"  {mean:+.5f}+-{error:.5f} {chosen:<8}{e.true:+.5f}")
    print(f"\n{'frame':<13}{'spp':>5}{'path tracing':>14}{'NFOR':>10}{'oidn':>10}")
    for (frame, samples), (x, y) in others.items():
        oidn = found[frame, samples, "oidn"].base
        print(f"{frame:<13}{samples:>5}{x:>14.5f}{y:>10.5f}{oidn:>10.5f}")
    if config.plot is not None:
        draw(found, config.plot)


if __name__ == "__main__":
    main()
