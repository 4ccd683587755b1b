"""Do trained networks beat the estimators without, on scenes unseen in training?

Every archive in the folder (`archives`), at every sample count: relative L2, less the
reference's noise, of both inputs, of the estimators without a network, and of the
networks: those that come with the package, or each run of `training.train` in RUNS by
the name of its folder. Untrained is the same network as training starts from.
"""

import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import tyro
from matplotlib.figure import Figure

from experiments.common import archives, errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.training import train
from jscomb import double_shrinkage, james_stein, progressive
from jscomb.frame import Frame
from jscomb.learning import networks, recipes
from jscomb.learning.recipes import RECIPES
from jscomb.typing import Image

INPUTS = ("path tracing", "oidn")


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        runs: folder of runs; None for the shipped networks.
        results: file that stores results as they come.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    runs: pathlib.Path | None = None
    results: pathlib.Path | None = None


def _errors(images: dict[str, Image], frame: Frame) -> dict[str, float]:
    """Return the relative L2 of each."""
    return {name: errors.relative_l2(image, frame) for name, image in images.items()}


def measure_inputs(frame: Frame) -> dict[str, float]:
    """Return errors of the inputs, and of combinations without a network.

    Args:
        frame: with the estimate "oidn", its halves and a reference.

    Returns:
        relative L2 by name.
    """
    frame = frame.normalised()
    oidn = frame.estimates["oidn"]
    x, y, v = frame.color, oidn.image, frame.variance
    pooled, robust = james_stein.smooth_variance(v), james_stein.robust_variance(v)
    images = {"path tracing": x, "oidn": y}
    images["james-stein"] = james_stein.combine(x, y, pooled)
    images["whitened"] = james_stein.combine(x, y, robust, window=7, whiten=True)
    regressed, _ = _james_stein_inputs(frame)
    star = (regressed["biased_a"] + regressed["biased_b"]) / 2
    images["y*"] = star
    images["james-stein, y*"] = james_stein.combine(x, star, pooled)
    shrunk = double_shrinkage.combine_frame(frame, oidn, stride=2)
    prior = double_shrinkage.neural_inputs(frame, oidn, stride=2)["prior"]
    images |= {"double shrinkage": shrunk.image, "its prior": prior}
    pd = RECIPES["pd"].inputs(jax.random.key(0), frame, oidn)
    mix = functools.partial(progressive.mixing, whiten=True)
    images["progressive, whitened"] = progressive.combine(**pd, mix=mix)
    return _errors(images, frame)


def _james_stein_inputs(frame: Frame) -> list[dict[str, Image]]:
    """Return NJS's inputs with the regressed image, then those with the plain one."""
    estimate = frame.estimates["oidn"]
    both = [
        james_stein.neural_inputs(jax.random.key(0), frame, estimate, choose=choose)
        for choose in ("helps", "opposite")
    ]
    plain = lambda inputs: bool(jnp.all(inputs["biased_a"] == inputs["biased_b"]))
    return sorted(both, key=plain)


class Trained(NamedTuple):
    """A network, and what its training began with."""

    method: str
    network: recipes.Network
    untrained: recipes.Network


def measure_network(frame: Frame, of: Trained) -> dict[str, float]:
    """Return errors of a network's combination, and of variants of it.

    Args:
        frame: with the estimate "oidn", its halves and a reference.
        of: the network; its method is a key of `train.ALL`.

    Returns:
        relative L2 by the variant's name, after a comma; "" for none.
    """
    method, network, _ = of
    frame, recipe = frame.normalised(), train.ALL[method]
    combine_with = jax.jit(recipe.combine)
    combine = functools.partial(combine_with, network)
    inputs = recipe.inputs(jax.random.key(0), frame, frame.estimates["oidn"])
    images = {"": combine(inputs), ", untrained": combine_with(of.untrained, inputs)}
    if method.startswith("njs"):
        regressed, plain = map(combine, _james_stein_inputs(frame))
        images |= {", always regressed": regressed, ", never regressed": plain}
    if method.startswith("pd"):
        direct = (
            progressive.direct_activation if method == "pd" else progressive.activation
        )
        for name, bound in ((", bound", True), (", no bound", False)):
            variant = functools.partial(
                progressive.combine_inputs, activate=direct, bound=bound
            )
            images[name] = jax.jit(variant)(network, inputs)
    if method == "kernels-njs":
        images[", its denoiser"] = RECIPES["kernels"].combine(network.denoiser, inputs)
    return _errors(images, frame)


