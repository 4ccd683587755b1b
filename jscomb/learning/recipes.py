"""Recipes: what a network sees of a frame, how its output makes an image, its loss.

A network is trained and used through the same recipe. Frames are normalised, so inputs
are too. `RECIPES` lists every network by the name of its method; the parameters of
some come with the package (`shipped`), each with a card that says what they are for.
"""

import functools
import importlib.resources
import json
import pathlib
import types
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb import double_shrinkage, ensemble, james_stein, metrics, progressive
from jscomb.denoisers import bilateral, kernel_predicting, oidn
from jscomb.features import FEATURES, stack
from jscomb.frame import Estimate, Frame
from jscomb.learning import checkpoints, losses, networks
from jscomb.numerics import luminance
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image, Key, Scalar

__all__ = [
    "BASES",
    "RECIPES",
    "WEIGHTS",
    "Recipe",
    "exchanged",
    "in_unit",
    "kind",
    "load_network",
    "of_mean",
    "options_of",
    "read_card",
    "shipped",
]

Network = Any  # a pytree of parameters that can be called
Inputs = dict[str, Image]
MakeInputs = Callable[[Key, Frame, Estimate], Inputs]
Halves = Float[Array, "2 h w c"]
Loss = Callable[[Image, Halves], Scalar]

WEIGHTS = pathlib.Path(str(importlib.resources.files("jscomb.learning"))) / "weights"
"""Folder of the parameters that come with the package, and of their cards."""

# By which power of a unit of radiance inputs are divided; the others by the first.
_POWERS = {"variance": 2, "sure": 2, "mse": 2, "noise": 2}
_POWERS |= {"albedo": 0, "normal": 0, "depth": 0, "weight": 0, "error": 0}

BASES = (
    *("oidn", "path-tracing", "oidn-demodulated", "nonlocal-means"),
    *("whitened", "multi-scale"),
)
"""What the ensembles are made of that a network is trained on, by method."""


class Recipe(NamedTuple):
    """A network with its inputs, its combiner and its loss.

    Attributes:
        network: its class, to be called with a key, a size and `options`.
        inputs: from a key, a normalised frame and an estimate to images by name.
        combine: from a network and its inputs to a normalised image.
        loss: of an image and the halves of a reference, all normalised.
        options: of the network: what it is for, in words that a card can hold.
        estimate: name of the frame's estimate that it combines.
        without: the estimator without a network, from the same inputs.
        bases: estimates that the frame must have besides, by method.
        others: inputs in place of `inputs` that training draws as often.
        training: options of `combine` while training.
    """

    network: Callable[..., Network]
    inputs: MakeInputs
    combine: Callable[..., Image]
    loss: Loss = losses.relative_l2
    options: Mapping[str, Any] = types.MappingProxyType({})
    estimate: str = "oidn"
    without: Callable[[Inputs], Image] | None = None
    bases: tuple[str, ...] = ()
    others: tuple[MakeInputs, ...] = ()
    training: Mapping[str, Any] = types.MappingProxyType({})

    def make(self, key: Key, **options: Any) -> Network:
        """Return a network with new parameters; options in place of the recipe's."""
        return self.network(key, **{**self.options, **options})


def of_mean(loss: Callable[[Image, Image], Scalar]) -> Loss:
    """Return a loss of an image and a reference as one of the reference's halves.

    Args:
        loss: of an image and a reference, such as `losses.log_l2`.

    Returns:
        the loss with the mean of the halves.

    Example:
        >>> halves = jnp.stack([jnp.zeros((1, 1, 3)), jnp.ones((1, 1, 3))])
        >>> print(f"{of_mean(losses.log_l2)(halves[0], halves):.3f}")
        0.943
    """
    return lambda image, halves: loss(image, jnp.mean(halves, axis=0))


