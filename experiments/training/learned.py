"""Do trained networks beat themselves untrained, and the forms without a network?

On every frame of a split of `experiments.data.dataset` that took no part in training:
relative L2, less the reference's noise, of the inputs, of each network, of the same
network with the parameters that its training began with, and of the estimator without
a network on the same inputs. Networks are those that come with the package, or of each
run of `training.train` in RUNS by the name of its folder.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import tyro
from matplotlib.figure import Figure

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.data import dataset
from experiments.training.train import ALL
from jscomb import exr
from jscomb.cli import with_bases
from jscomb.learning import recipes
from jscomb.learning.examples import draw_losses
from jscomb.typing import Image

TRAINED, UNTRAINED, WITHOUT = "trained", "untrained", "without a network"
GAIN, MARGIN, WORST = 0.9, 0.95, 1.05  # what a network that ships has to reach


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of `experiments.data.dataset`.
        runs: folder of runs; None for the shipped networks.
        split: test, or validate for choices.
        results: file that stores results as they come.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    runs: pathlib.Path | None = None
    split: str = "test"
    results: pathlib.Path | None = None


class Trained(NamedTuple):
    """A network, and what its training began with."""

    method: str
    network: recipes.Network
    untrained: recipes.Network


def load(path: pathlib.Path) -> Trained:
    """Return the network of a file, and itself untrained.

    Args:
        path: safetensors file beside its card.

    Returns:
        both.
    """
    card = recipes.read_card(path)
    recipe, seed = ALL[card["method"]], card["schedule"]["seed"]
    network = recipes.load_network(recipe, path)
    options = recipes.options_of(card)
    untrained = recipe.make(jax.random.key(seed), **options)
    return Trained(card["method"], network, untrained)


def networks_of(folder: pathlib.Path | None) -> dict[str, Trained]:
    """Return the networks to measure by name.

    Args:
        folder: of runs; None for the shipped networks.

    Returns:
        the networks.
    """
    if folder is None:
        found = sorted(recipes.WEIGHTS.glob("*.safetensors"))
        return {file.stem: load(file) for file in found}
    found = sorted(folder.glob("*/network.safetensors"))
    return {file.parent.name: load(file) for file in found}


def measure(path: pathlib.Path, trained: Mapping[str, Trained]) -> dict[str, float]:
    """Return the errors of a frame's images.

    Args:
        path: of the frame.
        trained: networks by name.

    Returns:
        relative L2 of "path tracing" and the frame's estimates, and of "NAME, KIND" for
        each network and kind, at least a fiftieth of the better input's.
    """
    frame = exr.read_frame(path).normalised()
    images = {"path tracing": frame.color}
    images |= {name: each.image for name, each in frame.estimates.items()}
    for name, (method, network, untrained) in trained.items():
        recipe = ALL[method]
        if recipe.estimate not in frame.estimates:
            continue
        estimate, seen = frame.estimates[recipe.estimate], with_bases(recipe, frame)
        inputs = recipe.inputs(jax.random.key(0), seen, estimate)
        combine = _compiled(recipe.combine)
        images[f"{name}, {TRAINED}"] = combine(network, inputs)
        images[f"{name}, {UNTRAINED}"] = combine(untrained, inputs)
        if recipe.without:
            images[f"{name}, {WITHOUT}"] = _compiled(recipe.without)(inputs)
    return {name: errors.relative_l2(image, frame) for name, image in images.items()}


@functools.cache
def _compiled(function: Callable[..., Image]) -> Callable[..., Image]:
    """As one program for all frames of one size."""
    return jax.jit(function)


class Found(NamedTuple):
    """What was measured.

    Attributes:
        rows: relative L2 by name, by "view samples".
        combines: the estimate that each network combines.
        cards: of the networks, by name.
    """

    rows: dict[str, dict[str, float]]
    combines: dict[str, str]
    cards: dict[str, dict[str, Any]]


def run(config: Config) -> Found:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors and cards.

    Raises:
        ValueError: if there are no frames.
    """
    trained = networks_of(config.runs)
    of, first = functools.partial(measure, trained=trained), 2 if config.quick else None
    where = config.folder, config.split
    rows = dataset.measured(*where, of, config.results, first=first)
    combines = {name: ALL[each.method].estimate for name, each in trained.items()}
    where = recipes.WEIGHTS if config.runs is None else config.runs
    file = "{}.safetensors" if config.runs is None else "{}/network.safetensors"
    cards = {name: recipes.read_card(where / file.format(name)) for name in trained}
    return Found(rows, combines, cards)


