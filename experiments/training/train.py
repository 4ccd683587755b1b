"""Train one of the networks on a folder of frames.

Frames of one scene in ten are held out for validation. RUN gets the network
(`network.safetensors` with its card `network.json`), the state to resume from, the
losses and a plot of them; the same command resumes an interrupted run. `--quick` takes
a minute.
"""

import dataclasses
import json
import pathlib
import time
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes
from tqdm import tqdm

from experiments.common.command import tool
from experiments.training.ablations import ABLATIONS
from jscomb import exr, metrics
from jscomb.learning import checkpoints, recipes, training
from jscomb.learning.recipes import RECIPES
from jscomb.typing import Image, Scalar

ALL = RECIPES | ABLATIONS
QUICK = training.Schedule(steps=60, batch=4, crop=48)
SAVE_EVERY = 60.0  # seconds


@dataclasses.dataclass(frozen=True)
class Config:
    """A run.

    Attributes:
        method: whose network: njs, dsc, pd, kernels (a denoiser), kernels-njs (both,
            jointly), or an ablation: njs-equal, dsc-log, pd-quotient, pd-smape,
            pd-no-sure.
        data: folder of frames by `experiments.data.dataset`.
        out: folder of the run.
        size: light or full.
        schedule: how to train.
        validate: steps between two validations.
        quick: a short schedule of small crops.
    """

    method: tyro.conf.Positional[str]
    data: tyro.conf.Positional[pathlib.Path]
    out: pathlib.Path
    size: Literal["light", "full"] = "light"
    schedule: training.Schedule = training.Schedule()  # noqa: RUF009 (frozen)
    validate: int = 100
    quick: bool = False

    def __post_init__(self) -> None:
        """Raise for an unknown method."""
        if self.method not in ALL:
            raise ValueError(f"no method {self.method!r}; there are {', '.join(ALL)}")


def scene_of(file: pathlib.Path) -> str:
    """Return the scene that a frame shows: its name without the sample count.

    Args:
        file: of a frame.

    Returns:
        the scene.
    """
    return file.stem.rpartition("-")[0]


def split(data: pathlib.Path) -> tuple[list[pathlib.Path], list[pathlib.Path]]:
    """Return frames to train on and frames to validate on, of different scenes.

    Args:
        data: folder of frames.

    Returns:
        both lists.

    Raises:
        ValueError: if there are fewer than two scenes.
    """
    frames = sorted(data.glob("*.exr"))
    scenes = sorted({scene_of(file) for file in frames})
    if len(scenes) < 2:
        raise ValueError(f"{data} has frames of {len(scenes)} scene(s), wanted two")
    held = set(scenes[:: min(10, len(scenes))])
    return (
        [file for file in frames if scene_of(file) not in held],
        [file for file in frames if scene_of(file) in held],
    )


def prepare(method: str, frames: list[pathlib.Path]) -> training.Examples:
    """Return a recipe's inputs of normalised frames.

    Args:
        method: a key of `ALL`.
        frames: files with the estimate "oidn" and a reference; black ones are skipped.

    Returns:
        the examples.
    """
    inputs, references = [], []
    for number, file in enumerate(tqdm(frames, unit="frame", desc=f"{method} inputs")):
        frame = exr.read_frame(file)
        if frame.reference is None:
            raise ValueError(f"{file} has no reference")
        if not float(jnp.median(frame.reference.image)) > 0:
            continue  # the camera sees no light
        frame = frame.normalised()
        assert frame.reference is not None
        estimate = frame.estimates["oidn"]
        makers = filter(None, (ALL[method].inputs, ALL[method].other))
        variants = [make(jax.random.key(number), frame, estimate) for make in makers]
        inputs.append(
            {name: np.stack([v[name] for v in variants]) for name in variants[0]}
        )
        references.append(np.asarray(frame.reference.image))
    arrays = {name: np.stack([i[name] for i in inputs]) for name in inputs[0]}
    return training.Examples(
        {name: jnp.asarray(a, jnp.float32) for name, a in arrays.items()},
        jnp.asarray(np.stack(references), jnp.float32),
    )


def objective(
    method: str, *, loss: Callable[[Image, Image], Scalar] | None = None
) -> training.Objective:
    """Return the loss of a method's network on one frame.

    Args:
        method: a key of `ALL`.
        loss: of an image and a reference; None for the recipe's own.

    Returns:
        the loss of a network, inputs, a reference, and the unit to measure them in.
    """
    chosen = ALL[method]
    measure = loss or chosen.loss

    def of_frame(network, inputs, reference, unit):
        inputs = recipes.in_unit(inputs, unit)
        image = chosen.combine(network, inputs, **chosen.training)
        return measure(image, reference / unit)

    return of_frame


