"""How much of the ensemble's error comes from not knowing the bases' errors?

Renders each scene many times over, with two halves each (work done so far is kept in
the folder), and makes all bases of all renderings. From three quarters of them the true
error matrices, of the full images and of halves; on the others, by relative L2 less the
reference's noise, divided by that of the best base: weights from the true matrices,
from all estimates <M> of the three quarters together, each of at least zero, one-hot
and of either sign, and from what each rendering can tell by itself. DSSIM likewise.
"""

import dataclasses
import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.ensemble import methods
from experiments.ensemble.bases import BASES, bases_of, best, rendered
from experiments.ensemble.methods import METHODS, OURS, PAPER, Inputs
from jscomb import ensemble
from jscomb.frame import Buffers, Frame
from jscomb.numerics import simplex
from jscomb.rendering import Settings
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        scenes: names of scenes, see `jscomb.rendering`, or XML files.
        work: folder that keeps what is rendered.
        results: file that results are kept in; None to keep none.
        renderings: of each scene, at least four.
        samples: samples a pixel of each rendering.
        size: width and height in pixels.
        reference_spp: samples a pixel of the reference.
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    work: pathlib.Path
    results: pathlib.Path | None = None
    renderings: int = 32
    samples: int = 64
    size: int = 128
    reference_spp: int = 16384


def _name(scene: str) -> str:
    """What a scene is called: its own name, or its file's folder."""
    path = pathlib.Path(scene)
    return path.parent.name if path.suffix == ".xml" else scene


def renderings_of(frame: Frame) -> list[Frame]:
    """Each two sub-buffers as a frame by themselves."""
    count = frame.sub_buffers // 2

    def rendering(number: int) -> Frame:
        mine = slice(2 * number, 2 * number + 2)
        buffers = (b if b is None or len(b) == 1 else b[mine] for b in frame.buffers)
        samples = None if frame.samples is None else frame.samples / count
        return Frame(Buffers._make(buffers), samples, {}, None, unit=frame.unit)

    return [rendering(number) for number in range(count)]


TRUE, HALVES, ALL_RENDERINGS = "true M", "true M of halves", "<M> of all renderings"
ONE_HOT, EITHER = ", one-hot", ", either sign"
DSSIM = ", DSSIM"
OWN = (
    *(methods.ONE_HOT, methods.AFTER, methods.EITHER, methods.UNFILTERED, PAPER),
    *("7x7", "31x31", "frame", OURS),
)


def each_of(given: Inputs) -> list[Inputs]:
    """The inputs of single renderings."""
    count = len(given.full)
    return [Inputs(*(i[k] for i in given[:7]), *given[7:]) for k in range(count)]


@jax.jit
def true_weights(given: Inputs, truth: Image) -> dict[str, jax.Array]:
    """Weights by many renderings: of at least zero, one-hot, and of either sign."""
    estimates = jax.vmap(ensemble.mse_matrix)(*given.halves)
    matrices = {
        TRUE: ensemble.true_matrix(given.full, truth),
        HALVES: ensemble.true_matrix(given.a, truth),
        ALL_RENDERINGS: jnp.mean(estimates, axis=0),
    }
    found = {}
    for name, m in matrices.items():
        found[name] = simplex.quadratic(m)
        found[name + ONE_HOT] = ensemble.one_hot(
            jnp.stack([m[k, k] for k in range(len(m))])
        )
        found[name + EITHER] = simplex.affine(m)
    return found


def measure(config: Config, scene: str) -> dict[str, float]:
    """Relative L2 and DSSIM by method, means over the judged renderings."""
    settings = Settings(
        spp=config.renderings * config.samples,
        size=config.size,
        buffers=2 * config.renderings,
        feature_spp=4,
        reference_spp=config.reference_spp,
    )
    name = _name(scene)
    frame = rendered(scene, config.work / f"{name}.npz", settings).normalised()
    assert frame.reference is not None
    made = []
    for rendering in tqdm(renderings_of(frame), unit="rendering", desc=name):
        made.append(methods.inputs_of(rendering, bases_of(rendering))[:7])
    every = Inputs(
        *(jnp.stack(each) for each in zip(*made, strict=True)),
        albedo=frame.albedo,
        normal=frame.normal,
    )
    known = 3 * len(made) // 4
    some = lambda of: Inputs(*(i[of] for i in every[:7]), *every[7:])
    known, judged = some(slice(known)), some(slice(known, None))
    images = {name: judged.full[:, k] for k, name in enumerate(BASES)}
    images["average"] = jnp.mean(judged.full, axis=1)
    images |= {n: [METHODS[n](one) for one in each_of(judged)] for n in OWN}
    for name, w in true_weights(known, frame.reference.image).items():
        images[name] = jax.vmap(ensemble.average, (0, None))(judged.full, w)
    row = {}
    for name, some_images in images.items():
        row[name] = float(np.mean([errors.relative_l2(i, frame) for i in some_images]))
        row[name + DSSIM] = float(
            np.mean([errors.dssim(i, frame) for i in some_images])
        )
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every scene.

    Args:
        config: what to measure.

    Returns:
        relative L2 and DSSIM by scene and method.
    """
    if config.quick:
        config = dataclasses.replace(
            config, renderings=12, samples=4, size=24, reference_spp=1024
        )
    kept = Results(config.results)
    return {
        s: kept.get(s, functools.partial(measure, config, s)) for s in config.scenes
    }


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        rows: by `run`.

    Returns:
        ratios to the best base, by scene.
    """
    names = [n for n in next(iter(rows.values())) if not n.endswith(DSSIM)]
    titles = [_name(scene) for scene in rows]
    ratios = {n: [row[n] / best(row) for row in rows.values()] for n in names}
    dissimilar = {
        n: [r[n + DSSIM] / min(r[b + DSSIM] for b in BASES) for r in rows.values()]
        for n in names
    }
    span = lambda name: f"{min(ratios[name]):.2f} to {max(ratios[name]):.2f}"
    share = np.mean([1 - row[TRUE] / row[OURS] for row in rows.values()])
    answer = (
        f"With the true error matrices of every pixel the ensemble has {span(TRUE)} of "
        f"the best base's relative L2 ({span(TRUE + ONE_HOT)} with one base a pixel, "
        f"{span(TRUE + EITHER)} with weights of either sign), with those of halves "
        f"{span(HALVES)}; with what a rendering's own halves tell {span(PAPER)} by the "
        f"paper's weights of single pixels, filtered, {span(methods.EITHER)} by these "
        f"of either sign, and {span(OURS)} at all scales: not knowing the matrices is "
        f"{share:.0%} of that error (mean of {len(rows)} scenes)."
    )
    header = [*titles, *(f"{title}, DSSIM" for title in titles)]
    return Report(
        answer,
        table(
            ["error / best base", *header],
            [[n, *r, *dissimilar[n]] for n, r in ratios.items()],
        ),
    )


if __name__ == "__main__":
    main(Config, run, report)