def exchanged(inputs: MakeInputs) -> MakeInputs:
    """Return PD's inputs with the roles of the two images exchanged.

    Args:
        inputs: from a key, a frame and an estimate to images by name.

    Returns:
        the function with x and y, and v and s, exchanged.

    Example:
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
        pairs = {"unbiased": "biased", "variance": "sure"}
        pairs |= {b: a for a, b in pairs.items()}
        return {name: found[pairs.get(name, name)] for name in found}

    return other


def in_unit(inputs: Mapping[str, Image], unit: Scalar) -> Inputs:
    """Return a recipe's inputs in another unit of radiance.

    Args:
        inputs: images, squared radiances (variance, sure, mse) and features by name.
        unit: radiance to measure in, positive.

    Returns:
        radiances divided by the unit, squares by its square, features unchanged.

    Example:
        >>> one = jnp.ones((1, 1, 1))
        >>> inputs = {"unbiased": one, "variance": one, "depth": one}
        >>> print({n: i.item() for n, i in in_unit(inputs, jnp.asarray(2.0)).items()})
        {'unbiased': 0.5, 'variance': 0.25, 'depth': 1.0}
    """
    return {
        name: luminance.in_unit(image, unit, power=_POWERS.get(kind(name), 1))
        for name, image in inputs.items()
    }


def kind(name: str) -> str:
    """Return the name of an input without the number of its base.

    Args:
        name: such as base0.

    Returns:
        the name, such as base.

    Example:
        >>> print(kind("base0"), kind("biased_a"))
        base biased_a
    """
    return name.rstrip("0123456789")


def _double_shrinkage(key: Key, frame: Frame, estimate: Estimate) -> Inputs:
    """Return DSC's inputs, which have nothing random."""
    del key
    return double_shrinkage.neural_inputs(frame, estimate)


def _progressive(
    key: Key,
    frame: Frame,
    estimate: Estimate,
    *,
    denoise: Callable[[Image, Frame], Any],
) -> Inputs:
    """Return PD's inputs; denoises anew, since SURE probes the denoiser."""
    del estimate
    return progressive.neural_inputs(key, denoise, frame)


def _bilateral(color: Image, frame: Frame) -> Image:
    """Denoise a colour by a filter that knows the features."""
    return compiled(bilateral.denoise)(color, frame.variance, stack(frame))


def _ensemble(
    key: Key,
    frame: Frame,
    estimate: Estimate,
    *,
    bases: tuple[str, ...] = BASES,
    features: bool = True,
) -> Inputs:
    """Return an ensemble's inputs; bases that it lacks are unknown at every pixel."""
    del key, estimate
    found = ensemble.neural_inputs(frame, {n: frame.estimates[n] for n in bases})
    for number in range(len(bases), len(BASES)):
        for name in [n for n in found if n.endswith("0")]:
            found[f"{kind(name)}{number}"] = jnp.full_like(found[name], jnp.nan)
    if features:
        return found
    return found | {n: jnp.zeros_like(found[n]) for n in FEATURES if n in found}


def _ensemble_without(inputs: Mapping[str, Image]) -> Image:
    """With the multi-scale weights as they are."""
    return ensemble.candidates(inputs).blend


def _kernel_predicting(key: Key, frame: Frame, estimate: Estimate) -> Inputs:
    """Return the kernel predictor's inputs, which need no estimate."""
    del key, estimate
    return kernel_predicting.neural_inputs(frame)


def _joint(network: networks.Joint, inputs: Mapping[str, Image]) -> Image:
    """Denoise, and combine with the denoised image."""
    x, v = inputs["noisy"], inputs["variance"]
    y = kernel_predicting.denoise_inputs(network.denoiser, inputs)
    images = {"unbiased": x, "biased_a": y, "biased_b": y, "variance": v}
    return james_stein.combine_inputs(network.combiner, images)


def _james_stein_without(inputs: Mapping[str, Image]) -> Image:
    """Whitened, with robust variances."""
    y = (inputs["biased_a"] + inputs["biased_b"]) / 2
    v = james_stein.robust_variance(inputs["variance"])
    return james_stein.combine(inputs["unbiased"], y, v, window=7, whiten=True)


def _double_shrinkage_without(inputs: Mapping[str, Image]) -> Image:
    """With the errors as they are, and the prior's error that they give."""
    p, u, b = (inputs[name] for name in ("prior", "unbiased", "biased"))
    v, m = (jnp.broadcast_to(inputs[name], u.shape) for name in ("variance", "mse"))
    eta = double_shrinkage.prior_error(p, u, b, v, m)
    return double_shrinkage.combine(p, u, b, v, m, eta)


def _progressive_without(inputs: Mapping[str, Image]) -> Image:
    """By SURE over windows, whitened."""
    mix, images = (
        functools.partial(progressive.mixing, whiten=True),
        dict[str, Any](inputs),
    )
    return progressive.combine(**images, mix=mix)


_DENOISERS = (
    oidn.denoise_color,
    functools.partial(oidn.denoise_color, variant=oidn.VARIANTS["oidn-color"]),
    _bilateral,
)
_PD = tuple(functools.partial(_progressive, denoise=each) for each in _DENOISERS)


