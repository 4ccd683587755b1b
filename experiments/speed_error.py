"""What does windowed regression cost, and what does it do to the error?

    python -m experiments.speed_error FOLDER

Two tables and a plot:

    parts    seconds of one regression of random images, beside those of its parts timed
             alone in the same run: weights, products of features, and both matrix
             products, which are the ceiling.
    error    of y*, made by cross-regression from Open Image Denoise, and its time, for
             strides, windows, tile sizes and precisions; on the archives in the folder
             (see `frames`), relative L2 less the reference's noise.
"""

import dataclasses
import functools
import itertools
import pathlib
from collections.abc import Callable
from typing import NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib import pyplot as plt
from tqdm import tqdm

from experiments import frames
from experiments.regression_error import inputs_of
from experiments.timing import medians
from jscomb import james_stein
from jscomb.frame import Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import regression
from jscomb.numerics.weights import gaussian_weights, tile_weights
from jscomb.typing import Image

WINDOW, FEATURES, CHANNELS = 51, 11, 3


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


def parts(size: int) -> dict[str, Callable]:
    """The regression, and its parts for as many tiles, on random images."""
    keys = iter(jax.random.split(jax.random.key(0), 7))
    shape = lambda channels: (size, size, channels)
    t, g, f = (
        jax.random.uniform(next(keys), shape(c)) for c in (CHANNELS, 3, FEATURES)
    )
    grid = regression._grid(WINDOW, 1)
    tiles, batch = grid.tiles(size) ** 2, grid.batch
    n, m = grid.width(grid.reach) ** 2, grid.side**2
    basis = jax.random.normal(next(keys), (batch, FEATURES + 1, n))
    target, weights = basis[:, :CHANNELS], jax.random.uniform(next(keys), (batch, m, n))
    guide = jax.random.uniform(next(keys), (batch, 3, n))
    inside = grid.inside
    phi = jax.vmap(regression._products)(basis, target)
    b = jax.random.normal(next(keys), (batch, (FEATURES + 1) * CHANNELS + 1, m))

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
        weights_of = gaussian_weights(jnp.zeros((1, 1, 3)), 0.1)
        one = lambda g: tile_weights(weights_of, g.reshape(3, side, side), grid)
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


