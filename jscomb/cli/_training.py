"""`jscomb train`: a network on a folder of frames.

RUN gets `network.safetensors` of the step that validated best and its card
`network.json`, the state to resume from, and a plot of the losses; inputs, which take
long to make, are kept in `inputs/`.
"""

import dataclasses
import functools
import json
import pathlib
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from jscomb import exr
from jscomb.frame import Frame
from jscomb.methods import with_inputs

if TYPE_CHECKING:  # flax is slow to import
    from jscomb.learning import training
    from jscomb.learning.examples import Judged
    from jscomb.learning.recipes import Recipe

_SAVE_EVERY = 60.0  # seconds


@dataclasses.dataclass(frozen=True)
class Run:
    """What is trained, and how.

    Attributes:
        method: name of the recipe.
        size: of the network, light or full.
        steps: of the optimiser.
        batch: crops a step.
        crop: width of a crop in pixels.
        rate: learning rate at the peak of the cycle.
        seed: of the parameters and of all draws.
        piece: width and height in pixels of the pieces that frames are cut into.
        validate: steps between two validations.
    """

    method: str
    size: Literal["light", "full"] = "full"
    steps: int = 8000
    batch: int = 8
    crop: int = 64
    rate: float = 1e-3
    seed: int = 0
    piece: int = 128
    validate: int = 250

    def schedule(self) -> "training.Schedule":
        """Of the optimiser."""
        from jscomb.learning.training import Schedule

        return Schedule(self.steps, self.batch, self.crop, self.rate, seed=self.seed)


def train(
    method: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="METHOD")],
    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    /,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    validation: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
    size: Literal["light", "full"] = Run.size,
    steps: int = Run.steps,
    batch: int = Run.batch,
    crop: int = Run.crop,
    rate: float = Run.rate,
    seed: int = Run.seed,
) -> None:
    """Train a method's network on frames; resumes if interrupted.

    FOLDER holds frames (EXR) with references, as `jscomb render --reference-spp` writes
    them, or with four sub-buffers, of which two are then the target of the other two;
    or, apart, the folders `train` and `validate`. OUT gets the network of the step that
    is best on the frames it is not trained on, its card, the losses and their plot.

    Args:
        method: njs, dsc, dsc-photons, pd, neural-ensemble, kernels (a denoiser) or
            kernels-njs (a denoiser and its combiner, jointly).
        data: folder of frames.
        out: folder of the run.
        validation: folder of frames of other scenes to validate on.
        size: of the network; light takes about a third of the time.
        steps: of the optimiser.
        batch: crops a step.
        crop: width of a crop in pixels.
        rate: learning rate at the peak of the cycle.
        seed: of the parameters and of all draws.
    """
    from jscomb.learning.recipes import RECIPES

    if method not in RECIPES:
        raise ValueError(
            f"no method {method!r} to train; there are {', '.join(RECIPES)}"
        )
    piece = max(crop, Run.piece)
    run = Run(method, size, steps, batch, crop, rate, seed, piece)
    card = train_files(run, RECIPES[method], data, out, validation=validation)
    best, untrained = (card["validation"][kind] for kind in ("best", "untrained"))
    print(
        f"wrote {out / 'network.safetensors'}: step {card['best_step']}, relative L2 "
        f"over the better input {best['all']:.3f} (worst {best['worst']:.2f}) on "
        f"{card['validate']['frames']} frames of other scenes; untrained "
        f"{untrained['all']:.3f}"
    )


