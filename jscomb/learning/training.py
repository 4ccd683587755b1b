"""Training: draw crops, lower a loss by Adam under a one-cycle schedule.

A run is a frozen configuration. Step k draws with the key k of the seed, so a run that
is resumed from a saved state equals one without interruption.

Images [H,W,C], linear radiance, normalised.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float

from jscomb.typing import Image, Key, Scalar

__all__ = ["Crop", "Examples", "Schedule", "State", "draw", "evaluate", "run", "start"]

Network = Any  # a pytree of parameters that can be called
Halves = Float[Array, "2 h w c"]
Objective = Callable[[Network, dict[str, Image], Halves, Scalar], Scalar]


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How to train.

    Attributes:
        steps: of the optimiser.
        batch: crops a step.
        crop: width and height of a crop in pixels.
        rate: learning rate at the peak of the cycle.
        jitter: the unit of radiance is drawn from 2^-jitter to 2^jitter.
        seed: of the parameters and of all draws.
    """

    steps: int = 2000
    batch: int = 12
    crop: int = 64
    rate: float = 1e-3
    jitter: float = 1.0
    seed: int = 0

    def optimiser(self) -> optax.GradientTransformation:
        """Return Adam with gradients of norm one.

        Fireflies make norms differ from batch to batch, by four decades as the
        ensemble's network begins; Adam would remember the largest for long.
        """
        rate = optax.cosine_onecycle_schedule(self.steps, self.rate)
        return optax.chain(optax.normalize_by_update_norm(), optax.adam(rate))


class Examples(NamedTuple):
    """N frames to learn from, of one size.

    Attributes:
        inputs: of a recipe, normalised, [N,V,H,W,C] each; V variants of each frame.
        halves: of the references, normalised radiance, [N,2,H,W,3].
        weight: of the loss of each variant, [N,V].
    """

    inputs: dict[str, Float[Array, "n v h w _"]]
    halves: Float[Array, "n 2 h w c"]
    weight: Float[Array, "n v"]


class Crop(NamedTuple):
    """A part of a frame to learn from.

    Attributes:
        inputs: of a recipe, [H,W,C] each.
        halves: of the reference, [2,H,W,3].
        unit: of radiance, to measure both in.
        weight: of the loss.
    """

    inputs: dict[str, Image]
    halves: Halves
    unit: Scalar
    weight: Scalar


class State(NamedTuple):
    """The state of a run.

    Attributes:
        network: its parameters.
        optimiser: Adam's moments.
        step: number of steps done.
    """

    network: Network
    optimiser: optax.OptState
    step: Array


def start(network: Network, schedule: Schedule) -> State:
    """Return the state before the first step.

    Args:
        network: initial parameters.
        schedule: how to train.

    Returns:
        the state.

    Example:
        >>> state = start({"gain": jnp.ones(())}, Schedule(steps=10))
        >>> print(state.step, state.network["gain"])
        0 1.0
    """
    optimiser = schedule.optimiser().init(network)
    return State(network, optimiser, jnp.zeros((), jnp.int32))


def run(
    objective: Objective, state: State, examples: Examples, schedule: Schedule
) -> Iterator[tuple[State, Scalar]]:
    """Train from a state to the end of the schedule.

    Args:
        objective: loss of a network, the inputs and the reference's halves of a crop,
            and the unit of radiance to measure both in.
        state: to start from.
        examples: to draw crops from.
        schedule: how to train.

    Yields:
        the state after each step, and the loss of its batch.

    Raises:
        ValueError: if the crops are larger than the frames.

    Example:
        >>> x = jnp.ones((1, 1, 4, 4, 3))
        >>> r = 2 * jnp.ones((1, 2, 4, 4, 3))
        >>> examples = Examples({"x": x}, r, jnp.ones((1, 1)))
        >>> def loss(gain, inputs, halves, unit):
        ...     return jnp.mean((gain * inputs["x"] - halves[0]) ** 2)
        >>> schedule = Schedule(steps=200, batch=1, crop=2, rate=0.1)
        >>> first = start(jnp.ones(()), schedule)
        >>> *_, (last, value) = run(loss, first, examples, schedule)
        >>> print(f"{last.step} {last.network:.2f}")
        200 2.00
    """
    size = examples.halves.shape[2:4]
    if schedule.crop > min(size):
        raise ValueError(f"crops of {schedule.crop} do not fit frames of {size}")
    optimiser = schedule.optimiser()
    seed = jax.random.key(schedule.seed)

    @jax.jit
    def step(state: State, examples: Examples) -> tuple[State, Scalar]:
        """Take one step of the optimiser."""
        keys = jax.random.split(jax.random.fold_in(seed, state.step), schedule.batch)
        of_network = lambda network: _batch_loss(
            objective, network, keys, examples, schedule
        )
        value, gradient = jax.value_and_grad(of_network)(state.network)
        with jax.numpy_dtype_promotion("standard"):  # optax counts in integers
            updates, moments = optimiser.update(
                gradient, state.optimiser, state.network
            )
        network = optax.apply_updates(state.network, updates)
        return State(network, moments, state.step + 1), value

    while state.step < schedule.steps:
        state, value = step(state, examples)
        yield state, value


