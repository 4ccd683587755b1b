"""Recipes: what a network sees of a frame, how its output makes an image, its loss.

A network is trained and used through the same recipe. Frames are normalised, so inputs
are too. `RECIPES` lists every network by the name of its method; the parameters of
some come with the package (`shipped`).
"""

import functools
import importlib.resources
import json
import pathlib
import types
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from jscomb import double_shrinkage, james_stein, metrics, progressive
from jscomb.denoisers import kernel_predicting, oidn
from jscomb.frame import Estimate, Frame
from jscomb.learning import checkpoints, losses, networks
from jscomb.numerics import luminance
from jscomb.typing import Image, Key, Scalar

__all__ = [
    "RECIPES",
    "WEIGHTS",
    "Recipe",
    "exchanged",
    "in_unit",
    "load_network",
    "shipped",
]

Network = Any  # a pytree of parameters that can be called
Inputs = dict[str, Image]
MakeInputs = Callable[[Key, Frame, Estimate], Inputs]

WEIGHTS = pathlib.Path(str(importlib.resources.files("jscomb.learning"))) / "weights"
"""Folder of the parameters that come with the package, and of their cards."""

# By which power of a unit of radiance inputs are divided; the others by the first.
_POWERS = {"variance": 2, "sure": 2, "mse": 2, "albedo": 0, "normal": 0, "depth": 0}


class Recipe(NamedTuple):
    """A network with its inputs, its combiner and its loss.

    Attributes:
        network: its class, to be called with a key and a size.
        inputs: from a key, a normalised frame and an estimate to images by name.
        combine: from a network and its inputs to a normalised image.
        loss: of an image and a reference, both normalised.
        other: alternative inputs that training draws as often; None for none.
        training: options of `combine` while training.
    """

    network: Callable[..., Network]
    inputs: MakeInputs
    combine: Callable[..., Image]
    loss: Callable[[Image, Image], Scalar]
    other: MakeInputs | None = None
    training: Mapping[str, Any] = types.MappingProxyType({})


def exchanged(inputs: MakeInputs) -> MakeInputs:
    """Return PD's inputs with the roles of the two images exchanged.

    Args:
        inputs: from a key, a frame and an estimate to images by name.

    Returns:
        the function with x and y, and v and s, exchanged.

    Example:
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> names, one = ("unbiased", "biased", "variance", "sure"), jnp.ones((1, 1, 1))
        >>> images = {name: k * one for k, name in enumerate(names)}
        >>> other = exchanged(lambda key, frame, estimate: images)
        >>> inputs = other(jax.random.key(0), make_frame(one), Estimate(one))
        >>> print({name: image.item() for name, image in inputs.items()})
        {'unbiased': 1.0, 'biased': 0.0, 'variance': 3.0, 'sure': 2.0}
    """

    def other(key: Key, frame: Frame, estimate: Estimate) -> Inputs:
        found = inputs(key, frame, estimate)
        return {
            "unbiased": found["biased"],
            "biased": found["unbiased"],
            "variance": found["sure"],
            "sure": found["variance"],
        }

    return other


def in_unit(inputs: Mapping[str, Image], unit: Scalar) -> Inputs:
    """Return a recipe's inputs in another unit of radiance.

    Args:
        inputs: images, squared radiances (variance, sure, mse) and features by name.
        unit: radiance to measure in, positive.

    Returns:
        radiances divided by the unit, squares by its square, features unchanged.

    Example:
        >>> import jax.numpy as jnp
        >>> one = jnp.ones((1, 1, 1))
        >>> inputs = {"unbiased": one, "variance": one, "depth": one}
        >>> print({n: i.item() for n, i in in_unit(inputs, jnp.asarray(2.0)).items()})
        {'unbiased': 0.5, 'variance': 0.25, 'depth': 1.0}
    """
    return {
        name: luminance.in_unit(image, unit, power=_POWERS.get(name, 1))
        for name, image in inputs.items()
    }


