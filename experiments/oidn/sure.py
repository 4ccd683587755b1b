"""Does SURE of Open Image Denoise know its error, where the truth is known?

The truth is an archive's reference; to it comes Gaussian noise whose deviation is 1, 5
and 20 % of the truth (plus 0.1 of the median luminance). The divergence comes from one
probe, by the network's derivative or by central differences of the filter, whose step
changes the typical pixel by that part of its value. A table: SURE's mean over frame and
draws, divided by that of the true error, with its standard error over the draws; a row
for each noise and way. Both relative to the truth (plus 0.1) squared.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.common import archives
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.typing import Image

NOISES = 0.01, 0.05, 0.2
STEPS = 0.03, 0.003, 3e-4
FLOOR = 0.1  # normalised radiance


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        draws: of the noise, for each frame.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    draws: int = 8


def difference(denoise: Callable, x: Image, b: Image, step: float) -> Image:
    """The derivative along b, by a central difference."""
    relative = jnp.where(b == 0, 1.0, abs(b) / (abs(x) + 1))
    h = step / jnp.exp(jnp.mean(jnp.log(relative)))
    return (denoise(x + h * b) - denoise(x - h * b)) / (2 * h)


def measure(frame: Frame, noise: float, draws: int) -> dict[str, list[float]]:
    """True error, and SURE by each way, for every draw."""
    assert frame.reference is not None
    mu = jnp.maximum(frame.reference.image, 0.0).astype(jnp.float32)
    deviation = noise * (mu + FLOOR)
    mean = lambda square: float(jnp.mean(square / (mu + FLOOR) ** 2))
    denoise = jax.jit(functools.partial(oidn.denoise_color, frame=frame))
    derivative = jax.jit(lambda x, b: jax.jvp(denoise, (x,), (b,))[1])
    found: dict[str, list[float]] = {"true": []}
    for key in jax.random.split(jax.random.key(0), draws):
        of_noise, of_probe = jax.random.split(key)
        x = mu + deviation * jax.random.normal(of_noise, mu.shape, mu.dtype)
        b = deviation * jax.random.rademacher(of_probe, mu.shape, mu.dtype)
        y = denoise(x)
        moved = {"derivative": derivative(x, b)}
        for step in STEPS:
            moved[f"difference {step:g}"] = difference(denoise, x, b, step)
        found["true"].append(mean(jnp.square(y - mu)))
        for way, each in moved.items():
            sure = jnp.square(y - x) + 2 * b * each - deviation**2
            found.setdefault(way, []).append(mean(sure))
    return found


def run(config: Config) -> dict[float, dict[str, dict[str, list[float]]]]:
    """Measure all frames.

    Args:
        config: what to measure.

    Returns:
        the errors of every draw by noise, frame, and way, "true" among them.

    Raises:
        ValueError: if the folder holds no archive.
    """
    paths = sorted({path for path, _ in archives.cases(config.folder)})
    draws = 2 if config.quick else config.draws
    found: dict[float, dict[str, dict[str, list[float]]]] = {}
    for path in paths[:1] if config.quick else paths:
        samples = archives.sample_counts(path)[-1]
        frame = archives.load(path, samples).normalised()
        for noise in NOISES:
            found.setdefault(noise, {})[path.stem] = measure(frame, noise, draws)
    return found


def report(found: dict) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        the table.
    """
    rows, off = [], {}
    for noise, frames in found.items():
        ways = [way for way in next(iter(frames.values())) if way != "true"]
        for way in ways:
            ratios, deviations = [], []
            for each in frames.values():
                true = np.mean(each["true"])
                excess = np.subtract(each[way], each["true"]) / true
                ratios.append(1 + excess.mean())
                deviations.append(excess.std(ddof=1) / len(excess) ** 0.5)
            both = list(zip(ratios, deviations, strict=True))
            away = [abs(r - 1) / d for r, d in both]
            off.setdefault(way, []).append(np.mean(ratios))
            share = f"{noise:.0%}"
            cells = (f"{r:.3f} ± {d:.3f}" for r, d in both)
            rows.append([share, way, *cells, float(max(away))])
    names = list(next(iter(found.values())))
    head = ["noise", "divergence by", *names, "worst, in standard errors"]
    means = {way: [float(r) for r in ratios] for way, ratios in off.items()}
    said = lambda way: ", ".join(f"{ratio:.2f}" for ratio in means[way])
    levels = ", ".join(f"{noise:.0%}" for noise in found)
    answer = (
        f"SURE by the derivative is {said('derivative')} of the true error at {levels} "
        f"noise (mean over frames); by a difference of {STEPS[0]:g} it is "
        f"{said(f'difference {STEPS[0]:g}')}, of {STEPS[-1]:g} "
        f"{said(f'difference {STEPS[-1]:g}')}."
    )
    return Report(answer, table(head, rows))


if __name__ == "__main__":
    main(Config, run, report)