RECIPES = {
    "njs": Recipe(
        networks.JamesSteinNetwork,
        james_stein.neural_inputs,
        james_stein.combine_inputs,
        options={"rule": james_stein.Rule(window=7, whiten=True)},
        without=_james_stein_without,
        others=(functools.partial(james_stein.neural_inputs, choose="opposite"),),
    ),
    "dsc": Recipe(
        networks.ShrinkageNetwork,
        _double_shrinkage,
        double_shrinkage.combine_inputs,
        options={"serves": "denoised"},
        without=_double_shrinkage_without,
    ),
    "dsc-photons": Recipe(
        networks.ShrinkageNetwork,
        _double_shrinkage,
        double_shrinkage.combine_inputs,
        options={"serves": "independent"},
        estimate="photons",
        without=_double_shrinkage_without,
    ),
    "pd": Recipe(
        networks.MixingNetwork,
        _PD[0],
        progressive.combine_inputs,
        options={"form": "direct"},
        without=_progressive_without,
        others=(*_PD[1:], *map(exchanged, _PD[:2])),
        training={"bound": False, "limit": False},
    ),
    "neural-ensemble": Recipe(
        networks.EnsembleNetwork,
        _ensemble,
        ensemble.combine_inputs,
        of_mean(metrics.rel_l2),
        without=_ensemble_without,
        bases=BASES,
        others=(
            functools.partial(_ensemble, bases=BASES[:2], features=False),
            functools.partial(_ensemble, bases=(*BASES[1:4], BASES[5])),
        ),
    ),
    "kernels": Recipe(
        networks.KernelPredictor,
        _kernel_predicting,
        kernel_predicting.denoise_inputs,
    ),
    "kernels-njs": Recipe(networks.Joint, _kernel_predicting, _joint),
}
"""Recipes by name. The last two learn a denoiser, alone and jointly with a combiner.
Unlike the papers njs has the whitened rule, pd has alpha as one output of the network,
and the loss is one that noisy references do not bias; but for the ensemble, which is
trained on the error that it is judged by."""


def shipped(name: str) -> Network:
    """Return a network with the parameters that come with the package.

    Args:
        name: of its recipe, such as njs.

    Returns:
        the network.

    Raises:
        ValueError: if the package has no such network.

    Example:
        >>> network = shipped("pd")
        >>> print(network.form)
        direct
    """
    there = sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))
    if name not in there:
        raise ValueError(f"no trained network {name!r}; there are {', '.join(there)}")
    return load_network(RECIPES[name], WEIGHTS / f"{name}.safetensors")


def load_network(recipe: Recipe, path: pathlib.Path) -> Network:
    """Return a network with the parameters of a file, for what its card says.

    Args:
        recipe: of the network.
        path: safetensors file, beside its card.

    Returns:
        the network.

    Raises:
        ValueError: if a file is missing, damaged, or of another network.

    Example:
        >>> network = load_network(RECIPES["njs"], WEIGHTS / "njs.safetensors")
        >>> print(type(network).__name__, network.rule.window)
        JamesSteinNetwork 7
    """
    options = options_of(read_card(path))
    like = jax.eval_shape(lambda: recipe.make(jax.random.key(0), **options))
    return checkpoints.load(path, like)


def options_of(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a card's network.

    Args:
        card: from `read_card`.

    Returns:
        what `Recipe.make` takes.

    Example:
        >>> print(options_of({"network": {"rule": {"window": 7, "whiten": True}}}))
        {'rule': Rule(window=7, whiten=True)}
    """
    options = dict(card["network"])
    if "rule" in options:
        options["rule"] = james_stein.Rule(**options["rule"])
    return options


def read_card(path: pathlib.Path) -> dict[str, Any]:
    """Return the card of a file of parameters.

    Args:
        path: safetensors file. Its card has the same name with the suffix json.

    Returns:
        the card; `network` in it are the options of the network.

    Raises:
        ValueError: if the card is missing or damaged.

    Example:
        >>> print(read_card(WEIGHTS / "njs.safetensors")["method"])
        njs
    """
    card = path.with_suffix(".json")
    try:
        found = json.loads(card.read_text())
        if isinstance(found["network"], dict):
            return found
    except FileNotFoundError:
        raise ValueError(f"{card}: no such card of a network") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{card}: not the card of a network: {error}") from None
    raise ValueError(f"{card}: not the card of a network: `network` is no object")
