"""Where does James-Stein lower a denoiser's error, and what does it cost?

Every archive in the folder (`archives`), at every sample count: relative L2 of path
tracing, of Open Image Denoise, and of each combiner; `auto` combines only where the
half buffers show that it helps. Beside it the time of each function as a multiple of
two bare separable 15x15 window sums of the same image, which no such combiner can do
without, with the pooling of the variance included as the command runs it.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import tyro

from experiments.common import archives, errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from jscomb import james_stein, methods, metrics
from jscomb.frame import Frame
from jscomb.numerics.windows import window_sum
from jscomb.typing import Image
from tests.battery.rendering import of_images

INPUTS = "path tracing", "oidn"
COMBINERS = "james-stein", "whitened"
CEILING = "two window sums"


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        size: width and height in pixels of the images that are timed.
        repeats: timed calls of each function; they take turns.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    size: int = 1024
    repeats: int = 31


@jax.jit
def _dual(frame: Frame) -> Image:
    """The dual variant: each half's x with the other half's y."""
    a, b = frame.halves()
    variance = james_stein.smooth_variance(frame.variance)
    ya, yb = a.estimates["oidn"].image, b.estimates["oidn"].image
    return james_stein.combine_dual(a.color, b.color, ya, yb, variance)


def images_of(frame: Frame) -> dict[str, Image]:
    """Inputs and combinations by name."""
    key, y = jax.random.key(0), frame.estimates["oidn"].image
    made = {
        name: methods.combine(key, frame, method=name, biased="oidn")
        for name in COMBINERS
    }
    combined = {name: each.image for name, each in made.items()}
    halves = made["whitened"].halves, frame.estimates["oidn"].halves
    x = jnp.stack([half.color for half in frame.halves()])
    change = metrics.rel_l2_change(*halves, x, limit=2.0)
    chosen = combined["whitened"] if change.helps else y
    inputs = {"path tracing": frame.color, "oidn": y}
    return inputs | combined | {"auto": chosen, "dual": _dual(frame)}


def measure(frame: Frame) -> dict[str, float]:
    """Errors of a normalised frame by method."""
    return {n: errors.relative_l2(i, frame) for n, i in images_of(frame).items()}


def seconds_of(size: int, repeats: int) -> dict[str, float]:
    """Median seconds of each function of images of that size."""
    x, y, v = jax.random.uniform(jax.random.key(0), (3, size, size, 3))
    gradient = jax.grad(lambda *i: james_stein.combine(*i).sum(), argnums=(0, 1, 2))
    functions: dict[str, Callable] = {
        CEILING: lambda x, y, v: (window_sum(x, 15), window_sum(y, 15)),
        "combine": james_stein.combine,
        "combine, whitened": functools.partial(james_stein.combine, whiten=True),
        "all gradients of combine": gradient,
        **{f"the command's {name}": of_images(name) for name in COMBINERS},
    }
    calls = {n: functools.partial(jax.jit(f), x, y, v) for n, f in functions.items()}
    return medians(calls, repeats)


@dataclasses.dataclass(frozen=True)
class Found:
    """Errors by "frame samples" and method, and seconds by function."""

    rows: dict[str, dict[str, float]]
    seconds: dict[str, float]


def run(config: Config) -> Found:
    """Measure every frame, and time every function.

    Args:
        config: what to measure.

    Returns:
        errors and seconds.

    Raises:
        ValueError: if the folder holds no archive.
    """
    size, repeats = (128, 3) if config.quick else (config.size, config.repeats)
    rows = archives.measured(config.folder, {"": measure}, quick=config.quick)
    return Found(rows, seconds_of(size, repeats))


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        geometric means, every frame, and times.
    """
    rows, ceiling = found.rows, found.seconds[CEILING]
    names = list(next(iter(rows.values())))
    better = lambda row: min(row[name] for name in INPUTS)
    times = {n: s / ceiling for n, s in found.seconds.items()}
    ratios = [row["whitened"] / better(row) for row in rows.values()]
    tables = [
        errors.means(rows, names, better, title="error / better input"),
        table(["frame", *names], [[f, *row.values()] for f, row in rows.items()]),
        table(["function", "time / two window sums"], times.items()),
    ]
    answer = (
        f"`whitened` has {errors.geometric_mean(ratios):.2f} of the better input's "
        f"relative L2 (geometric mean of {len(rows)} frames; worst {max(ratios):.2f}), "
        f"and takes {times['combine, whitened']:.1f} times as long as two bare window "
        "sums."
    )
    return Report(answer, "\n\n".join(tables))


if __name__ == "__main__":
    main(Config, run, report)
