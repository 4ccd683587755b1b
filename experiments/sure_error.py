"""Does SURE know a denoised image's error, and what is that knowledge good for?

    python -m experiments.sure_error FOLDER --results FILE.json

Three tables:

    digits   divergence of the joint bilateral filter on a real frame in float32, by one
             forward derivative and by differences of many steps, against the derivative
             in float64: relative L1.
    probes   what 1, 2, 4 and 8 probes cost and bring: time divided by that of denoising
             alone, and the standard error over probes of the mean SURE of 31x31
             windows, relative to it; by the derivative, and by differences of 1e-4.
    frames   every archive in the folder (see `frames`): relative L2, less the
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

from experiments import frames
from experiments.timing import medians
from jscomb import james_stein, progressive
from jscomb.denoisers import bilateral, oidn
from jscomb.features import stack
from jscomb.frame import Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import sure
from jscomb.typing import Image

STEPS = [10.0**k for k in range(-6, 1)]
PROBES = 1, 2, 4, 8
WINDOW, KEYS = 31, 8
PAPERS_STEP = 1e-4
WHITENED = {"whiten": True, "window": 7}


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that the frames' results are kept in; None to keep none.
        frame: which archive the first two tables are about.
        samples: its samples a pixel.
        repeats: timed calls of each function.
        quick: only the first archive, at its least sample count, and few probes.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    frame: str = "cbox-glass"
    samples: int = 64
    repeats: int = 3
    quick: bool = False


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
        plain = medians({"": functools.partial(jax.jit(denoise), x)}, repeats)[""]
        for count in counts:
            ways = {
                "jvp": lambda key, d=denoise, n=count: (
                    sure.monte_carlo_sure(key, d, x, v, probes=n).squared_error
                ),
                "difference": lambda key, d=denoise, n=count: by_difference(
                    key, d, x, v, step=PAPERS_STEP, probes=n
                ),
            }
            for way, estimate in ways.items():
                call = jax.jit(estimate)
                seconds = medians({"": lambda c=call: c(jax.random.key(0))}, repeats)[
                    ""
                ]
                keys = jax.random.split(jax.random.key(1), KEYS)
                zero = jnp.zeros_like(v)
                means = [
                    sure.pooled(sure.Risk(x, call(k), zero), x, v, window=WINDOW)
                    for k in keys
                ]
                each = np.stack([m.squared_error for m in means])
                spread = each.std(axis=0, ddof=1).mean() / abs(each.mean(axis=0)).mean()
                rows.append(
                    {
                        "denoiser": name,
                        "by": way,
                        "probes": count,
                        "time / denoising": seconds / plain,
                        "standard error": float(spread),
                    }
                )
    return rows


def measure(frame: Frame) -> dict[str, float]:
    """Errors of one frame, estimated and true."""
    assert frame.reference is not None
    r, noise = frame.reference
    x, v = frame.color, frame.variance
    error = lambda image: float(rel_l2(image, r, half_difference=noise))
    denoise = jax.jit(_oidn(frame))
    estimate = lambda v: sure.monte_carlo_sure(jax.random.key(0), denoise, x, v)
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
        path, samples = frames.cases(config.folder, quick=True)[0]
    frame = frames.load(path, samples)  # before the long part, in case it is missing
    frame = frame.normalised()
    found = frames.measured(
        config.folder, {"": measure}, results=config.results, quick=config.quick
    )
    counts, repeats = (PROBES[:1], 1) if config.quick else (PROBES, config.repeats)
    return {
        "digits": digits(frame),
        "probes": probes(frame, counts, repeats),
        "frames": found,
    }


def main() -> None:
    """Print the tables."""
    found = run(tyro.cli(Config, description=__doc__))
    print("| step | relative error |\n| --- | --- |")
    for name, each in found["digits"].items():
        print(f"| {name} | {each:.1e} |")
    columns = list(found["probes"][0])
    print("\n|", " | ".join(columns), "|\n" + "| --- " * len(columns) + "|")
    for row in found["probes"]:
        cells = (f"{c:.3g}" if isinstance(c, float) else str(c) for c in row.values())
        print("|", " | ".join(cells), "|")
    rows = found["frames"]
    columns = list(next(iter(rows.values())))
    print(
        "\n| frame |", " | ".join(columns), "|\n" + "| --- " * (len(columns) + 1) + "|"
    )
    for name, row in rows.items():
        print(f"| {name} |", " | ".join(f"{row[c]:.5f}" for c in columns), "|")
    counts = sorted({int(name.split()[-1]) for name in rows})
    print("\n| error / oidn |", " | ".join(map(str, counts)), "| worst |")
    print("| --- " * (len(counts) + 2) + "|")
    for method in columns[3:]:  # the estimate may be negative
        ratios = {
            c: [r[method] / r["oidn"] for n, r in rows.items() if n.endswith(f" {c}")]
            for c in counts
        }
        means = " | ".join(f"{np.exp(np.mean(np.log(r))):.3f}" for r in ratios.values())
        print(f"| {method} | {means} | {max(map(max, ratios.values())):.2f} |")


if __name__ == "__main__":
    main()
