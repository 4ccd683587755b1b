"""Do trained networks beat the estimators without, on scenes unseen in training?

    python -m experiments.training.learned FOLDER --runs RUNS --results FILE.json

Every archive in the folder (`archives`), at every sample count: relative L2,
corrected for the reference's noise, of both inputs, of the estimators without a
network, and of the networks: those that come with the package, or each run of
`training.train` in RUNS by the name of its folder. Then the geometric mean over the
frames of the ratio to the better of the two inputs, and the worst frame.
"""

import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro

from experiments.common import archives
from experiments.training import train
from jscomb import double_shrinkage, james_stein, progressive
from jscomb.frame import Frame
from jscomb.learning import networks, recipes
from jscomb.learning.recipes import RECIPES
from jscomb.metrics import rel_l2
from jscomb.typing import Image

INPUTS = ("path tracing", "oidn")


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        runs: folder of runs; None for the shipped networks.
        results: file that stores results as they come.
        curves: picture of all runs' losses to write.
        quick: only the first archive, at its minimum sample count.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    runs: pathlib.Path | None = None
    results: pathlib.Path | None = None
    curves: pathlib.Path | None = None
    quick: bool = False


def _errors(images: dict[str, Image], frame: Frame) -> dict[str, float]:
    """Return the relative L2 of each."""
    assert frame.reference is not None
    r, noise = frame.reference
    error = lambda image: float(rel_l2(image, r, half_difference=noise))
    return {name: error(image) for name, image in images.items()}


def measure_untrained(frame: Frame) -> dict[str, float]:
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


def measure_network(
    frame: Frame, method: str, network: recipes.Network
) -> dict[str, float]:
    """Return errors of a network's combination, and of variants of it.

    Args:
        frame: with the estimate "oidn", its halves and a reference.
        method: a key of `train.ALL`.
        network: of that method.

    Returns:
        relative L2 by the variant's name, after a comma; "" for none.
    """
    frame, recipe = frame.normalised(), train.ALL[method]
    combine = jax.jit(functools.partial(recipe.combine, network))
    inputs = recipe.inputs(jax.random.key(0), frame, frame.estimates["oidn"])
    images = {"": combine(inputs)}
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


def networks_of(
    runs: pathlib.Path | None,
) -> dict[str, tuple[str, recipes.Network]]:
    """Return method and network by name.

    Args:
        runs: folder of runs; None for the shipped networks.

    Returns:
        those of finished runs.
    """
    if runs is None:
        names = [file.stem for file in recipes.WEIGHTS.glob("*.safetensors")]
        return {
            name: (name, recipes.shipped(name)) for name in RECIPES if name in names
        }
    found = {}
    for card in sorted(runs.glob("*/network.json")):
        about = json.loads(card.read_text())
        if about["steps"] == about["schedule"]["steps"]:
            path = card.with_name("network.safetensors")
            network = recipes.load_network(train.ALL[about["method"]], path)
            found[card.parent.name] = about["method"], network
    return found | _separate(found)


def _separate(
    found: dict[str, tuple[str, recipes.Network]],
) -> dict[str, tuple[str, recipes.Network]]:
    """Return a denoiser and a combiner that were trained apart, as a joint network."""
    parts = [found.get(f"{name}-light") for name in ("kernels", "njs-equal")]
    if None in parts:
        return {}
    both = networks.Joint(jax.random.key(0), size="light")
    both.denoiser, both.combiner = (part[1] for part in parts if part)
    return {"kernels-light and njs-equal-light": ("kernels-njs", both)}


def run(config: Config) -> dict[tuple[str, int], dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        relative L2 by name, by name of the frame and sample count.

    Raises:
        ValueError: if the folder holds no archive.
    """
    measures: dict[str, Callable[[Frame], dict[str, float]]] = {"": measure_untrained}
    for name, (method, network) in networks_of(config.runs).items():
        measures[name] = functools.partial(
            measure_network, method=method, network=network
        )
    found = archives.measured(
        config.folder, measures, results=config.results, quick=config.quick
    )
    rows: dict[tuple[str, int], dict[str, float]] = {}
    for key, errors in found.items():
        frame, samples, *kind = key.split(" ")
        row = rows.setdefault((frame, int(samples)), {})
        row |= {" ".join(kind) + name: error for name, error in errors.items()}
    return rows


def summary(
    rows: dict[tuple[str, int], dict[str, float]],
) -> dict[str, dict[str, float]]:
    """Return ratios to the better input: geometric means by samples, and the worst.

    Args:
        rows: by `run`.

    Returns:
        numbers by sample count and "worst", by name.
    """
    table: dict[str, dict[str, float]] = {}
    for name in next(iter(rows.values())):
        ratios = {
            key: row[name] / min(row[i] for i in INPUTS) for key, row in rows.items()
        }
        column = {}
        for samples in sorted({s for _, s in rows}):
            logs = [np.log(r) for (_, s), r in ratios.items() if s == samples]
            column[str(samples)] = float(np.exp(np.mean(logs)))
        table[name] = column | {"worst": max(ratios.values())}
    return table


def plot_curves(runs: pathlib.Path, out: pathlib.Path) -> None:
    """Plot training and validation losses of all runs.

    Args:
        runs: folder of runs.
        out: picture to write.
    """
    cards = {f.parent.name: f for f in sorted(runs.glob("*/network.json"))}
    columns = min(len(cards), 4)
    lines = -(-len(cards) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.2 * columns, 2.6 * lines), squeeze=False
    )
    for ax in axes.flat[len(cards) :]:
        ax.axis("off")
    for ax, (name, card) in zip(axes.flat, cards.items(), strict=False):
        train.plot_losses(ax, json.loads(card.read_text())["losses"], title=name)
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(out, dpi=110)
    plt.close(figure)


def main() -> None:
    """Print both tables."""
    config = tyro.cli(Config, description=__doc__)
    if config.curves and config.runs:
        plot_curves(config.runs, config.curves)
    rows = run(config)
    for name, column in summary(rows).items():
        numbers = " | ".join(f"{value:.3f}" for value in column.values())
        print(f"| {name} | {numbers} |")
    names = list(next(iter(rows.values())))
    print("| frame | " + " | ".join(names) + " |")
    for (frame, samples), row in rows.items():
        print(f"| {frame} {samples} |", end="")
        print("".join(f" {row[name]:.5f} |" for name in names))


if __name__ == "__main__":
    main()
