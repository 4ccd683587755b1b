"""How exact is each solver of the ensemble's weights, and what does it cost?

Real bases of one frame of the folder (`archives`), repeated to a size, two to eight
of them: the six denoisers, the unbiased image and a 7x7 box. Measured are: what a
solver's objective exceeds the least by, relative to that of the worst base, per pixel
and channel, where the least there is comes from `hull` in float64, and no solver may be
below it; its time by number of bases; and the time of the parts of the whole ensemble,
with the weight filter beside nothing but the exponentials that it takes, of random
images of twice the size.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common import archives
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.ensemble.bases import bases_of, unbiased_of
from jscomb import ensemble
from jscomb.denoisers import smoothing
from jscomb.frame import with_halves
from jscomb.numerics import simplex

STEPS = 64, 256, 1024, 4096
CHECKED = 256  # problems that the reference solves; it takes a millisecond each
CONVERGED = 1024  # the iterative solver's default, and the paper's


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        frame: which of them.
        samples: samples a pixel.
        size: width and height to repeat the frame to.
        repeats: timed calls of each function.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    frame: str = "staircase2"
    samples: int = 64
    size: int = 512
    repeats: int = 3


iterative = jax.jit(simplex.iterative, static_argnames="steps")
exact = jax.jit(simplex.hull)
multi_scale = jax.jit(functools.partial(ensemble.solve_weights, solver="multi-scale"))
general = jax.jit(simplex.reference)


@jax.jit
def gradient(*halves):
    """Of the weights' sum, each times its number."""

    def total(*halves):
        w = simplex.hull(*halves)
        return sum((i + 1) * jnp.sum(of_base) for i, of_base in enumerate(w))

    return jax.grad(total, argnums=(0, 1, 2, 3))(*halves)


@jax.jit
def quadratic(*halves):
    """The solver for any matrix, on that of each pixel and channel."""
    matrix = ensemble.error_matrix(
        *halves, windows=(1,), whole_frame=False, shared=False
    )
    return simplex.quadratic(matrix)


def repeated(images: jax.Array, size: int) -> jax.Array:
    """Images [N,H,W,C] mirrored over and over to [N,size,size,C]."""
    short = [(0, max(0, size - n)) for n in images.shape[1:3]]
    padded = np.pad(images, [(0, 0), *short, (0, 0)], mode="symmetric")
    return jnp.asarray(padded[:, :size, :size])


def problems(config: Config, size: int) -> list[jax.Array]:
    """y^a and y^b [8,size,size,3], x_a and x_b [size,size,3]."""
    frame = archives.load(config.folder / f"{config.frame}.npz", config.samples)
    frame = frame.normalised()
    box = with_halves(frame, lambda part: smoothing.box(part.color))
    more = {"x": unbiased_of(frame), "box": box}
    _, a, b = ensemble.stack_estimates(bases_of(frame) | more)
    x = jnp.stack([half.color for half in frame.halves()])
    a, b, (x_a, x_b) = (repeated(images, size) for images in (a, b, x))
    return [a, b, x_a, x_b]


def objective(w, a, b, x_a, x_b) -> np.ndarray:
    """|w'y^a - x_b|^2 + |w'y^b - x_a|^2 of each pixel and channel, in float64."""
    w, a, b, x_a, x_b = (np.asarray(i, np.float64) for i in (w, a, b, x_a, x_b))
    w = w / w.sum(0)  # float32 weights' sum is one to rounding
    return ((w * a).sum(0) - x_b) ** 2 + ((w * b).sum(0) - x_a) ** 2


def max_objective(a, b, x_a, x_b) -> np.ndarray:
    """That of the worst base; 1 where all are 0."""
    a, b, x_a, x_b = (np.asarray(i, np.float64) for i in (a, b, x_a, x_b))
    worst = ((a - x_b) ** 2 + (b - x_a) ** 2).max(0)
    return np.where(worst > 0, worst, 1)


def gaps(data: list[jax.Array], steps: tuple[int, ...]) -> dict[str, np.ndarray]:
    """By solver, how far each problem's objective is above the least."""
    with jax.enable_x64(True):
        double = [jnp.asarray(np.asarray(i), jnp.float64) for i in data]
        least = objective(exact(*double), *data)
        worst = max_objective(*data)
        some = [i.reshape(*i.shape[:-3], -1)[..., :CHECKED] for i in double]
        found = {"reference (OSQP)": objective(general(*some), *some)}
    found["hull"] = objective(exact(*data), *data)
    found["quadratic"] = objective(quadratic(*data), *data)
    for count in steps:
        w = iterative(jax.random.key(0), *data, steps=count)
        found[f"iterative, {count} steps"] = objective(w, *data)
    return {
        name: ((each.ravel() - least.ravel()[: each.size]) / worst.ravel()[: each.size])
        for name, each in found.items()
    }