def train_files(
    run: Run,
    recipe: "Recipe",
    data: pathlib.Path,
    out: pathlib.Path,
    *,
    validation: pathlib.Path | None = None,
) -> dict[str, Any]:
    """Train, or resume training.

    Args:
        run: what is trained, and how.
        recipe: of the network.
        data: folder of frames, as of `split_files`.
        out: folder of the run; made if it is missing.
        validation: folder of frames to validate on, as of `split_files`.

    Returns:
        the card of the step that validated best.

    Raises:
        ValueError: if the folder holds another run, or the frames lack what is needed.
    """
    from jscomb.learning import checkpoints, examples, training

    files, held_files = split_files(data, validation)
    about = _about(run, recipe, files, held_files)
    card = _resume(out, about)
    if not card:
        for each in (files, held_files):
            check_files(each, piece=run.piece)
    out.mkdir(parents=True, exist_ok=True)
    made = functools.partial(prepare, recipe, cache=out / "inputs", piece=run.piece)
    held, drawn = made(held_files, variants=False), made(files).examples

    @jax.jit
    def ratios(network: Any) -> jax.Array:
        return examples.validate(recipe, network, held)

    judge = lambda network: examples.summary(ratios(network), held.samples)
    schedule, best = run.schedule(), out / "network.safetensors"
    network = recipe.make(jax.random.key(run.seed), size=run.size)
    state = training.start(network, schedule)
    if card:
        state = checkpoints.load(out / "state.safetensors", state)
    else:
        card = _first_card(about, judge(network))
        checkpoints.save(best, network)
    bar = tqdm(total=run.steps, initial=int(state.step), unit="step", disable=None)
    losses, saved = [], time.monotonic()
    steps = training.run(examples.objective(recipe), state, drawn, schedule)
    for state, value in steps:
        losses.append(value)
        bar.update()
        step = int(state.step)
        if step % run.validate and step != run.steps:
            continue
        found = judge(state.network)
        if _note(card, step, float(jnp.mean(jnp.stack(losses))), found):
            checkpoints.save(best, state.network)
        losses = []
        bar.set_postfix(validation=found["all"], best=card["best_step"])
        if time.monotonic() - saved > _SAVE_EVERY or step == run.steps:
            saved = time.monotonic()
            checkpoints.save(out / "state.safetensors", state)
            _write_card(out, card)
            _plot(card, out / "losses.png")
    bar.close()
    return card


def split_files(
    data: pathlib.Path, validation: pathlib.Path | None = None
) -> tuple[list[pathlib.Path], list[pathlib.Path]]:
    """Return the frames to train on, and those to validate on.

    Args:
        data: folder of frames (EXR). If it has the folders `train` and `validate`,
            these; else a tenth of its frames are validated on. Frames whose names
            differ in a last number only, `NAME-SAMPLES.exr`, are of one scene, which is
            never on both sides.
        validation: folder of frames to validate on, instead.

    Returns:
        both lists of files.

    Raises:
        ValueError: if there are no frames, or none is left to train or validate on.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("a-4", "a-8", "b-4", "c-4"):
        ...         pathlib.Path(folder, f"{name}.exr").touch()
        ...     train, held = split_files(pathlib.Path(folder))
        ...     print([file.stem for file in train], [file.stem for file in held])
        ['b-4', 'c-4'] ['a-4', 'a-8']
    """
    listed = lambda folder: sorted(folder.glob("[!.]*.exr"))  # none half written
    if validation is None and (data / "train").is_dir():
        data, validation = data / "train", data / "validate"
    files = listed(data)
    if not files:
        raise ValueError(f"{data}: no frames (*.exr) there to train on")
    if validation is not None:
        held = listed(validation)
        if not held:
            raise ValueError(f"{validation}: no frames (*.exr) there to validate on")
        return files, held
    scenes = sorted({_scene(file) for file in files})
    if len(scenes) < 2:
        raise ValueError(
            f"{data}: frames of one scene only, {scenes[0]}; validation needs another "
            "(or --validation FOLDER)"
        )
    apart = set(scenes[:: min(10, len(scenes))])
    held = [file for file in files if _scene(file) in apart]
    return [file for file in files if file not in held], held


def prepare(
    recipe: "Recipe",
    files: Sequence[pathlib.Path],
    cache: pathlib.Path,
    *,
    piece: int = Run.piece,
    variants: bool = True,
) -> "Judged":
    """Return what a network sees of frames, cut into pieces of one size.

    Frames without light are left out. Resumes an interrupted call.

    Args:
        recipe: of the network.
        files: of frames, as of `learning.examples.make_inputs`.
        cache: folder for each frame's inputs.
        piece: width and height of the pieces in pixels.
        variants: all of the recipe's inputs, not only the first.

    Returns:
        the pieces.

    Raises:
        ValueError: if a frame lacks what is needed; names the file.
    """
    from jscomb.learning import examples

    cache.mkdir(parents=True, exist_ok=True)
    found = []
    for file in tqdm(files, unit="frame", desc="inputs", leave=False, disable=None):
        kept = cache / f"{file.stem}.npz"
        if not kept.exists():
            frame = exr.read_frame(file)
            try:
                frame = with_bases(recipe, examples.with_target(frame))
                made: Any = examples.make_inputs(recipe, frame, variants=variants)
            except ValueError as error:
                raise ValueError(f"{file}: {error}") from None
            temporary = kept.with_suffix(".tmp.npz")
            np.savez(temporary, **made)
            temporary.replace(kept)
        with np.load(kept) as data:
            found += examples.pieces(dict(data), piece)
    if not found:
        raise ValueError(f"no frame of {piece} x {piece} pixels or more with light")
    return examples.stack_examples(found)


