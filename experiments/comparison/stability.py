"""What do the combiners make of the ugliest frames?

Synthetic frames of known truth, each hard in its own way. For every combiner: mean
squared error over the pixels that are finite in the inputs, divided by that of the
better input; the worst pixel's error, divided by the worst of either input; and whether
the image and the derivatives in all arrays are finite everywhere.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb import ensemble, progressive
from jscomb.denoisers import smoothing
from jscomb.learning import recipes
from jscomb.numerics.guards import finite
from jscomb.numerics.luminance import median_luminance
from jscomb.typing import Image, Variance
from tests.battery.rendering import UNTRAINED, of_images


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to try.

    Attributes:
        size: width and height in pixels.
        seed: of the noise.
    """

    size: int = 64
    seed: int = 0


class Case(NamedTuple):
    """A hard frame.

    Attributes:
        unbiased: x, radiance, [H,W,3].
        biased: y, likewise.
        variance: of the mean x, squared radiance, likewise.
        truth: radiance, likewise.
    """

    unbiased: Image
    biased: Image
    variance: Variance
    truth: Image


def cases(size: int, seed: int) -> dict[str, Case]:
    """All hard frames.

    Args:
        size: width and height in pixels.
        seed: of the noise.

    Returns:
        frames by what is hard about them.
    """
    ramp = jnp.linspace(0.1, 2.0, size)
    truth = jnp.broadcast_to(jnp.outer(ramp, ramp)[..., None], (size, size, 3))
    deviation = 0.3 * truth + 0.05
    noise = jax.random.normal(jax.random.key(seed), truth.shape)
    x, v = truth + deviation * noise, jnp.square(deviation)
    plain = Case(x, 1.05 * truth, v, truth)
    at = (slice(None, None, 17), slice(None, None, 13))
    scaled = lambda s: Case(s * x, s * plain.biased, s * s * v, s * truth)
    one = lambda h, w: Case(*(image[:h, :w] for image in plain))
    burnt = plain._replace(unbiased=x.at[at].set(1e6), variance=v.at[at].set(1e12))
    return {
        "plain": plain,
        "fireflies of 1e6": burnt,
        "fireflies, variance silent": burnt._replace(variance=v),
        "radiance of 1e-8": scaled(1e-8),
        "radiance of 1e6": scaled(1e6),
        "no variance": plain._replace(unbiased=truth, variance=jnp.zeros_like(v)),
        "x equals y": plain._replace(biased=x),
        "severely biased": plain._replace(biased=jnp.full_like(x, 50.0)),
        "NaN and infinite pixels": plain._replace(
            unbiased=x.at[at].set(jnp.nan), biased=plain.biased.at[1::9, 3].set(jnp.inf)
        ),
        "black": Case(*(jnp.zeros_like(x) for _ in Case._fields)),
        "1x1": one(1, 1),
        "1xN": one(1, size),
        "smaller than the window": one(4, 3),
    }


Combine = Callable[[Image, Image, Variance], Image]


def _network(name: str, inputs: Callable[..., dict[str, Image]]) -> Combine:
    """A trained network's combiner, of three images."""
    network = recipes.shipped(name)

    def combine(x: Image, y: Image, v: Variance) -> Image:
        unit = median_luminance(x)
        normalised = recipes.in_unit(inputs(x, y, v), unit)
        return unit * recipes.RECIPES[name].combine(network, normalised)

    return combine