def product_operations(size: int) -> float:
    """What the moments' matrix product executes, tiles and neighbourhoods in full.

    Args:
        size: width and height of the image in pixels.

    Returns:
        floating-point operations.
    """
    grid = regression._grid(WINDOW, 1)
    n, m, p = grid.width(grid.reach) ** 2, grid.side**2, FEATURES + 1
    turns = grid.tiles(size) ** 2 // grid.batch
    return 2.0 * (p * (p + 1) // 2 + p * CHANNELS) * n * m * turns * grid.batch


def useful_operations(size: int) -> float:
    """2 (moments + predictions) for each pixel of each clipped window.

    Args:
        size: width and height of the image in pixels.

    Returns:
        floating-point operations.
    """
    p = FEATURES + 1
    columns = p * (p + 1) // 2 + p * CHANNELS + p * CHANNELS + 1
    at = np.arange(size)
    r = WINDOW // 2
    along = np.minimum(at + r, size - 1) - np.maximum(at - r, 0) + 1
    return 2.0 * columns * float(along.sum()) ** 2


class Setting(NamedTuple):
    """How to regress.

    Attributes:
        stride: pixels between the centres of windows.
        window: width of the windows in pixels.
        side: centres along one side of a tile.
        bits: of the floating-point numbers.
    """

    stride: int = 1
    window: int = 51
    side: int = 16
    bits: int = 32

    def __str__(self) -> str:
        """What differs from the first."""
        names = {"stride": "stride", "window": "window", "side": "tile of"}
        said = [
            f"{names[name]} {value}"
            for name, value in self._asdict().items()
            if name in names and value != getattr(FIRST, name)
        ]
        return ", ".join(said + ["float64"] * (self.bits == 64)) or "stride 1, 51x51"


FIRST = Setting()
SETTINGS = [
    FIRST,
    *(Setting(stride=s) for s in (2, 4, 8)),
    *(Setting(window=w) for w in (31, 21)),
    Setting(stride=2, window=21),
    *(Setting(side=s) for s in (8, 12, 20)),
    Setting(bits=64),
]


@functools.cache
def compiled(setting: Setting) -> Callable:
    """Cross-regression with this setting; traced where its tile size is in force.

    Args:
        setting: how.

    Returns:
        the jitted function.
    """
    options = {"stride": setting.stride, "window": setting.window}
    return jax.jit(functools.partial(james_stein.cross_regression, **options))


def regressed(frame: Frame, setting: Setting, repeats: int) -> tuple[Image, float]:
    """Regress the frame's denoised image.

    Args:
        frame: normalised, with `oidn`.
        setting: how.
        repeats: timed calls.

    Returns:
        y*, and the median seconds of one call.
    """
    inputs = inputs_of(frame, frame.estimates["oidn"])
    with (
        jax.enable_x64(setting.bits == 64),
        mock.patch.object(regression, "_SIDE", setting.side),
    ):
        dtype = jnp.float64 if setting.bits == 64 else jnp.float32
        arrays = [jnp.asarray(np.asarray(i), dtype) for i in inputs]
        run = compiled(setting)
        call = lambda: run(*arrays)
        seconds = medians({"y*": call}, repeats)["y*"]
        return jnp.asarray(np.asarray(sum(call()) / 2), jnp.float32), seconds


Results = dict[Setting, tuple[list[float], list[float]]]


def run(config: Config) -> tuple[dict[str, float], Results]:
    """Measure everything.

    Args:
        config: what to measure.

    Returns:
        seconds of the whole and its parts; and of each setting the relative L2 and the
        seconds, both frame by frame.

    Raises:
        ValueError: if the folder holds no archive.
    """
    cases = frames.cases(config.folder, quick=config.quick)
    size, repeats = (64, 1) if config.quick else (config.size, config.repeats)
    seconds = medians(parts(size), repeats)
    settings = SETTINGS[:2] if config.quick else SETTINGS
    found: Results = {setting: ([], []) for setting in settings}
    for path, samples in tqdm(cases, unit="frame"):
        frame = frames.load(path, samples).normalised()
        assert frame.reference is not None
        r, noise = frame.reference
        for setting in settings:
            image, time_of_one = regressed(frame, setting, 1)
            found[setting][0].append(float(rel_l2(image, r, half_difference=noise)))
            found[setting][1].append(time_of_one)
    return seconds, found


def ratios(found: Results) -> dict[str, tuple[float, float, float]]:
    """Of each setting to the first: error, its worst, and time.

    Args:
        found: errors and seconds of each setting, frame by frame.

    Returns:
        geometric mean and greatest ratio of the errors, geometric mean of the times.
    """
    result = {}
    for setting, measured in found.items():
        error, time_of_one = (
            np.log(each) - np.log(first)
            for each, first in zip(measured, found[FIRST], strict=True)
        )
        means = np.exp(error.mean()), np.exp(error.max()), np.exp(time_of_one.mean())
        result[str(setting)] = tuple(map(float, means))
    return result


def draw(found: Results, path: pathlib.Path) -> None:
    """Time of y* against its error, both relative to the first setting.

    Args:
        found: errors and seconds of each setting, frame by frame.
        path: of the picture.

    Returns:
        nothing.
    """
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    markers = itertools.cycle("osD")  # names at the points would hide each other
    for name, (error, _, time_of_one) in ratios(found).items():
        axes.plot(time_of_one, error, next(markers), label=name)
    figure.legend(loc="outside right upper")
    axes.set_xscale("log")
    ticks = [0.1, 0.2, 0.5, 1, 2]
    axes.set_xticks(ticks, labels=map(str, ticks))
    axes.minorticks_off()
    axes.set(xlabel="time of y* / that of stride 1, 51x51")
    axes.set(ylabel="relative L2 of y* / that of stride 1, 51x51")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Print the tables."""
    config = tyro.cli(Config, description=__doc__)
    seconds, found = run(config)
    size = 64 if config.quick else config.size
    print(f"\n{size}x{size}, {FEATURES} features, window {WINDOW}")
    for name, each in seconds.items():
        print(f"{name:<28}{each:>9.3f} s{1e6 * each / size**2:>9.2f} s a megapixel")
    whole, total = seconds["stride 1"], sum(seconds[name] for name in PARTS)
    rate = useful_operations(size) / whole / 1e9
    ceiling = product_operations(size) / seconds["moments, matrix product"] / 1e9
    print(f"whole / sum of parts {whole / total:.2f}")
    print(f"useful {rate:.1f} GFLOP/s of the product's {ceiling:.1f}", end="")
    print(f" = {rate / ceiling:.2f}")
    print(f"stride 2 is {whole / seconds['stride 2']:.2f} x as fast")
    print(f"\n{'y* relative to the first':<28}{'error':>8}{'worst':>8}{'time':>8}")
    for name, (error, worst, time_of_one) in ratios(found).items():
        print(f"{name:<28}{error:>8.3f}{worst:>8.3f}{time_of_one:>8.3f}")
    if config.plot is not None:
        draw(found, config.plot)


if __name__ == "__main__":
    main()