def evaluate(
    objective: Objective, network: Network, examples: Examples
) -> Float[Array, " n"]:
    """Return the loss of every whole frame in its first variant, in a unit of one.

    Args:
        objective: as for `run`.
        network: to evaluate.
        examples: N frames.

    Returns:
        the losses, shape [N].

    Example:
        >>> x = jnp.ones((2, 1, 4, 4, 3))
        >>> r = 2 * jnp.ones((2, 2, 4, 4, 3))
        >>> examples = Examples({"x": x}, r, jnp.ones((2, 1)))
        >>> def loss(gain, inputs, halves, unit):
        ...     return jnp.mean((gain * inputs["x"] - halves[0]) ** 2)
        >>> print(evaluate(loss, jnp.array(1.5), examples))
        [0.25 0.25]
    """
    one = jnp.ones((), examples.halves.dtype)
    first = {name: array[:, 0] for name, array in examples.inputs.items()}
    of_frame = lambda frame: objective(network, frame[0], frame[1], one)
    return lax.map(of_frame, (first, examples.halves), batch_size=4)


def draw(key: Key, examples: Examples, schedule: Schedule) -> Crop:
    """Draw a crop of a frame, with random flips, transposition and order of channels.

    Args:
        key: a typed key.
        examples: frames.
        schedule: sets the crop's size and the range of the unit.

    Returns:
        the crop.

    Example:
        >>> x, schedule = jnp.ones((2, 2, 8, 8, 3)), Schedule(crop=4)
        >>> examples = Examples({"x": x}, x, jnp.ones((2, 2)))
        >>> cut = jax.jit(draw, static_argnames="schedule")
        >>> crop = cut(jax.random.key(0), examples, schedule=schedule)
        >>> print(crop.inputs["x"].shape, crop.halves.shape)
        (4, 4, 3) (2, 4, 4, 3)
    """
    which, variant, corner, turns, colours, unit = jax.random.split(key, 6)
    frames, _, height, width, _ = examples.halves.shape
    frame = jax.random.randint(which, (), 0, frames)
    size = schedule.crop
    ends = jnp.array([height - size + 1, width - size + 1])
    row, column = jax.random.randint(corner, (2,), 0, ends)
    flip_rows, flip_columns, transposed = jax.random.bernoulli(turns, shape=(3,))
    order = jax.random.permutation(colours, 3)
    variants = next(iter(examples.inputs.values())).shape[1]
    way = jax.random.randint(variant, (), 0, variants)

    def cut(array: Array) -> Array:
        """A frame's images at the place, [V,size,size,C]."""
        v, c = array.shape[1], array.shape[-1]
        at = (frame, jnp.zeros_like(row), row, column, jnp.zeros_like(row))
        image = lax.dynamic_slice(array, at, (1, v, size, size, c))[0]
        image = jnp.where(flip_rows, image[:, ::-1], image)
        image = jnp.where(flip_columns, image[:, :, ::-1], image)
        image = jnp.where(transposed, image.swapaxes(1, 2), image)
        return image[..., order] if c == 3 else image

    inputs = {name: cut(array)[way] for name, array in examples.inputs.items()}
    off = jax.random.uniform(unit, (), examples.halves.dtype, -1.0, 1.0)
    unit_drawn = 2 ** (schedule.jitter * off)
    return Crop(inputs, cut(examples.halves), unit_drawn, examples.weight[frame, way])


def _batch_loss(
    objective: Objective,
    network: Network,
    keys: Array,
    examples: Examples,
    schedule: Schedule,
) -> Scalar:
    """Return the mean loss of one crop a key."""

    def one(key: Key) -> Scalar:
        crop = draw(key, examples, schedule)
        return crop.weight * objective(network, crop.inputs, crop.halves, crop.unit)

    return jnp.mean(jax.vmap(one)(keys))
