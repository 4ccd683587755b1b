"""Does SURE know a denoised image's error, and what is that knowledge good for?

Three tables:

    digits   divergence of the joint bilateral filter on a real frame in float32, by one
             forward derivative and by differences of many steps, against the derivative
             in float64: relative L1.
    probes   what 1, 2, 4 and 8 probes cost and bring: time divided by that of denoising
             alone, and the standard error over probes of the mean SURE of 31x31
             windows, relative to it; by the derivative, and by differences of 1e-4.
    frames   every archive in the folder (`archives`): relative L2, less the
             reference's noise, of Open Image Denoise, as it is and as SURE estimates it
             (the reference gives the weights only), of progressive mixing, and of
             James-Stein without and with the divergence. Whitened: with the robust
             variance, and SURE by it.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.common import archives, errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from jscomb import james_stein, progressive
from jscomb.denoisers import bilateral, oidn
from jscomb.features import stack
from jscomb.frame import Frame
from jscomb.numerics import sure
from jscomb.typing import Image

STEPS = [10.0**k for k in range(-6, 1)]
PROBES = 1, 2, 4, 8
WINDOW, KEYS = 31, 8
PAPERS_STEP = 1e-4
WHITENED = {"whiten": True, "window": 7}


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that the frames' results are kept in; None to keep none.
        frame: which archive the first two tables are about.
        samples: its samples a pixel.
        repeats: timed calls of each function.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    frame: str = "cbox-glass"
    samples: int = 64
    repeats: int = 3


def _oidn(frame: Frame) -> Callable[[Image], Image]:
    """Open Image Denoise with the frame's features."""
    return functools.partial(oidn.denoise_color, frame=frame)


def bilateral_of(frame: Frame) -> Callable[[Image], Image]:
    """The joint bilateral filter with the frame's features and variance."""
    features = stack(frame)
    return lambda x: bilateral.denoise(
        x, frame.variance.astype(x.dtype), features.astype(x.dtype)
    )


def by_difference(
    key: jax.Array, denoise: Callable, x: Image, v: Image, *, step: float, probes: int
) -> Image:
    """SURE of each element by forward differences, as the papers have it."""
    y, total = denoise(x), jnp.zeros_like(x)
    for one in jax.random.split(key, probes):
        b = jnp.sqrt(v) * jax.random.rademacher(one, x.shape, x.dtype)
        total = total + b * (denoise(x + step * b) - y) / step
    return jnp.square(y - x) + 2 * total / probes - v


def digits(frame: Frame) -> dict[str, float]:
    """Relative error of the divergence in float32."""
    key, x, v = jax.random.key(0), frame.color, frame.variance
    b = jnp.sqrt(v) * jax.random.rademacher(key, x.shape, x.dtype)
    with jax.enable_x64(True):
        wide = (
            jnp.asarray(np.asarray(x), jnp.float64),
            jnp.asarray(np.asarray(b), jnp.float64),
        )
        derivative = jax.jit(lambda x, b: jax.jvp(bilateral_of(frame), (x,), (b,))[1])
        truth = np.asarray(derivative(*wide) * wide[1])
    denoise = jax.jit(bilateral_of(frame))
    found = {"jvp": b * jax.jit(derivative)(x, b)}
    for step in STEPS:
        found[f"{step:.0e}"] = b * (denoise(x + step * b) - denoise(x)) / step
    return {
        name: float(abs(np.asarray(each) - truth).sum() / abs(truth).sum())
        for name, each in found.items()
    }


def probes(frame: Frame, counts: tuple[int, ...], repeats: int) -> list[dict]:
    """Time and standard error of SURE for both denoisers, by both ways."""
    x, v = frame.color, frame.variance
    rows = []
    for name, denoise in (("bilateral", bilateral_of(frame)), ("oidn", _oidn(frame))):
        ways = {
            "jvp": lambda key, x, d=denoise, n=1: (
                sure.monte_carlo_sure(key, d, x, v, probes=n).squared_error
            ),
            "difference": lambda key, x, d=denoise, n=1: by_difference(
                key, d, x, v, step=PAPERS_STEP, probes=n
            ),
        }
        calls = {
            (way, count): jax.jit(functools.partial(estimate, n=count))
            for count in counts
            for way, estimate in ways.items()
        }
        # All take turns with denoising alone, since a shared machine's pace changes; x
        # is an argument, or the compiler would denoise it beforehand.
        timed = {
            key: lambda c=call: c(jax.random.key(0), x) for key, call in calls.items()
        }
        seconds = medians({"": functools.partial(jax.jit(denoise), x)} | timed, repeats)
        for (way, count), call in calls.items():
            zero = jnp.zeros_like(v)
            means = [
                sure.pooled(sure.Risk(x, call(k, x), zero), x, v, window=WINDOW)
                for k in jax.random.split(jax.random.key(1), KEYS)
            ]
            each = np.stack([m.squared_error for m in means])
            spread = each.std(axis=0, ddof=1).mean() / abs(each.mean(axis=0)).mean()
            rows.append(
                {
                    "denoiser": name,
                    "by": way,
                    "probes": count,
                    "time / denoising": seconds[way, count] / seconds[""],
                    "standard error": float(spread),
                }
            )
    return rows


