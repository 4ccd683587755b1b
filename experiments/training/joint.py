"""Is a denoiser better when it learns together with its combiner?

Trains, on FOLDER's train split, a kernel-predicting denoiser alone; a James-Stein
network on the fixed images of that denoiser (apart); and both as one, with one loss at
the end (jointly). Each has the same number of steps; the same command resumes an
interrupted training. Then, on every frame of a split that took no part: relative L2,
less the reference's noise, over that of the denoiser alone.
"""

import dataclasses
import functools
import pathlib
from typing import Any, Literal, NamedTuple

import jax
import tyro
from matplotlib.figure import Figure

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.data import dataset
from experiments.training.learned import curves
from experiments.training.train import QUICK
from jscomb import cli, exr, james_stein
from jscomb.denoisers import kernel_predicting
from jscomb.learning import recipes
from jscomb.learning.recipes import RECIPES, Inputs, Network, Recipe
from jscomb.typing import Image

ALONE, APART, JOINT = "kernels", "kernels-then-njs", "kernels-njs"
PATH_TRACING, DENOISED = "path tracing", "denoiser alone"
WHITENED = "denoiser, then James-Stein without a network"
TRAINED_APART, TRAINED_JOINTLY = "both, trained apart", "both, trained jointly"
INNER = "the denoiser that was trained jointly, by itself"


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to train and to measure.

    Attributes:
        folder: of `experiments.data.dataset`.
        out: folder of the three runs.
        size: of all networks.
        steps: of each run.
        split: that is measured.
        results: file that stores results as they come.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    out: pathlib.Path
    size: Literal["light", "full"] = "light"
    steps: int = 2000
    split: str = "test"
    results: pathlib.Path | None = None


class Found(NamedTuple):
    """What was measured.

    Attributes:
        rows: relative L2 by image, by "view samples".
        cards: of the runs, by name.
    """

    rows: dict[str, dict[str, float]]
    cards: dict[str, dict[str, Any]]


def apart(denoiser: Network) -> Recipe:
    """Return the recipe of a James-Stein network for a denoiser that stays as it is.

    Args:
        denoiser: kernel predictor.

    Returns:
        the recipe; its inputs are those of the denoiser.
    """

    def combine(network: Network, inputs: Inputs) -> Image:
        y = kernel_predicting.denoise_inputs(denoiser, inputs)
        return james_stein.combine_inputs(network, _images(inputs, y))

    return RECIPES["njs"]._replace(
        inputs=RECIPES[ALONE].inputs,
        combine=combine,
        options=dict(RECIPES["njs"].options),
        without=None,
        others=(),
    )


def train(config: Config) -> dict[str, tuple[Recipe, Network, dict[str, Any]]]:
    """Train what is not trained yet.

    Args:
        config: where and how long.

    Returns:
        recipe, network and card of the runs by name.
    """
    found: dict[str, tuple[Recipe, Network, dict[str, Any]]] = {}
    for name in (ALONE, APART, JOINT):
        recipe = apart(found[ALONE][1]) if name == APART else RECIPES[name]
        each = cli.Run(name, config.size, config.steps)
        if config.quick:
            each = dataclasses.replace(each, **QUICK, validate=10)
        card = cli.train_files(each, recipe, config.folder, config.out / name)
        file = config.out / name / "network.safetensors"
        found[name] = recipe, recipes.load_network(recipe, file), card
    return found


def measure(
    path: pathlib.Path, trained: dict[str, tuple[Recipe, Network, dict[str, Any]]]
) -> dict[str, float]:
    """Return the errors of a frame's images.

    Args:
        path: of the frame.
        trained: by `train`.

    Returns:
        relative L2 by image.
    """
    frame = exr.read_frame(path).normalised()
    inputs = kernel_predicting.neural_inputs(frame)
    network = {name: each for name, (_, each, _) in trained.items()}
    denoise = _compiled(kernel_predicting.denoise_inputs)
    combine = _compiled(james_stein.combine_inputs)
    y, inner = (
        denoise(net, inputs) for net in (network[ALONE], network[JOINT].denoiser)
    )
    plain = RECIPES["njs"].without
    assert plain is not None
    images = {
        PATH_TRACING: frame.color,
        DENOISED: y,
        WHITENED: _compiled(plain)(_images(inputs, y)),
        TRAINED_APART: combine(network[APART], _images(inputs, y)),
        TRAINED_JOINTLY: combine(network[JOINT].combiner, _images(inputs, inner)),
        INNER: inner,
    }
    return {name: errors.relative_l2(image, frame) for name, image in images.items()}


def run(config: Config) -> Found:
    """Train, and measure every frame.

    Args:
        config: what to train and to measure.

    Returns:
        errors and cards.

    Raises:
        ValueError: if there are no frames, or a folder holds another run.
    """
    trained, first = train(config), 2 if config.quick else None
    of, where = (
        functools.partial(measure, trained=trained),
        (config.folder, config.split),
    )
    rows = dataset.measured(*where, of, config.results, first=first)
    return Found(rows, {name: card for name, (*_, card) in trained.items()})


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors over the denoiser's by sample count, the worst, every frame and losses.
    """
    names = [name for name in next(iter(found.rows.values())) if name != DENOISED]
    over = lambda row, name: row[name] / row[DENOISED]
    mean = lambda name: errors.geometric_mean(
        over(r, name) for r in found.rows.values()
    )
    said = ", ".join(f"{name} {mean(name):.3f}" for name in names[1:])
    answer = (
        "Relative L2 over that of the denoiser trained alone, geometric mean of "
        f"{len(found.rows)} frames: {said}."
    )
    first = errors.means(found.rows, names, lambda row: row[DENOISED], title="image")
    header = ["frame", *next(iter(found.rows.values()))]
    every = table(header, [[key, *row.values()] for key, row in found.rows.items()])
    figures: dict[str, Figure] = {"Losses against steps": curves(found.cards)}
    return Report(answer, f"{first}\n\n{every}", figures)


def _images(inputs: Inputs, y: Image) -> Inputs:
    """What a James-Stein network sees of a frame and its denoised image."""
    x, v = inputs["noisy"], inputs["variance"]
    return {"unbiased": x, "biased_a": y, "biased_b": y, "variance": v}


@functools.cache
def _compiled(function: Any) -> Any:
    """As one program for all frames of one size."""
    return jax.jit(function)


if __name__ == "__main__":
    main(Config, run, report)
