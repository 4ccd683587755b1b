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

__all__ = ["Examples", "Schedule", "State", "draw", "evaluate", "run", "start"]

Network = Any  # a pytree of parameters that can be called
Objective = Callable[[Network, dict[str, Image], Image, Scalar], Scalar]


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
        """Return Adam with clipped gradients, because of fireflies."""
        rate = optax.cosine_onecycle_schedule(self.steps, self.rate)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))


class Examples(NamedTuple):
    """N frames to learn from, of one size.

    Attributes:
        inputs: of a recipe, normalised, [N,V,H,W,C] each; V variants of each frame.
        reference: normalised radiance, [N,H,W,3].
    """

    inputs: dict[str, Float[Array, "n v h w _"]]
    reference: Float[Array, "n h w c"]


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
        objective: loss of a network, the inputs and the reference of a crop, and the
            unit of radiance to measure both in.
        state: to start from.
        examples: to draw crops from.
        schedule: how to train.

    Yields:
        the state after each step, and the loss of its batch.

    Raises:
        ValueError: if the crops are larger than the frames.

    Example:
        >>> x = jnp.ones((1, 1, 4, 4, 3))
        >>> examples = Examples({"x": x}, 2 * x[0])
        >>> loss = lambda gain, inputs, r, _: jnp.mean((gain * inputs["x"] - r) ** 2)
        >>> schedule = Schedule(steps=200, batch=1, crop=2, rate=0.1)
        >>> first = start(jnp.ones(()), schedule)
        >>> *_, (last, value) = run(loss, first, examples, schedule)
        >>> print(f"{last.step} {last.network:.2f}")
        200 2.00
    """
    size = examples.reference.shape[1:3]
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
        >>> examples = Examples({"x": x}, 2 * x[:, 0])
        >>> loss = lambda gain, inputs, r, _: jnp.mean((gain * inputs["x"] - r) ** 2)
        >>> print(evaluate(loss, jnp.array(1.5), examples))
        [0.25 0.25]
    """
    one = jnp.ones((), examples.reference.dtype)
    first = {name: array[:, 0] for name, array in examples.inputs.items()}
    of_frame = lambda frame: objective(network, frame[0], frame[1], one)
    return lax.map(of_frame, (first, examples.reference), batch_size=4)


def draw(
    key: Key, examples: Examples, schedule: Schedule
) -> tuple[dict[str, Image], Image, Scalar]:
    """Draw a crop of a frame, with random flips, transposition and order of channels.

    Args:
        key: a typed key.
        examples: frames.
        schedule: sets the crop's size and the range of the unit.

    Returns:
        the crop's inputs and reference, and a unit of radiance to measure both in.

    Example:
        >>> x = jnp.ones((2, 1, 8, 8, 3))
        >>> examples, schedule = Examples({"x": x}, x[:, 0]), Schedule(crop=4)
        >>> crop = jax.jit(draw, static_argnames="schedule")
        >>> inputs, reference, _ = crop(jax.random.key(0), examples, schedule=schedule)
        >>> print(inputs["x"].shape, reference.shape)
        (4, 4, 3) (4, 4, 3)
    """
    which, variant, corner, turns, colours, unit = jax.random.split(key, 6)
    frames, height, width, _ = examples.reference.shape
    frame = jax.random.randint(which, (), 0, frames)
    size = schedule.crop
    ends = jnp.array([height - size + 1, width - size + 1])
    row, column = jax.random.randint(corner, (2,), 0, ends)
    flip_rows, flip_columns, transposed = jax.random.bernoulli(turns, shape=(3,))
    order = jax.random.permutation(colours, 3)
    variants = next(iter(examples.inputs.values())).shape[1]
    way = jax.random.randint(variant, (), 0, variants)

    def cut(array: Array, *place: Array) -> Image:
        c = array.shape[-1]
        at = (*place, row, column, jnp.zeros_like(row))
        sizes = (*(1 for _ in place), size, size, c)
        image = lax.dynamic_slice(array, at, sizes).reshape(size, size, c)
        image = jnp.where(flip_rows, image[::-1], image)
        image = jnp.where(flip_columns, image[:, ::-1], image)
        image = jnp.where(transposed, image.swapaxes(0, 1), image)
        return image[..., order] if c == 3 else image

    inputs = {name: cut(array, frame, way) for name, array in examples.inputs.items()}
    off = jax.random.uniform(unit, (), examples.reference.dtype, -1.0, 1.0)
    return inputs, cut(examples.reference, frame), 2 ** (schedule.jitter * off)


def _batch_loss(
    objective: Objective,
    network: Network,
    keys: Array,
    examples: Examples,
    schedule: Schedule,
) -> Scalar:
    """Return the mean loss of one crop a key."""
    one = lambda key: objective(network, *draw(key, examples, schedule))
    return jnp.mean(jax.vmap(one)(keys))