def _double_shrinkage(key: Key, frame: Frame, estimate: Estimate) -> Inputs:
    """Return DSC's inputs, which have nothing random."""
    del key
    return double_shrinkage.neural_inputs(frame, estimate)


def _progressive(key: Key, frame: Frame, estimate: Estimate) -> Inputs:
    """Return PD's inputs; denoises anew, since SURE probes the denoiser."""
    del estimate
    return progressive.neural_inputs(key, oidn.denoise_color, frame)


def _kernel_predicting(key: Key, frame: Frame, estimate: Estimate) -> Inputs:
    """Return the kernel predictor's inputs, which need no estimate."""
    del key, estimate
    return kernel_predicting.neural_inputs(frame)


def _joint(network: networks.Joint, inputs: Mapping[str, Image]) -> Image:
    """Denoise, and combine with the denoised image."""
    x, v = inputs["noisy"], inputs["variance"]
    y = kernel_predicting.denoise_inputs(network.denoiser, inputs)
    images = {"unbiased": x, "biased_a": y, "biased_b": y, "variance": v}
    paper = {"window": 15, "whiten": False}
    return james_stein.combine_inputs(network.combiner, images, **paper)


RECIPES = {
    "njs": Recipe(
        networks.JamesSteinNetwork,
        james_stein.neural_inputs,
        james_stein.combine_inputs,
        losses.log_l2,
        functools.partial(james_stein.neural_inputs, choose="opposite"),
    ),
    "dsc": Recipe(
        networks.ShrinkageNetwork,
        _double_shrinkage,
        double_shrinkage.combine_inputs,
        metrics.smape,
    ),
    "pd": Recipe(
        networks.MixingNetwork,
        _progressive,
        progressive.combine_inputs,
        losses.log_l2,
        exchanged(_progressive),
        {"activate": functools.partial(progressive.direct_activation, beyond=0.0)},
    ),
    "kernels": Recipe(
        networks.KernelPredictor,
        _kernel_predicting,
        kernel_predicting.denoise_inputs,
        losses.log_l2,
    ),
    "kernels-njs": Recipe(networks.Joint, _kernel_predicting, _joint, losses.log_l2),
}
"""Recipes by name. Unlike the papers, as it measured better when both were trained: njs
has the whitened rule; pd has NJS's loss, alpha as one output of the network, and no
bound. The last two learn a denoiser, alone and jointly with a combiner."""


def shipped(name: str) -> Network:
    """Return a network with the parameters that come with the package.

    Args:
        name: of its recipe: njs, dsc or pd.

    Returns:
        the network.

    Raises:
        ValueError: if the package has no such network.

    Example:
        >>> network = shipped("pd")
        >>> print(sum(array.size for array in jax.tree.leaves(network)), "parameters")
        33609 parameters
    """
    files = {name: WEIGHTS / f"{name}.safetensors" for name in RECIPES}
    there = [name for name, file in files.items() if file.exists()]
    if name not in there:
        raise ValueError(f"no trained network {name!r}; there are {', '.join(there)}")
    return load_network(RECIPES[name], files[name])


def load_network(recipe: Recipe, path: pathlib.Path) -> Network:
    """Return a network with the parameters of a file.

    Args:
        recipe: of the network.
        path: safetensors file. Its card, with the network's size, has the same name
            with the suffix json.

    Returns:
        the network.

    Raises:
        ValueError: if a file is missing, damaged, or of another network.

    Example:
        >>> network = load_network(RECIPES["njs"], WEIGHTS / "njs.safetensors")
        >>> print(type(network).__name__)
        JamesSteinNetwork
    """
    card = path.with_suffix(".json")
    try:
        size = json.loads(card.read_text())["size"]
    except FileNotFoundError:
        raise ValueError(f"{card}: no such card of a network") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{card}: not the card of a network: {error}") from None
    like = jax.eval_shape(lambda: recipe.network(jax.random.key(0), size=size))
    return checkpoints.load(path, like)
