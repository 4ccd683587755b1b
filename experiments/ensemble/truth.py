"""How much of the ensemble's error comes from not knowing the bases' errors?

Renders each scene many times over, with two halves each (work done so far is kept in
the folder), and makes all bases of all renderings. From three quarters of them the true
error matrices, of the full images and of halves; on the others, by relative L2 less the
reference's noise, divided by that of the best base: weights from the true matrices,
from all estimates <M> of the three quarters together, and from what each rendering can
tell by itself.
"""

import dataclasses
import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.errors import relative_l2
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.ensemble.bases import BASES, bases_of, rendered
from experiments.ensemble.weights import best, over
from jscomb import ensemble
from jscomb.frame import Buffers, Frame
from jscomb.numerics import simplex
from jscomb.rendering import Settings


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        scenes: names of scenes, see `jscomb.rendering`.
        work: folder that keeps what is rendered.
        renderings: of each scene, at least four.
        samples: samples a pixel of each rendering.
        size: width and height in pixels.
        reference_spp: samples a pixel of the reference.
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    work: pathlib.Path
    renderings: int = 32
    samples: int = 64
    size: int = 128
    reference_spp: int = 16384


def renderings_of(frame: Frame) -> list[Frame]:
    """Each two sub-buffers as a frame by themselves."""
    count = frame.sub_buffers // 2

    def rendering(number: int) -> Frame:
        mine = slice(2 * number, 2 * number + 2)
        buffers = (b if b is None or len(b) == 1 else b[mine] for b in frame.buffers)
        samples = None if frame.samples is None else frame.samples / count
        return Frame(Buffers._make(buffers), samples, {}, None, unit=frame.unit)

    return [rendering(number) for number in range(count)]


OURS, TRUE = "<M> multi-scale", "true M"
OWN = {
    "<M> of the pixel": simplex.hull,
    "<M> over 7x7": over(7),
    "<M> over 31x31": over(31),
    "<M> over the frame": over(whole_frame=True),
    OURS: functools.partial(ensemble.solve_weights, solver="multi-scale"),
}


@jax.jit
@jax.vmap
def all_own(full, *halves):
    """Images by what its own halves tell of each rendering."""
    wide = lambda weights: jnp.broadcast_to(weights, full.shape)
    return {n: ensemble.average(full, wide(weigh(*halves))) for n, weigh in OWN.items()}


@jax.jit
def true_weights(full, a, b, x_a, x_b, truth):
    """Weights by many renderings."""
    estimates = jax.vmap(ensemble.mse_matrix)(a, b, x_a, x_b)
    matrices = {
        TRUE: ensemble.true_matrix(full, truth),
        "true M of halves": ensemble.true_matrix(a, truth),
        "<M> of all renderings": jnp.mean(estimates, axis=0),
    }
    return {name: simplex.quadratic(m) for name, m in matrices.items()}


def measure(config: Config, scene: str) -> dict[str, float]:
    """Relative L2 by method, mean over the judged renderings."""
    settings = Settings(
        spp=config.renderings * config.samples,
        size=config.size,
        buffers=2 * config.renderings,
        feature_spp=4,
        reference_spp=config.reference_spp,
    )
    frame = rendered(scene, config.work / f"{scene}.npz", settings).normalised()
    assert frame.reference is not None
    every = renderings_of(frame)
    bases, unbiased = [], []
    for rendering in tqdm(every, unit="rendering", desc=scene):
        bases.append(ensemble.stack_estimates(bases_of(rendering)))
        unbiased.append([half.color for half in rendering.halves()])
    full, a, b = (jnp.stack(i) for i in zip(*bases, strict=True))
    x_a, x_b = (jnp.stack(i) for i in zip(*unbiased, strict=True))
    known = 3 * len(every) // 4
    data = [i[:known] for i in (full, a, b, x_a, x_b)]
    full, a, b, x_a, x_b = (i[known:] for i in (full, a, b, x_a, x_b))
    images = {name: full[:, k] for k, name in enumerate(BASES)}
    images["average"] = jnp.mean(full, axis=1)
    images |= all_own(full, a, b, x_a, x_b)
    for name, w in true_weights(*data, frame.reference.image).items():
        images[name] = jax.vmap(ensemble.average, (0, None))(full, w)
    error = lambda some: np.mean([relative_l2(image, frame) for image in some])
    return {name: float(error(some)) for name, some in images.items()}


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every scene.

    Args:
        config: what to measure.

    Returns:
        relative L2 by scene and method.
    """
    if config.quick:
        config = dataclasses.replace(
            config, renderings=12, samples=4, size=24, reference_spp=1024
        )
    return {scene: measure(config, scene) for scene in config.scenes}


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        ratios to the best base, by scene.
    """
    names = list(next(iter(rows.values())))
    ratios = {n: [row[n] / best(row) for row in rows.values()] for n in names}
    span = lambda name: f"{min(ratios[name]):.2f} to {max(ratios[name]):.2f}"
    share = np.mean([1 - row[TRUE] / row[OURS] for row in rows.values()])
    answer = (
        f"With the true error matrices of every pixel the ensemble has {span(TRUE)} of "
        f"the best base's relative L2, with those that a rendering's own halves tell "
        f"at all scales {span(OURS)}: not knowing them is {share:.0%} of its error "
        f"(mean of {len(rows)} scenes)."
    )
    return Report(
        answer,
        table(["error / best base", *rows], [[n, *r] for n, r in ratios.items()]),
    )


if __name__ == "__main__":
    main(Config, run, report)
