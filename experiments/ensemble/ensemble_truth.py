"""How much of the ensemble's error comes from not knowing the bases' errors?

    python -m experiments.ensemble.ensemble_truth cornell-glass --out FOLDER

Renders each scene many times over, with two halves each (work done so far is kept in
the folder), and makes all bases of all renderings. From three quarters of them the true
error matrices, of the full images and of halves; on the others, by relative L2 less the
reference's noise, divided by that of the best base: weights from the true matrices,
from all estimates <M> of the three quarters together, and from what each rendering can
tell by itself.
"""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import tyro
from tqdm import tqdm

from experiments.ensemble.bases import BASES, bases_of
from jscomb import ensemble
from jscomb.frame import Buffers, Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import simplex
from jscomb.rendering import Settings, render


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        scenes: names of scenes, see `jscomb.rendering.SCENES`.
        out: folder for the work done so far.
        renderings: of each scene, at least four.
        samples: samples a pixel of each rendering.
        size: width and height in pixels.
        reference_spp: samples a pixel of the reference.
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    out: pathlib.Path
    renderings: int = 32
    samples: int = 64
    size: int = 128
    reference_spp: int = 16384


def rendered(config: Config, scene: str) -> Frame:
    """One frame with two sub-buffers for each rendering."""
    config.out.mkdir(parents=True, exist_ok=True)
    settings = Settings(
        spp=config.renderings * config.samples,
        size=config.size,
        buffers=2 * config.renderings,
        feature_spp=4,
        reference_spp=config.reference_spp,
    )
    partial = config.out / f"{scene}.partial.npz"
    return render(scene, settings, partial=partial)


def renderings_of(frame: Frame) -> list[Frame]:
    """Each two sub-buffers as a frame by themselves."""
    count = frame.sub_buffers // 2

    def rendering(number: int) -> Frame:
        mine = slice(2 * number, 2 * number + 2)
        buffers = (b if b is None or len(b) == 1 else b[mine] for b in frame.buffers)
        samples = None if frame.samples is None else frame.samples / count
        return Frame(Buffers(*buffers), samples, {}, None, unit=frame.unit)

    return [rendering(number) for number in range(count)]


def own_weights(a, b, x_a, x_b) -> dict[str, jax.Array]:
    """Weights by what one rendering's halves tell."""
    halves = a, b, x_a, x_b
    window = lambda width: simplex.quadratic(
        ensemble.error_matrix(*halves, windows=(width,), whole_frame=False)
    )
    frame = simplex.quadratic(ensemble.error_matrix(*halves, windows=()))
    return {
        "<M> of the pixel": simplex.hull(*halves),
        "<M> over 7x7": window(7),
        "<M> over 31x31": window(31),
        "<M> over the frame": frame,
        "<M> multi-scale": ensemble.solve_weights(*halves, solver="multi-scale"),
    }


@jax.jit
def all_own(full, *halves):
    """Images by `own_weights`, of all renderings at once."""

    def one(full, *halves):
        found = own_weights(*halves)
        wide = {name: jnp.broadcast_to(w, full.shape) for name, w in found.items()}
        return {name: ensemble.average(full, w) for name, w in wide.items()}

    return jax.vmap(one)(full, *halves)


@jax.jit
def true_weights(full, a, b, x_a, x_b, truth):
    """Weights by many renderings."""
    estimates = jax.vmap(ensemble.mse_matrix)(a, b, x_a, x_b)
    matrices = {
        "true M": ensemble.true_matrix(full, truth),
        "true M of halves": ensemble.true_matrix(a, truth),
        "<M> of all renderings": jnp.mean(estimates, axis=0),
    }
    return {name: simplex.quadratic(m) for name, m in matrices.items()}


def measure(config: Config, scene: str) -> dict[str, float]:
    """Relative L2 by method, mean over the judged renderings."""
    frame = rendered(config, scene)
    frame = frame.normalised()
    assert frame.reference is not None
    truth, noise = frame.reference
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
    error = jax.vmap(lambda image: rel_l2(image, truth, half_difference=noise))
    images = {name: full[:, k] for k, name in enumerate(BASES)}
    images["average"] = jnp.mean(full, axis=1)
    images |= all_own(full, a, b, x_a, x_b)
    for name, w in true_weights(*data, truth).items():
        images[name] = jax.vmap(ensemble.average, (0, None))(full, w)
    return {name: float(jnp.mean(error(each))) for name, each in images.items()}


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every scene.

    Args:
        config: what to measure.

    Returns:
        relative L2 by scene and method.
    """
    return {scene: measure(config, scene) for scene in config.scenes}


def main() -> None:
    """Print the table."""
    found = run(tyro.cli(Config, description=__doc__))
    names = list(next(iter(found.values())))
    print(f"| error / best base | {' | '.join(found)} |")
    print("| --- " * (len(found) + 1) + "|")
    for name in names:
        ratios = [
            row[name] / min(row[base] for base in BASES) for row in found.values()
        ]
        print(f"| {name} | {' | '.join(f'{r:.3f}' for r in ratios)} |")


if __name__ == "__main__":
    main()