def ratios(found: Found, name: str, kind: str) -> dict[str, list[float]]:
    """Return errors over the better input's, by samples.

    Args:
        found: by `run`.
        name: of a network.
        kind: trained, untrained or without a network.

    Returns:
        a list of frames for each sample count.
    """
    estimate, of = found.combines[name], f"{name}, {kind}"
    better = lambda row: min(row["path tracing"], row[estimate])
    rows = {key: row for key, row in found.rows.items() if of in row}
    return {
        str(samples): [max(row[of] / better(row), 0.02) for row in group]
        for samples, group in errors.by_samples(rows).items()
    }


def summary(found: Found, name: str, kind: str) -> dict[str, float]:
    """Return geometric means of `ratios` by samples, "all", and the "worst".

    Args:
        found: by `run`.
        name: of a network.
        kind: as of `ratios`.

    Returns:
        the means.
    """
    each = ratios(found, name, kind)
    every = [ratio for group in each.values() for ratio in group]
    means = {samples: errors.geometric_mean(group) for samples, group in each.items()}
    return means | {"all": errors.geometric_mean(every), "worst": max(every)}


def kinds(found: Found, name: str) -> list[str]:
    """Return the kinds that were measured of a network.

    Args:
        found: by `run`.
        name: of a network.

    Returns:
        trained, untrained and, where there is one, without a network.
    """
    named = {key for row in found.rows.values() for key in row}
    return [k for k in (TRAINED, UNTRAINED, WITHOUT) if f"{name}, {k}" in named]


def verdict(found: Found, name: str) -> dict[str, bool]:
    """Return which promises of a shipped network hold.

    Args:
        found: by `run`.
        name: of a network.

    Returns:
        by the promise.
    """
    means = {kind: summary(found, name, kind) for kind in kinds(found, name)}
    trained, untrained = means[TRAINED], means[UNTRAINED]
    counts = [key for key in trained if key not in ("all", "worst")]
    said = {
        "10 % below untrained": trained["all"] <= GAIN * untrained["all"],
        "below untrained at every count": all(
            trained[n] < untrained[n] for n in counts
        ),
        "worst at most 1.05": trained["worst"] <= WORST,
    }
    if WITHOUT in means:
        said["5 % below the form without a network"] = (
            trained["all"] <= MARGIN * means[WITHOUT]["all"]
        )
    return said


def curves(cards: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Plot training and validation losses of all runs."""
    columns = min(len(cards), 4)
    lines = -(-len(cards) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.6 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    for ax in axes.flat[len(cards) :]:
        ax.axis("off")
    for ax, (name, card) in zip(axes.flat, cards.items(), strict=False):
        draw_losses(ax, card, title=name)
    axes[0, 0].legend()
    return figure


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        means beside the worst frame, promises, every frame, and the losses.
    """
    cells, answers = [], []
    measured = [name for name in found.combines if kinds(found, name)]
    for name in measured:
        means = {kind: summary(found, name, kind) for kind in kinds(found, name)}
        cells += [[name, kind, *each.values()] for kind, each in means.items()]
        held = verdict(found, name)
        missed = [promise for promise, kept in held.items() if not kept]
        of = means[TRAINED]
        others = [f"{k} {m['all']:.3f}" for k, m in means.items() if k != TRAINED]
        said = f"misses: {', '.join(missed)}" if missed else "keeps every promise"
        first = f"{name} {of['all']:.3f} (worst {of['worst']:.2f})"
        answers.append(f"{', '.join([first, *others])}; {said}")
    counts = list(summary(found, measured[0], TRAINED))
    answer = (
        "Relative L2 over the better of path tracing and the estimate, geometric mean "
        f"of {len(found.rows)} frames: {'. '.join(answers)}."
    )
    first = table(["network", "kind", *counts], cells)
    names = list(dict.fromkeys(name for row in found.rows.values() for name in row))
    every = [
        [frame, *(row.get(n, "") for n in names)] for frame, row in found.rows.items()
    ]
    body = f"{first}\n\n{table(['frame', *names], every)}"
    return Report(answer, body, {"Losses against steps": curves(found.cards)})


if __name__ == "__main__":
    main(Config, run, report)