def networks_of(runs: pathlib.Path | None) -> dict[str, Trained]:
    """Return the networks to measure by name.

    Args:
        runs: folder of runs; None for the shipped networks.

    Returns:
        those of finished runs.
    """
    if runs is None:
        files = [recipes.WEIGHTS / f"{name}.json" for name in RECIPES]
        return {file.stem: _trained(file) for file in files if file.exists()}
    found = {}
    for card in sorted(runs.glob("*/network.json")):
        about = json.loads(card.read_text())
        if about["steps"] == about["schedule"]["steps"]:
            found[card.parent.name] = _trained(card)
    return found | _separate(found)


def _trained(card: pathlib.Path) -> Trained:
    """Return the network of a card."""
    about = json.loads(card.read_text())
    recipe, seed = train.ALL[about["method"]], about["schedule"]["seed"]
    network = recipes.load_network(recipe, card.with_suffix(".safetensors"))
    untrained = recipe.network(jax.random.key(seed), size=about["size"])
    return Trained(about["method"], network, untrained)


def _separate(found: dict[str, Trained]) -> dict[str, Trained]:
    """Return a denoiser and a combiner that were trained apart, as a joint network."""
    parts = [found.get(f"{name}-light") for name in ("kernels", "njs-equal")]
    if None in parts:
        return {}
    both, untrained = (
        networks.Joint(jax.random.key(0), size="light") for _ in range(2)
    )
    both.denoiser, both.combiner = (part.network for part in parts if part)
    name = "kernels-light and njs-equal-light"
    return {name: Trained("kernels-njs", both, untrained)}


class Found(NamedTuple):
    """Relative L2 by name, by "frame samples"; and the losses of all runs by name."""

    rows: dict[str, dict[str, float]]
    losses: dict[str, dict[str, list]]


def run(config: Config) -> Found:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        errors, and losses where there are runs.

    Raises:
        ValueError: if the folder holds no archive.
    """
    measures: dict[str, Callable[[Frame], dict[str, float]]] = {"": measure_inputs}
    for name, network in networks_of(config.runs).items():
        measures[name] = functools.partial(measure_network, of=network)
    found = archives.measured(
        config.folder, measures, results=config.results, quick=config.quick
    )
    rows: dict[str, dict[str, float]] = {}
    for key, measured in found.items():
        frame, samples, *kind = key.split(" ")
        row = rows.setdefault(f"{frame} {samples}", {})
        row |= {" ".join(kind) + name: error for name, error in measured.items()}
    cards = sorted(config.runs.glob("*/network.json")) if config.runs else []
    losses = {c.parent.name: json.loads(c.read_text())["losses"] for c in cards}
    return Found(rows, losses)


def better(row: errors.Row) -> float:
    """Error of the better input."""
    return min(row[name] for name in INPUTS)


def summary(rows: dict[str, dict[str, float]], name: str) -> dict[str, float]:
    """Ratios to the better input.

    Args:
        rows: errors by "frame samples".
        name: of a method.

    Returns:
        geometric means by samples, and the "worst" frame.
    """
    ratios = {
        f"{samples}": [row[name] / better(row) for row in group]
        for samples, group in errors.by_samples(rows).items()
    }
    means = {samples: errors.geometric_mean(each) for samples, each in ratios.items()}
    return means | {"worst": max(map(max, ratios.values()))}


def curves(losses: dict[str, dict[str, list]]) -> Figure:
    """Training and validation losses of all runs."""
    columns = min(len(losses), 4)
    lines = -(-len(losses) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.6 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    for ax in axes.flat[len(losses) :]:
        ax.axis("off")
    for ax, (name, each) in zip(axes.flat, losses.items(), strict=False):
        train.plot_losses(ax, each, title=name)
    axes[0, 0].legend()
    return figure


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        means beside the worst frame, every frame, and the losses.
    """
    rows = found.rows
    names = list(next(iter(rows.values())))
    trained = [name for name in names if f"{name}, untrained" in names]

    def said(name: str) -> str:
        *means, worst = summary(rows, name).values()
        return f"{', '.join(f'{mean:.2f}' for mean in means)} (worst {worst:.2f})"

    each = "; ".join(
        f"{name} {said(name)}, untrained {said(f'{name}, untrained')}"
        for name in trained
    )
    answer = (
        f"At {', '.join(map(str, errors.by_samples(rows)))} samples, in relative L2 "
        f"divided by the better input's (geometric means of {len(rows)} frames in "
        f"all): {each}; the best without a network, whitened, {said('whitened')}."
    )
    cells = [[frame, *(row[n] for n in names)] for frame, row in rows.items()]
    tables = [
        errors.means(rows, names, better, title="error / better input"),
        table(["frame", *names], cells),
    ]
    figures = {"Losses against steps": curves(found.losses)} if found.losses else {}
    return Report(answer, "\n\n".join(tables), figures)


if __name__ == "__main__":
    main(Config, run, report)