def run(config: Config) -> dict:
    """Train, or resume training.

    Args:
        config: the run.

    Returns:
        its card.

    Raises:
        ValueError: if the folder holds another run, or there are no frames.
    """
    schedule = QUICK if config.quick else config.schedule
    every = 10 if config.quick else config.validate
    config.out.mkdir(parents=True, exist_ok=True)
    about = {
        "method": config.method,
        "size": config.size,
        "schedule": dataclasses.asdict(schedule),
        "data": config.data.name,
    }
    history = _resume(config.out, about)
    loss = objective(config.method)
    train, held = (prepare(config.method, frames) for frames in split(config.data))
    about["frames"] = [len(train.reference), len(held.reference)]
    judge = jax.jit(lambda network: training.evaluate(loss, network, held).mean())
    network = ALL[config.method].network(
        jax.random.key(schedule.seed), size=config.size
    )
    state = training.start(network, schedule)
    if history:
        state = checkpoints.load(config.out / "state.safetensors", state)
    else:
        history = {"step": [0], "train": [None], "validation": [float(judge(network))]}
    losses, saved, since = [], time.monotonic(), time.monotonic()
    bar = tqdm(total=schedule.steps, initial=int(state.step), unit="step")
    for now, value in training.run(loss, state, train, schedule):
        losses.append(value)
        bar.update()
        step = int(now.step)
        if step % every and step != schedule.steps:
            continue
        found = float(judge(now.network))
        history["step"].append(step)
        history["train"].append(float(jnp.mean(jnp.stack(losses))))
        history["validation"].append(found)
        losses = []
        bar.set_postfix(train=history["train"][-1], validation=found)
        if time.monotonic() - saved > SAVE_EVERY or step == schedule.steps:
            saved = time.monotonic()
            _save(config.out, now, about, history)
    bar.close()
    card = json.loads((config.out / "network.json").read_text())
    network = checkpoints.load(config.out / "network.safetensors", network)
    card["relative_l2"] = relative_l2(config.method, network, held)
    _write_card(config.out, card)
    print(f"{config.out}: {(time.monotonic() - since) / 60:.1f} min", end=", ")
    print(f"relative L2 of held-out frames {card['relative_l2']:.5f}")
    return card


def plot_losses(axes: Axes, losses: dict[str, list], *, title: str) -> None:
    """Plot a run's losses against its steps.

    Args:
        axes: to draw on.
        losses: of a card.
        title: of the plot.
    """
    axes.plot(losses["step"][1:], losses["train"][1:], label="training")
    axes.plot(losses["step"], losses["validation"], label="validation")
    axes.set(xlabel="step", ylabel="loss", yscale="log", title=title)


def relative_l2(
    method: str, network: recipes.Network, held: training.Examples
) -> float:
    """Measure a network's error, to compare networks of unlike losses.

    Args:
        method: a key of `ALL`.
        network: of that method.
        held: frames.

    Returns:
        relative L2, the geometric mean over the frames.
    """
    images = objective(method, loss=metrics.rel_l2)
    return float(jnp.exp(jnp.log(training.evaluate(images, network, held)).mean()))


def _resume(out: pathlib.Path, about: dict) -> dict:
    """Return the losses of an existing run; none of a new one."""
    card = out / "network.json"
    if not card.exists():
        return {}
    there = json.loads(card.read_text())
    if any(there.get(key) != value for key, value in about.items()):
        raise ValueError(f"{out} holds another run: choose another --out")
    return there["losses"]


def _save(out: pathlib.Path, state: training.State, about: dict, losses: dict) -> None:
    """Write the network, its card, the state to resume from, and a plot."""
    checkpoints.save(out / "state.safetensors", state)
    checkpoints.save(out / "network.safetensors", state.network)
    _write_card(out, about | {"steps": int(state.step), "losses": losses})
    figure, axes = plt.subplots(figsize=(6, 4))
    plot_losses(axes, losses, title=about["method"])
    axes.legend()
    figure.savefig(out / "losses.png", dpi=120)
    plt.close(figure)


def _write_card(out: pathlib.Path, card: dict) -> None:
    """Replace the card completely or not at all."""
    temporary = out / "network.json.tmp"
    temporary.write_text(json.dumps(card, indent=1))
    temporary.replace(out / "network.json")


if __name__ == "__main__":
    tool(Config, run)