def times(data: list[jax.Array], repeats: int) -> dict[str, float]:
    """Seconds a megapixel by solver."""
    calls: dict[str, Callable] = {
        "hull": functools.partial(exact, *data),
        "its gradient": functools.partial(gradient, *data),
        "quadratic": functools.partial(quadratic, *data),
        "multi-scale": functools.partial(multi_scale, *data),
        "iterative": lambda: iterative(jax.random.key(0), *data, steps=CONVERGED),
    }
    found = medians(calls, repeats)
    with jax.enable_x64(True):
        flat = [np.asarray(i).reshape(*i.shape[:-3], -1)[..., :CHECKED] for i in data]
        some = [jnp.asarray(i, jnp.float64) for i in flat]
        few = medians({"reference": functools.partial(general, *some)}, 1)
    pixels = data[2].size / 3
    megapixel = {name: 1e6 * each / pixels for name, each in found.items()}
    return megapixel | {"reference": 3e6 * few["reference"] / CHECKED}


def parts(data: list[jax.Array], size: int, repeats: int) -> dict[str, float]:
    """Seconds of the ensemble's parts; and of the filter with its lower bound."""
    matrix = jax.jit(ensemble.error_matrix)
    ready = matrix(*data)
    of_images, of_weights = jax.random.split(jax.random.key(0))
    z, v, albedo, normal = jax.random.uniform(of_images, (4, size, size, 3))
    weights = jax.random.dirichlet(of_weights, jnp.ones(4), (size, size, 3))
    smooth = jax.jit(
        lambda w: ensemble.filter_weights(w, z, v, albedo=albedo, normal=normal)
    )

    @jax.jit
    def exponentials(image):
        """As many as the filter takes: one a pixel of each window of 15x15."""
        add = lambda k, total: total + jnp.exp(-image * (1 + 1e-3 * k))
        return jax.lax.fori_loop(0, 15**2, add, jnp.zeros_like(image))

    calls: dict[str, Callable] = {
        "hull": functools.partial(exact, *data),
        "error_matrix, multi-scale": functools.partial(matrix, *data),
        "quadratic on it": functools.partial(jax.jit(simplex.quadratic), ready),
        "solve_weights, multi-scale": functools.partial(multi_scale, *data),
        "filter_weights": functools.partial(smooth, jnp.moveaxis(weights, -1, 0)),
        "its exponentials": functools.partial(exponentials, z[..., 0]),
    }
    return medians(calls, repeats)


@dataclasses.dataclass(frozen=True)
class Found:
    """Gaps of all problems, and seconds a megapixel, by number of bases and solver."""

    gaps: dict[int, dict[str, np.ndarray]]
    times: dict[int, dict[str, float]]
    parts: dict[str, float]


def run(config: Config) -> Found:
    """Measure everything.

    Args:
        config: what to measure; if quick, small images, three bases and few steps.

    Returns:
        gaps, and times of solvers and of parts.
    """
    size, repeats = (48, 1) if config.quick else (config.size, config.repeats)
    a, b, x_a, x_b = problems(config, size)
    found = Found({}, {}, parts([a[:4], b[:4], x_a, x_b], 2 * size, repeats))
    for n in tqdm([3] if config.quick else range(2, 9), unit="bases"):
        data = [a[:n], b[:n], x_a, x_b]
        found.gaps[n] = gaps(data, STEPS[:1] if config.quick else STEPS)
        found.times[n] = times(data, repeats)
    return found


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        gaps, times and parts.
    """
    largest = {
        name: max(gap[name].max() for gap in found.gaps.values())
        for name in next(iter(found.gaps.values()))
    }
    least = {
        name: min(gap[name].min() for gap in found.gaps.values()) for name in largest
    }
    shown = min(found.gaps, key=lambda n: abs(n - 4))
    steps = [name for name in largest if name.startswith("iterative")]
    paper = f"iterative, {CONVERGED} steps"
    paper = paper if paper in largest else steps[-1]
    spent, parts = found.times[shown], found.parts
    answer = (
        f"`hull` exceeds the least objective by {largest['hull']:.0e} of the worst "
        f"base's at most; the paper's solver by {largest[paper]:.0e} ({paper}), in "
        f"{spent['iterative'] / spent['hull']:.0f} times the time of {shown} bases "
        f"({CONVERGED} steps); OSQP takes {spent['reference'] / spent['hull']:.0f} "
        "times the time. The weight filter takes "
        f"{parts['filter_weights'] / parts['its exponentials']:.0f} times its "
        "exponentials alone."
    )
    cells = lambda name: [f"{g[name].max():.1e} ({g[name].mean():.1e})"
                          for g in found.gaps.values()]  # fmt: skip
    bases = [f"{n} bases" for n in found.gaps]
    solvers = list(spent)
    tables = [
        table(
            ["largest gap (mean)", *bases, "least of all"],
            [[name, *cells(name), f"{least[name]:.1e}"] for name in largest],
        ),
        f"Seconds a megapixel of three channels: `iterative` with {CONVERGED} steps, "
        f"the reference from {CHECKED} problems, three a pixel; `multi-scale` with its "
        "error matrices, the others of single pixels.",
        table(
            ["bases", *solvers],
            [[n, *(each[s] for s in solvers)] for n, each in found.times.items()],
        ),
        table(["part, four bases", "ms"], [[n, 1e3 * s] for n, s in parts.items()]),
    ]
    return Report(answer, "\n\n".join(tables))


if __name__ == "__main__":
    main(Config, run, report)