def check_files(files: Sequence[pathlib.Path], *, piece: int = 1) -> None:
    """Raise if frames cannot be trained on, before anything is computed.

    Args:
        files: of frames.
        piece: width and height in pixels that one of them must have.

    Raises:
        ValueError: if one has no target, or all are too small; names the file.
    """
    from jscomb.learning import examples

    largest = 0
    for file in tqdm(files, unit="frame", desc="check", leave=False, disable=None):
        try:
            frame = examples.with_target(exr.read_frame(file))
        except ValueError as error:
            named = str(error).startswith(str(file))
            raise ValueError(str(error) if named else f"{file}: {error}") from None
        largest = max(largest, min(frame.color.shape[:2]))
    if largest < piece:
        raise ValueError(
            f"{files[0].parent}: no frame of {piece}x{piece} pixels or more (--crop)"
        )


def with_bases(recipe: "Recipe", frame: Frame) -> Frame:
    """Return a frame with the estimates that a recipe's inputs are made of.

    Args:
        recipe: of a network.
        frame: in any unit.

    Returns:
        the frame, normalised.
    """
    return with_inputs(jax.random.key(0), frame.normalised(), recipe.bases)


def _scene(file: pathlib.Path) -> str:
    """The scene that a frame shows: its name without the sample count."""
    name, _, samples = file.stem.rpartition("-")
    return name if name and samples.isdigit() else file.stem


def _about(
    run: Run,
    recipe: "Recipe",
    files: Iterable[pathlib.Path],
    held: Iterable[pathlib.Path],
) -> dict[str, Any]:
    """What a run's card says before its first step."""

    def frames(files: Iterable[pathlib.Path]) -> dict[str, Any]:
        files = list(files)
        scenes = sorted({_scene(file) for file in files})
        return {"frames": len(files), "scenes": scenes}

    plain = lambda option: getattr(option, "_asdict", lambda: option)()
    options = {name: plain(option) for name, option in recipe.options.items()}
    loss = getattr(recipe.loss, "__name__", "a loss of the mean of halves")
    return {
        "method": run.method,
        "network": {"size": run.size, **options},
        "combines": recipe.estimate,
        "loss": loss,
        "schedule": dataclasses.asdict(run.schedule()),
        "piece": run.piece,
        "train": frames(files),
        "validate": frames(held),
    }


def _first_card(about: dict[str, Any], untrained: dict[str, float]) -> dict[str, Any]:
    """The card before the first step."""
    losses = {"step": [0], "train": [None], "validation": [untrained["all"]]}
    what = "relative L2 over the better of the image and the estimate, geometric mean"
    judged = {"what": what, "untrained": untrained, "best": untrained}
    return about | {"validation": judged, "best_step": 0, "losses": losses}


def _note(card: dict[str, Any], step: int, loss: float, found: dict) -> bool:
    """Add a validation to the card, and return whether it is the best so far."""
    for name, value in {
        "step": step,
        "train": loss,
        "validation": found["all"],
    }.items():
        card["losses"][name].append(value)
    better = found["all"] < card["validation"]["best"]["all"]
    if better:
        card["validation"]["best"], card["best_step"] = found, step
    return better


def _resume(out: pathlib.Path, about: dict[str, Any]) -> dict[str, Any]:
    """The card of an existing run; empty for a new one."""
    card = out / "network.json"
    if not card.exists():
        return {}
    there = json.loads(card.read_text())
    for name, value in json.loads(json.dumps(about)).items():
        if there.get(name) != value:
            raise ValueError(
                f"{out}: holds a run of another {name}: choose another folder"
            )
    return there


def _write_card(out: pathlib.Path, card: dict[str, Any]) -> None:
    """Replace the card completely or not at all."""
    temporary = out / "network.json.tmp"
    temporary.write_text(json.dumps(card, indent=1) + "\n")
    temporary.replace(out / "network.json")


def _plot(card: Mapping[str, Any], out: pathlib.Path) -> None:
    """Write a picture of the losses."""
    from matplotlib.figure import Figure  # slow to import

    from jscomb.learning.examples import draw_losses

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    draw_losses(axes, card, title=card["method"])
    axes.legend()
    figure.savefig(out, dpi=120)