def combiners(*, networks: bool = True) -> dict[str, Combine]:
    """What is tried, as functions of x, y and the variance.

    Args:
        networks: the trained ones too.

    Returns:
        functions by name.
    """

    def sure(x: Image, y: Image, v: Variance) -> Image:
        """Of a denoiser that does not follow the noise."""
        some = finite(x, y, v)  # so that derivatives are, too
        x, y, v = (jnp.where(some, image, 0.0) for image in (x, y, v))
        return jnp.square(x - y) - v

    def of_bases(x: Image, y: Image, v: Variance) -> Image:
        bases = jnp.stack([y, smoothing.box(y, window=3)])
        return ensemble.combine(bases, bases, bases, x, x, solver="hull", filter=False)

    found: dict[str, Combine] = {
        **{name: of_images(name) for name in UNTRAINED},
        "progressive": lambda x, y, v: progressive.combine(x, y, v, sure(x, y, v)),
        "ensemble": of_bases,
    }
    if networks:
        grey = lambda image: jnp.mean(image, axis=-1, keepdims=True)
        images = lambda x, y, v: {"unbiased": x, "biased": y, "variance": v}
        found["njs"] = _network(
            "njs",
            lambda x, y, v: {
                "unbiased": x,
                "biased_a": y,
                "biased_b": y,
                "variance": v,
            },
        )
        found["pd"] = _network(
            "pd", lambda x, y, v: images(x, y, v) | {"sure": sure(x, y, v)}
        )
        found["dsc"] = _network(
            "dsc",
            lambda x, y, v: (
                images(x, y, grey(v))
                | {"prior": smoothing.box(y, window=3), "mse": grey(v) / 4}
            ),
        )
    return found


class Outcome(NamedTuple):
    """Of a combiner on a frame.

    Attributes:
        error: mean squared error / that of the better input.
        worst: worst pixel's error / the worst of either input.
        finite: the image, and all derivatives.
    """

    error: float
    worst: float
    finite: tuple[bool, bool]


def outcome(combine: Combine, case: Case) -> Outcome:
    """Combine, and differentiate.

    Args:
        combine: of x, y and the variance.
        case: the frame.

    Returns:
        what came of it.
    """
    *images, truth = case
    seen = finite(*images)

    def total(*images: Image) -> tuple[Image, Image]:
        made = combine(*images)
        return jnp.sum(made), made

    gradients, made = jax.jit(jax.grad(total, argnums=(0, 1, 2), has_aux=True))(*images)
    square = lambda image: jnp.where(seen, jnp.square(image - truth), 0.0)
    mean = lambda image: float(jnp.mean(square(image)))
    worst = lambda image: float(jnp.sqrt(jnp.max(square(image))))
    inputs = images[:2]
    ratio = lambda a, b: a / b if b > 0 else float(a > 0)
    return Outcome(
        ratio(mean(made), min(map(mean, inputs))),
        ratio(worst(made), max(map(worst, inputs))),
        (
            bool(jnp.isfinite(made).all()),
            all(bool(jnp.isfinite(g).all()) for g in gradients),
        ),
    )


def run(config: Config) -> dict[tuple[str, str], Outcome]:
    """Try everything.

    Args:
        config: what to try.

    Returns:
        outcomes by case and combiner.
    """
    size = 24 if config.quick else config.size
    tried = combiners(networks=not config.quick)
    return {
        (case, name): outcome(combine, frame)
        for case, frame in cases(size, config.seed).items()
        for name, combine in tried.items()
    }


def report(found: dict[tuple[str, str], Outcome]) -> Report:
    """Say what came of the hard frames.

    Args:
        found: by `run`.

    Returns:
        a line a frame: mean error / that of the better input, worst pixel / the worst.
    """
    names = list(dict.fromkeys(name for _, name in found))
    hard = list(dict.fromkeys(case for case, _ in found))

    def cell(case: str, name: str) -> str:
        error, worst, finite_ones = found[case, name]
        return f"{error:.2g}, {worst:.2g}" + ("" if all(finite_ones) else " not finite")

    number = sum(all(each.finite) for each in found.values())
    largest = max(found, key=lambda key: found[key].error)
    answer = (
        f"Image and all derivatives are finite in {number} of {len(found)} trials "
        f"({len(hard)} frames, {len(names)} combiners). The largest error is "
        f"{found[largest].error:.3g} times that of the better input "
        f"({largest[1]}, {largest[0]})."
    )
    rows = [[case, *(cell(case, name) for name in names)] for case in hard]
    return Report(answer, table(["frame", *names], rows))


if __name__ == "__main__":
    main(Config, run, report)
