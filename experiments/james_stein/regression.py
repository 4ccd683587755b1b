"""Where does cross-regression lower the error, do the halves know, what does it cost?

Every archive in the folder (`archives`), at every sample count and with two biased
images y: Open Image Denoise, and non-local means, a weak one. Relative L2 of y and y*;
what `worth_regressing` says of the change, and the reference; and NFOR. Then settings
of the regression (`settings`), error beside time; and the seconds of one regression of
random images beside those of its parts timed alone in the same run: weights, products
of features, and both matrix products, which are the ceiling.
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
from matplotlib.figure import Figure

from experiments.common import archives
from experiments.common.command import Options, main
from experiments.common.errors import geometric_mean, relative_l2
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.james_stein import parts
from jscomb import james_stein
from jscomb.denoisers import nfor, nonlocal_means
from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import regression
from jscomb.typing import Image

BASES = "oidn", "non-local means"
Row = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that the frames' results are kept in; None to keep none.
        stride: pixels between the centres of windows.
        window: width of the windows in pixels.
        frames: how many frames the settings are tried on, the cheapest first.
        size: width and height of the random images that are timed, in pixels.
        repeats: timed calls of each function; they take turns.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    stride: int = 1
    window: int = 51
    frames: int = 5
    size: int = 512
    repeats: int = 3


cross = jax.jit(james_stein.cross_regression, static_argnames=("window", "stride"))
worth = jax.jit(james_stein.worth_regressing, static_argnames=("window", "stride"))


def inputs_of(frame: Frame, base: Estimate) -> tuple[Image, ...]:
    """What `cross_regression` takes: both halves' images, and features that tell.

    Args:
        frame: normalised, with halves.
        base: a biased image of it with halves.

    Returns:
        x_a, x_b, y_a, y_b, f_a and f_b.

    Raises:
        ValueError: if the frame or the image has no halves.
    """
    if base.halves is None:
        raise ValueError("the biased image has no halves")
    a, b = frame.halves()
    needed = select([stack(a), stack(b)])
    others = (needed.of(stack(half)) for half in (a, b))
    return (a.color, b.color, *base.halves, *others)


def base_of(frame: Frame, name: str) -> Estimate:
    """A biased image of the frame and of its halves, by name."""
    if name != "non-local means":
        return frame.estimates[name]
    return nonlocal_means.denoise_frame(frame)


def measure(frame: Frame, name: str, config: Config) -> Row:
    """Errors of one biased image, and of what regression makes of it."""
    assert frame.reference is not None
    reference, noise = frame.reference
    # In the weighting of the estimate, where black pixels do not decide.
    gentle = lambda image: float(
        rel_l2(image, reference, half_difference=noise, epsilon=1.0)
    )
    base = base_of(frame, name)
    inputs = inputs_of(frame, base)
    options = {"window": config.window, "stride": config.stride}
    star = sum(cross(*inputs, **options)) / 2
    noise_of = james_stein.guide_noise(*inputs[2:4], robust=False)
    paper = sum(cross(*inputs, kappa=noise_of, **options)) / 2
    variances = (half.variance for half in frame.halves())
    change = worth(jax.random.key(0), *inputs, *variances, window=config.window)
    return {
        "path tracing": relative_l2(frame.color, frame),
        "y": relative_l2(base.image, frame),
        "y*": relative_l2(star, frame),
        "y*, the paper's kappa": relative_l2(paper, frame),
        "change": gentle(star) - gentle(base.image),
        "estimate": float(change.mean),
        "standard error": float(change.standard_error),
        "features": inputs[4].shape[-1],
    }


def measure_nfor(frame: Frame) -> Row:
    """Relative L2 of NFOR."""
    return {"y": relative_l2(nfor.denoise_frame(frame).image, frame)}


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


Settings = dict[Setting, tuple[list[float], list[float]]]


@dataclasses.dataclass(frozen=True)
class Found:
    """What was measured.

    Attributes:
        rows: of each frame and base, by "frame samples base".
        settings: relative L2 and seconds, frame by frame, of each setting.
        seconds: of a regression of random images and of its parts.
        size: of these images.
    """

    rows: dict[str, Row]
    settings: Settings
    seconds: dict[str, float]
    size: int


def run(config: Config) -> Found:
    """Measure every frame with every base, the settings, and the parts.

    Args:
        config: what to measure.

    Returns:
        errors and seconds.

    Raises:
        ValueError: if the folder holds no archive.
    """
    size, repeats = (64, 1) if config.quick else (config.size, config.repeats)
    measures: dict[str, Callable[[Frame], Row]] = {
        base: functools.partial(measure, name=base, config=config) for base in BASES
    }
    rows = archives.measured(
        config.folder,
        measures | {"NFOR": measure_nfor},
        results=config.results,
        quick=config.quick,
    )
    settings = SETTINGS[:2] if config.quick else SETTINGS
    found: Settings = {setting: ([], []) for setting in settings}
    cases = archives.cases(config.folder, quick=config.quick)
    for path, samples in sorted(cases, key=lambda case: case[1])[: config.frames]:
        frame = archives.load(path, samples).normalised()
        for setting in settings:
            image, seconds = regressed(frame, setting, 1)
            found[setting][0].append(relative_l2(image, frame))
            found[setting][1].append(seconds)
    return Found(rows, found, medians(parts.parts(size), repeats), size)


def ratios(found: Settings) -> dict[str, tuple[float, float, float]]:
    """Of each setting to the first: mean and worst error, and mean time."""
    result = {}
    for setting, measured in found.items():
        error, seconds = (
            [value / of_first for value, of_first in zip(each, first, strict=True)]
            for each, first in zip(measured, found[FIRST], strict=True)
        )
        means = geometric_mean(error), max(error), geometric_mean(seconds)
        result[str(setting)] = means
    return result


def draw(of_settings: dict[str, tuple[float, float, float]]) -> Figure:
    """Time of y* against its error, both relative to the first setting."""
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    markers = itertools.cycle("osD")  # names at the points would hide each other
    for name, (error, _, seconds) in of_settings.items():
        axes.plot(seconds, error, next(markers), label=name)
    figure.legend(loc="outside right upper")
    axes.set_xscale("log")
    ticks = [0.1, 0.2, 0.5, 1, 2]
    axes.set_xticks(ticks, labels=map(str, ticks))
    axes.minorticks_off()
    axes.set(xlabel="time of y* / that of stride 1, 51x51")
    axes.set(ylabel="relative L2 of y* / that of stride 1, 51x51")
    return figure


def choices(rows: list[Row]) -> dict[str, int]:
    """How often the estimate chose to regress, was right, and chose to its harm."""
    chosen = [row["estimate"] + row["standard error"] < 0 for row in rows]
    counts = {"regressed": sum(chosen)}
    for name, helped in {
        "estimate's weighting": [row["change"] < 0 for row in rows],
        "relative L2": [row["y*"] < row["y"] for row in rows],
    }.items():
        pairs = list(zip(helped, chosen, strict=True))
        counts[f"right, {name}"] = sum(a == b for a, b in pairs)
        counts[f"to its harm, {name}"] = sum(b and not a for a, b in pairs)
    return counts


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        every frame, the choices by halves, settings, and the parts of the time.
    """
    of = {b: [r for n, r in found.rows.items() if n.endswith(b)] for b in BASES}
    columns = ("path tracing", "y", "y*", "y*, the paper's kappa", "change")
    columns += ("estimate", "standard error")
    frames = [[n, *(row.get(c) for c in columns)] for n, row in found.rows.items()]
    judged = {base: choices(rows) for base, rows in of.items()}
    gains = {b: [r["y*"] / r["y"] for r in rows] for b, rows in of.items()}
    means = [
        [b, len(g), geometric_mean(g), max(g), *judged[b].values()]
        for b, g in gains.items()
    ]
    of_settings = ratios(found.settings)
    whole, megapixels = found.seconds["stride 1"], found.size**2 / 1e6
    total = sum(found.seconds[name] for name in parts.PARTS)
    rate = parts.useful_operations(found.size) / whole / 1e9
    product = parts.product_operations(found.size) / found.seconds[parts.PARTS[2]] / 1e9
    first, gain = judged[BASES[0]], gains[BASES[0]]
    cost = (
        f"{found.size}x{found.size}, {parts.FEATURES} features, windows of "
        f"{parts.WINDOW}x{parts.WINDOW}: {whole / total:.2f} times the sum of parts; "
        f"{rate:.0f} GFLOP/s of useful work, {rate / product:.2f} of the matrix "
        "product's rate."
    )
    seconds = [[name, each / megapixels] for name, each in found.seconds.items()]
    compared = [[name, *each] for name, each in of_settings.items()]
    body = [
        table(["y", "frames", "y* / y", "worst", *first], means),
        table(["frame", *columns], frames),
        table(["setting", "error / first", "worst", "time / first"], compared),
        cost,
        table(["part", "s a megapixel"], seconds),
    ]
    answer = (
        f"With Open Image Denoise for y, y* has less error in "
        f"{sum(g < 1 for g in gain)} of {len(gain)} frames (geometric mean "
        f"{geometric_mean(gain):.2f} of its error, at worst {max(gain):.3g} times); "
        f"the halves choose right in {first['right, relative L2']}, to their harm in "
        f"{first['to its harm, relative L2']}. Regression takes "
        f"{whole / megapixels:.1f} s a megapixel; a stride of 2 takes "
        f"{found.seconds['stride 2'] / whole:.2f} of that, for "
        f"{of_settings['stride 2'][0]:.3f} times the error."
    )
    plot = {"Time against error": draw(of_settings)}
    return Report(answer, "\n\n".join(body), plot)


if __name__ == "__main__":
    main(Config, run, report)