def measure(frame: Frame) -> dict[str, float]:
    """Errors of one frame, estimated and true."""
    assert frame.reference is not None
    r, _ = frame.reference
    x, v = frame.color, frame.variance
    error = lambda image: errors.relative_l2(image, frame)
    denoise = jax.jit(_oidn(frame))
    estimate = lambda v: sure.monte_carlo_sure(
        jax.random.key(0), denoise, x, v, slope_limit=1.0
    )
    risk = estimate(v)
    y, s = risk.denoised, risk.squared_error
    weight = 1 / (jnp.square(jnp.mean(r, axis=-1, keepdims=True)) + 0.01)
    row = {"path tracing": error(x), "oidn": error(y)}
    row["oidn, estimated"] = float(jnp.mean(weight * s))
    smooth, robust = james_stein.smooth_variance(v), james_stein.robust_variance(v)
    of_robust = estimate(robust)

    def add(name: str, alpha: Image) -> None:
        bound = progressive.bound_mixing(alpha, x, y, v)
        row[name] = error(x + alpha * (y - x))
        row[f"{name}, bounded"] = error(x + bound * (y - x))

    add("oidn itself", jnp.ones_like(x))
    add("progressive", progressive.mixing(x, y, v, s))
    for window in (7, 15):
        alpha = progressive.mixing(
            x, y, robust, of_robust.squared_error, window=window, whiten=True
        )
        add(f"progressive, whitened {window}x{window}", alpha)
    for name, variance, divergence, options in (
        ("james-stein", smooth, estimate(smooth).divergence, {}),
        ("james-stein, whitened 7x7", robust, of_robust.divergence, WHITENED),
    ):
        run = functools.partial(james_stein.combine, x, y, variance, **options)
        row[name] = error(run())
        row[f"{name}, corrected"] = error(run(divergence=divergence))
    return row


def run(config: Config) -> dict:
    """Measure everything.

    Args:
        config: what to measure.

    Returns:
        `digits`: relative error by way; `probes`: a row for each denoiser, way and
        number; `frames`: errors by "frame samples".

    Raises:
        ValueError: if the folder holds no archive.
    """
    path, samples = config.folder / f"{config.frame}.npz", config.samples
    if config.quick:
        path, samples = archives.cases(config.folder, quick=True)[0]
    frame = archives.load(path, samples)  # before the long part, in case it is missing
    frame = frame.normalised()
    found = archives.measured(
        config.folder, {"": measure}, results=config.results, quick=config.quick
    )
    counts, repeats = (PROBES[:1], 1) if config.quick else (PROBES, config.repeats)
    return {
        "digits": digits(frame),
        "probes": probes(frame, counts, repeats),
        "frames": found,
    }


def report(found: dict) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        the tables named above, and means over the frames.
    """
    rows, ways = found["frames"], found["probes"]
    names = list(next(iter(rows.values())))
    known = [abs(r["oidn, estimated"] / r["oidn"] - 1) < 0.25 for r in rows.values()]
    corrected = "james-stein, whitened 7x7, corrected"
    gains = [row[corrected] / row["oidn"] for row in rows.values()]
    jvp = next(r for r in ways if r["denoiser"] == "oidn" and r["by"] == "jvp")
    compared = names[3:]  # the estimate may be negative
    body = [
        errors.means(rows, compared, lambda row: row["oidn"], title="error / oidn"),
        table(["frame", *names], [[name, *row.values()] for name, row in rows.items()]),
        table(list(ways[0]), [list(row.values()) for row in ways]),
        table(["derivative by", "relative error"], found["digits"].items()),
    ]
    answer = (
        f"SURE's mean over a frame is within 25 % of Open Image Denoise's error in "
        f"{sum(known)} of {len(known)} frames, for {jvp['time / denoising']:.1f} times "
        f"the time of denoising. With its divergence the whitened James-Stein rule has "
        f"{errors.geometric_mean(gains):.2f} of the denoiser's error (geometric mean; "
        f"worst {max(gains):.2f})."
    )
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
