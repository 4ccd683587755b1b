"""Frames as examples: what a network sees of them, and how it is judged.

A network is judged on frames of scenes that it is not trained on, by the relative L2 of
its image over that of the better of the frame's image and estimate: the geometric mean,
by samples a pixel.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb import metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame, Reference
from jscomb.learning import recipes, training
from jscomb.learning.recipes import Inputs, Network, Recipe
from jscomb.numerics.guards import finite, weighted_ratio
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Mask, Scalar

__all__ = [
    "Judged",
    "combined",
    "draw_losses",
    "make_inputs",
    "objective",
    "pieces",
    "stack_examples",
    "summary",
    "validate",
    "with_target",
]

_COMBINED = "unbiased", "biased", "biased_a", "noisy", "base"  # among the inputs
_AROUND = 7  # width of the window in which an invalid target is replaced
_LEAST = 0.02  # of the better input's error: less is not known from noisy references

Arrays = Mapping[str, np.ndarray]


class Judged(NamedTuple):
    """Frames that a network is judged on, or trained on.

    Attributes:
        examples: N pieces of frames.
        better: relative L2 of the better input of each, [N].
        samples: a pixel of each, [N].
    """

    examples: training.Examples
    better: Float[Array, " n"]
    samples: np.ndarray


def make_inputs(
    recipe: Recipe, frame: Frame, *, variants: bool = True
) -> dict[str, np.ndarray]:
    """Return what a network sees of a frame, and what it is judged by.

    Args:
        recipe: of the network.
        frame: as of `with_target`; with the recipe's bases and estimate, unless that
            is oidn, which is made where it is missing.
        variants: all of the recipe's inputs, not only the first.

    Returns:
        inputs by name, [V,H,W,C]; the `halves` of the reference, [2,H,W,3]; the
        relative L2 of the `better` of the images that each variant combines, [V], at
        least the reference's own noise; and the frame's `samples`, []. Empty if the
        camera sees no light.

    Raises:
        ValueError: if the frame lacks what is needed.

    Example:
        >>> from jscomb import exr
        >>> frame = exr.read_frame(exr.bundled()["cornell-glass-64"])
        >>> found = make_inputs(recipes.RECIPES["kernels"], frame)
        >>> print(found["depth"].shape, found["halves"].shape)
        (1, 192, 192, 1) (2, 192, 192, 3)
    """
    frame = with_target(frame)
    assert frame.reference is not None
    if not float(jnp.median(frame.reference.image)) > 0:
        return {}
    if lacking := set(recipe.bases) - set(frame.estimates):
        raise ValueError(f"training needs estimates {', '.join(sorted(lacking))}")
    frame = frame.normalised()
    estimate = _estimate(frame, recipe.estimate)
    assert frame.reference is not None
    r, difference = frame.reference
    assert difference is not None
    halves = jnp.stack([r + difference / 2, r - difference / 2])
    noise = metrics.rel_l2(r, r) - metrics.rel_l2(r, r, half_difference=difference)
    makers = (recipe.inputs, *(recipe.others if variants else ()))
    made = [make(jax.random.key(0), frame, estimate) for make in makers]
    better = [
        min(_error(image, halves) for image in combined(each).values()) for each in made
    ]
    inputs = {name: np.stack([m[name] for m in made]) for name in made[0]}
    return inputs | {
        "halves": np.asarray(halves),
        "better": np.asarray(jnp.maximum(jnp.stack(better), noise)),
        "samples": np.asarray(frame.samples or 0),
    }


def with_target(frame: Frame) -> Frame:
    """Return a frame with a reference to train on, noise to noise where it has none.

    Without one, half of the samples are the reference of the other half, from which
    they are independent: in expectation the loss has the same minimum.

    Args:
        frame: with a reference with halves, or with four sub-buffers.

    Returns:
        the frame, or its first half, without Open Image Denoise's estimate where that
        can be made anew.

    Raises:
        ValueError: if it has neither.

    Example:
        >>> from jscomb.frame import make_frame
        >>> frame = with_target(make_frame(jnp.ones((4, 8, 8, 3))))
        >>> print(frame.sub_buffers, frame.reference.image.shape)
        2 (8, 8, 3)
    """
    if frame.reference is not None and frame.reference.half_difference is not None:
        return frame
    if frame.sub_buffers < 4:
        raise ValueError(
            "training needs a reference with halves, or at least four sub-buffers "
            f"(this frame has {frame.sub_buffers})"
        )
    seen, other = frame.halves()
    a, b = (half.color for half in other.halves())
    a, b = (_filled(half, finite(a, b)) for half in (a, b))
    estimates = dict(seen.estimates)
    if oidn.available():  # its halves, too
        estimates.pop("oidn", None)
    return seen._replace(estimates=estimates, reference=Reference((a + b) / 2, a - b))


def _filled(image: Image, valid: Mask) -> Image:
    """Invalid pixels by the mean of valid ones around them, or by black."""
    weight = valid.astype(image.dtype)
    shown = jnp.where(valid, image, 0.0)
    around = weighted_ratio(window_mean(shown, _AROUND), window_mean(weight, _AROUND))
    return jnp.where(valid, image, around)


def pieces(arrays: Arrays, size: int) -> list[Arrays]:
    """Cut a frame's images into as many pieces as fit beside each other.

    Args:
        arrays: of `make_inputs`.
        size: width and height of the pieces in pixels.

    Returns:
        the pieces; what is not an image is the same for all.

    Example:
        >>> halves = np.zeros((2, 64, 40, 3))
        >>> print([piece["halves"].shape for piece in pieces({"halves": halves}, 32)])
        [(2, 32, 32, 3), (2, 32, 32, 3)]
    """
    if not arrays:
        return []
    _, height, width, _ = arrays["halves"].shape
    found = []
    for row, column in np.ndindex(height // size, width // size):
        rows, columns = (slice(n * size, (n + 1) * size) for n in (row, column))
        cut = lambda a: a[:, rows, columns] if a.ndim > 1 else a  # noqa: B023
        found.append({name: cut(array) for name, array in arrays.items()})
    return found


def stack_examples(found: Sequence[Arrays]) -> Judged:
    """Return pieces of one size as examples.

    Args:
        found: of `pieces`, at least one.

    Returns:
        the examples; the weight of a piece is 1 / its better input's error, so that
        the loss is a ratio like what a network is judged by.

    Example:
        >>> piece = {"x": np.ones((1, 4, 4, 3)), "halves": np.ones((2, 4, 4, 3))}
        >>> piece |= {"better": np.array([0.5]), "samples": np.array(16)}
        >>> print(stack_examples([piece, piece]).examples.weight)
        [[2.]
         [2.]]
    """
    stacked = lambda name: jnp.asarray(np.stack([each[name] for each in found]))
    own = {"halves", "better", "samples"}
    inputs = {name: stacked(name) for name in found[0] if name not in own}
    better = stacked("better")
    examples = training.Examples(inputs, stacked("halves"), 1 / better)
    return Judged(examples, better[:, 0], np.array([each["samples"] for each in found]))


def objective(
    recipe: Recipe, *, loss: Callable[[Image, Array], Scalar] | None = None
) -> training.Objective:
    """Return the loss of a recipe's network on one frame.

    Args:
        recipe: of the network.
        loss: of an image and the reference's halves, for the image of use; None for
            the recipe's own, for that of training.

    Returns:
        the loss of a network, inputs, halves, and the unit to measure them in.

    Example:
        >>> scale = lambda gain, inputs: gain * inputs["x"]
        >>> recipe = recipes.RECIPES["njs"]._replace(combine=scale)
        >>> x = jnp.ones((2, 2, 2, 3))
        >>> found = objective(recipe)(jnp.array(3.0), {"x": x[0]}, x, jnp.ones(()))
        >>> print(f"{found:.2f}")
        3.96
    """
    options = recipe.training if loss is None else {}

    def of_frame(network: Network, inputs: Any, halves: Array, unit: Scalar) -> Scalar:
        inputs = recipes.in_unit(inputs, unit)
        image = recipe.combine(network, inputs, **options)
        return (loss or recipe.loss)(image, halves / unit)

    return of_frame


def validate(recipe: Recipe, network: Network, held: Judged) -> Float[Array, " n"]:
    """Return the error of a network on each frame, over that of the better input.

    Args:
        recipe: of the network.
        network: to judge.
        held: frames.

    Returns:
        relative L2 divided by the better input's, at least 0.02, [N].

    Example:
        >>> piece = {"x": np.ones((1, 4, 4, 3)), "halves": 2 * np.ones((2, 4, 4, 3))}
        >>> piece |= {"better": np.array([0.5]), "samples": np.array(16)}
        >>> scale = lambda gain, inputs: gain * inputs["x"]
        >>> recipe = recipes.RECIPES["njs"]._replace(combine=scale)
        >>> print(validate(recipe, jnp.array(1.0), stack_examples([piece])).round(2))
        [0.5]
    """
    errors = training.evaluate(objective(recipe, loss=_error), network, held.examples)
    return jnp.maximum(errors / held.better, _LEAST)


def summary(ratios: Float[Array, " n"], samples: np.ndarray) -> dict[str, float]:
    """Return geometric means of ratios, by samples and of all, and the largest.

    Args:
        ratios: of each frame.
        samples: a pixel of each frame.

    Returns:
        by "16", ..., "all" and "worst".

    Example:
        >>> print(summary(jnp.array([0.5, 2.0]), np.array([4, 16])))
        {'4': 0.5, '16': 2.0, 'all': 1.0, 'worst': 2.0}
    """
    values = np.asarray(ratios, np.float64)
    mean = lambda some: float(np.exp(np.mean(np.log(some))))
    found = {f"{n:g}": mean(values[samples == n]) for n in np.unique(samples)}
    return found | {"all": mean(values), "worst": float(values.max())}


def draw_losses(axes: Any, card: Mapping[str, Any], *, title: str) -> Any:
    """Draw a run's losses against its steps.

    Args:
        axes: of Matplotlib.
        card: of the run.
        title: of the plot.

    Returns:
        the axes.

    Example:
        >>> from matplotlib.figure import Figure
        >>> losses = {"step": [0, 1], "train": [None, 0.5], "validation": [1.0, 0.9]}
        >>> card = {"losses": losses, "best_step": 1}
        >>> print(len(draw_losses(Figure().subplots(), card, title="njs").lines))
        3
    """
    losses = card["losses"]
    axes.plot(losses["step"][1:], losses["train"][1:], label="training loss")
    axes.plot(losses["step"], losses["validation"], label="validation: error ratio")
    axes.axvline(card["best_step"], color="0.7", label="best step")
    axes.set(xlabel="step", yscale="log", title=title)
    return axes


def combined(inputs: Inputs) -> Inputs:
    """Return the images that a recipe combines, of its inputs.

    Args:
        inputs: of a recipe.

    Returns:
        those that are known, by name.

    Example:
        >>> one = jnp.ones((2, 2, 3))
        >>> inputs = {"unbiased": one, "variance": one, "base0": jnp.nan * one}
        >>> print(*combined(inputs))
        unbiased
    """
    return {
        name: image
        for name, image in inputs.items()
        if recipes.kind(name) in _COMBINED and not jnp.all(jnp.isnan(image))
    }


def _error(image: Image, halves: Array) -> Scalar:
    """Relative L2, less the reference's own noise."""
    a, b = halves
    return metrics.rel_l2(image, (a + b) / 2, half_difference=a - b)


def _estimate(frame: Frame, name: str) -> Estimate:
    """The frame's estimate of a name; Open Image Denoise's is made if missing."""
    if name in frame.estimates:
        return frame.estimates[name]
    if name != "oidn":
        raise ValueError(
            f"no estimate {name!r}; there are {', '.join(frame.estimates)}"
        )
    return oidn.denoise_frame(frame)
