"""From a frame to a network's inputs, and from them to an image.

What a network was trained on and what it is used on have to be the same: both come from
here. Radiance is divided by the frame's exposure; regressions have a stride of 2.
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

from jscomb import double_shrinkage, james_stein, metrics, progressive
from jscomb.denoisers import kernel_predicting, oidn
from jscomb.features import stack
from jscomb.frame import Frame
from jscomb.learning import files, losses, networks
from jscomb.numerics.sure import monte_carlo_sure
from jscomb.numerics.tiles import Local
from jscomb.typing import Image, Key, Scalar

Inputs = dict[str, Image]
Network = Any  # a pytree of parameters that can be called

_STRIDE = 2  # of regressions
_BLOCK = 4  # pixels that a U-Net pools to one
# Two convolutions of 3x3 on each way through levels of pixels, pairs and blocks.
_U_NET = 2 * (2 * 1 + 2 * 2) + 2 * _BLOCK + _BLOCK - 1


class Method(NamedTuple):
    """A combiner with a network.

    Attributes:
        network: draws one, of a key and a size.
        inputs: of a key, a frame and the name of its biased image, what the frame is
            combined by, at an exposure of one.
        combine: of a network, the inputs and an exposure.
        loss: of an image and a reference.
        other: likewise, what training may draw as well; None if there is no such thing.
        training: options of `combine` to train by.
        halo: pixels around a pixel that `combine` sees of the inputs.
    """

    network: Callable[..., Network]
    inputs: Callable[[Key, Frame, str], Inputs]
    combine: Callable[..., Image]
    loss: Callable[[Image, Image], Scalar]
    other: Callable[[Key, Frame, str], Inputs] | None = None
    training: Mapping[str, Any] = types.MappingProxyType({})
    halo: int = 0


def _james_stein(key: Key, frame: Frame, name: str) -> Inputs:
    """Regressed where the halves say that it pays."""
    if frame.biased[name].halves is None:
        return _of_halves(frame, name, None)
    found = james_stein.regress(key, frame, name, stride=_STRIDE)
    return _of_halves(frame, name, found.biased.halves if found.ran else None)


def _other_james_stein(key: Key, frame: Frame, name: str) -> Inputs:
    """Regressed where the halves say that it does not pay."""
    found = james_stein.regress(key, frame, name, stride=_STRIDE, always=True)
    helps = found.change.helps
    return _of_halves(frame, name, None if helps else found.biased.halves)


def _of_halves(
    frame: Frame, name: str, halves: Float[Array, "2 h w c"] | None
) -> Inputs:
    """With regressed halves, or the biased image in place of both."""
    unit, full = frame.exposure, frame.biased[name].full
    a, b = (full, full) if halves is None else halves
    return {
        "unbiased": frame.color / unit,
        "biased_a": a / unit,
        "biased_b": b / unit,
        "variance": frame.variance / jnp.square(unit),
    }


def _double_shrinkage(key: Key, frame: Frame, name: str) -> Inputs:
    """What the combiner without a network makes of the frame on its way."""
    del key
    made = double_shrinkage.combine_frame(frame, name, stride=_STRIDE)
    unit = frame.exposure
    mean = lambda e: jnp.mean(e, axis=-1, keepdims=True) / jnp.square(unit)
    return {
        "prior": made.prior / unit,
        "unbiased": frame.color / unit,
        "biased": frame.biased[name].full / unit,
        "variance": mean(made.variance),
        "mse": mean(made.mse),
    }


def _progressive(key: Key, frame: Frame, name: str) -> Inputs:
    """With SURE of Open Image Denoise."""
    if name != "oidn":
        raise ValueError(
            f"pd needs a denoiser's derivative, not only its image: it knows oidn, "
            f"not {name!r}"
        )
    unit = frame.exposure
    guides = {"albedo": frame.albedo, "normal": frame.normal}
    if frame.albedo is None:
        guides = {}
    # One exposure, or the denoiser's would follow the probe.
    denoise = functools.partial(oidn.denoise, exposure=jnp.ones_like(unit), **guides)
    x = frame.color / unit
    v = james_stein.robust_variance(frame.variance) / jnp.square(unit)
    y, s, _ = monte_carlo_sure(key, denoise, x, v)
    return {"unbiased": x, "biased": y, "variance": v, "sure": s}


def exchanged(inputs: Callable[[Key, Frame, str], Inputs]) -> Callable[..., Inputs]:
    """PD's inputs with the parts of its two images exchanged.

    Args:
        inputs: of a key, a frame and a name.

    Returns:
        likewise.

    Example:
        >>> from jscomb.frame import make_frame
        >>> names = "unbiased", "biased", "variance", "sure"
        >>> images = {n: jnp.full((1, 1, 1), float(i)) for i, n in enumerate(names)}
        >>> inputs = exchanged(lambda key, frame, name: images)
        >>> taken = inputs(jax.random.key(0), make_frame(jnp.ones((1, 1, 1))), "oidn")
        >>> print({name: image.item() for name, image in taken.items()})
        {'unbiased': 1.0, 'biased': 0.0, 'variance': 3.0, 'sure': 2.0}
    """

    def other(key: Key, frame: Frame, name: str) -> Inputs:
        taken = inputs(key, frame, name)
        x, y, v, s = (taken[n] for n in ("unbiased", "biased", "variance", "sure"))
        return {"unbiased": y, "biased": x, "variance": s, "sure": v}

    return other


def _kernel_predicting(key: Key, frame: Frame, name: str) -> Inputs:
    """Of the noisy image and its features alone."""
    del key, name
    unit = frame.exposure
    if frame.albedo is None or frame.normal is None or frame.depth is None:
        raise ValueError("a kernel predictor needs albedo, normal and depth")
    albedo, normal, depth = jnp.split(stack(frame)[..., :7], [3, 6], axis=-1)
    return {
        "noisy": frame.color / unit,
        "variance": frame.variance / jnp.square(unit),
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
    }


def _predict(network: Network, inputs: Mapping[str, Image], **options: Any) -> Image:
    """The kernel-predicting denoiser of separate features."""
    features = [inputs[name] for name in ("albedo", "normal", "depth")]
    return kernel_predicting.denoise(
        network,
        inputs["noisy"],
        inputs["variance"],
        jnp.concatenate(features, axis=-1),
        **options,
    )


def _joint(
    network: networks.Joint, inputs: Mapping[str, Image], **options: Any
) -> Image:
    """Denoised and combined."""
    y = _predict(network.denoiser, inputs, **options)
    x, v = inputs["noisy"], inputs["variance"]
    return james_stein.neural_combine(network.combiner, x, y, y, v, **options)


def _of_arrays(combine: Callable[..., Image]) -> Callable[..., Image]:
    """A combiner whose arrays are named as the inputs are."""
    return lambda network, inputs, **options: combine(network, **inputs, **options)


METHODS = {
    "njs": Method(
        networks.JamesSteinNetwork,
        _james_stein,
        _of_arrays(
            functools.partial(james_stein.neural_combine, window=7, whiten=True)
        ),
        losses.log_l2,
        _other_james_stein,
        halo=_U_NET + 1 + 7 + 2 * 3,  # its head, kernels of 15x15, windows of 7x7 twice
    ),
    "dsc": Method(
        networks.ShrinkageNetwork,
        _double_shrinkage,
        _of_arrays(double_shrinkage.neural_combine),
        metrics.smape,
        halo=_U_NET + 6,  # kernels of 13x13
    ),
    "pd": Method(
        networks.MixingNetwork,
        _progressive,
        _of_arrays(
            functools.partial(
                progressive.neural_combine,
                activate=progressive.direct_activation,
                bound=False,
            )
        ),
        losses.log_l2,
        exchanged(_progressive),
        {"activate": functools.partial(progressive.direct_activation, beyond=0.0)},
        halo=7,  # a convolution of 5x5 and five of 3x3
    ),
}
"""The combiners whose trained parameters come with the package. Away from the papers,
as it measured better when both were trained: njs has the whitened rule; pd NJS's loss,
alpha as one output of the network, and no bound.
"""

DENOISERS = {
    "kernels": Method(
        networks.KernelPredictor, _kernel_predicting, _predict, losses.log_l2
    ),
    "kernels-njs": Method(networks.Joint, _kernel_predicting, _joint, losses.log_l2),
}
"""A learned biased image, alone and jointly with the combiner; to be trained."""


def shipped(name: str) -> Network:
    """A network with the parameters that come with the package.

    Args:
        name: njs, dsc or pd.

    Returns:
        the network.

    Raises:
        ValueError: if there is no such method.

    Example:
        >>> network = shipped("pd")
        >>> print(sum(array.size for array in jax.tree.leaves(network)), "parameters")
        33609 parameters
    """
    folder = importlib.resources.files("jscomb.learning") / "weights"
    return load(_known(name), pathlib.Path(str(folder)) / f"{name}.safetensors")


def load(method: Method, path: pathlib.Path) -> Network:
    """A network with the parameters of a file.

    Args:
        method: whose network it is.
        path: safetensors file, with its card beside it: the same name, ending in json,
            which says the network's size.

    Returns:
        the network.

    Raises:
        ValueError: if a file is missing or damaged, or of another network.

    Example:
        >>> folder = str(importlib.resources.files("jscomb.learning"))
        >>> path = pathlib.Path(folder, "weights", "njs.safetensors")
        >>> print(type(load(METHODS["njs"], path)).__name__)
        JamesSteinNetwork
    """
    card = path.with_suffix(".json")
    try:
        size = json.loads(card.read_text())["size"]
    except FileNotFoundError:
        raise ValueError(f"{card}: no such card of a network") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{card}: not the card of a network: {error}") from None
    like = jax.eval_shape(lambda: method.network(jax.random.key(0), size=size))
    return files.load(path, like)


def _known(name: str) -> Method:
    """The method of that name."""
    if name not in METHODS:
        raise ValueError(f"no method {name!r}; there are {', '.join(METHODS)}")
    return METHODS[name]


def combine_frame(
    key: Key, frame: Frame, name: str, *, method: str, network: Network | None = None
) -> Image:
    """Combine a frame with one of its biased images by a trained network.

    Args:
        key: of random probes.
        frame: with variance and three channels.
        name: of the biased image.
        method: njs, dsc or pd.
        network: None for the one that comes with the package.

    Returns:
        the combination, linear radiance, shape [H,W,C].

    Raises:
        ValueError: if there is no such method or biased image, or the frame lacks what
            the method needs.
        ImportError: for pd, if Open Image Denoise is not installed.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> x = np.random.default_rng(0).normal(1, 0.2, (8, 8, 3)).astype(np.float32)
        >>> y = np.full_like(x, 1.15)
        >>> frame = make_frame(x, variance=np.full_like(x, 0.04), biased={"y": y})
        >>> image = combine_frame(jax.random.key(0), frame, "y", method="njs")
        >>> for made in (x, y, image):
        ...     print(f"{np.sqrt(np.mean((made - 1) ** 2)):.2f}")
        0.19
        0.15
        0.13
    """
    found = local(key, frame, name, method=method, network=network)
    return found.function(found.images)


def local(
    key: Key, frame: Frame, name: str, *, method: str, network: Network | None = None
) -> Local:
    """A frame's combination by a trained network as a function of what it takes.

    Decides on values (features that tell nothing, whether to regress), so it is not for
    `jit`.

    Args:
        key: of random probes.
        frame: with variance and three channels.
        name: of the biased image; njs regresses where it has halves, dsc needs them, pd
            denoises anew and knows "oidn" alone.
        method: njs, dsc or pd.
        network: None for the one that comes with the package.

    Returns:
        the function and its images, for large ones by crops.

    Raises:
        ValueError: if there is no such method or biased image, or the frame lacks what
            the method needs.
        ImportError: for pd, if Open Image Denoise is not installed.

    Example:
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((8, 8, 3), jnp.float32)
        >>> frame = make_frame(one, variance=one, biased={"y": one})
        >>> found = local(jax.random.key(0), frame, "y", method="njs")
        >>> print(sorted(found.images), found.halo, found.multiple)
        ['biased_a', 'biased_b', 'unbiased', 'variance'] 37 4
    """
    if name not in frame.biased:
        raise ValueError(f"no biased image {name!r}; there are {list(frame.biased)}")
    if frame.color.shape[-1] != 3:
        raise ValueError(
            f"the networks want three channels, got {frame.color.shape[-1]}"
        )
    chosen = _known(method)
    inputs = chosen.inputs(key, frame, name)
    network = shipped(method) if network is None else network
    unit = frame.exposure
    function = lambda inputs: unit * _combine(network, inputs, method=method)
    return Local(function, inputs, chosen.halo, _BLOCK)


@functools.partial(jax.jit, static_argnames="method")
def _combine(network: Network, inputs: Inputs, *, method: str) -> Image:
    """Of inputs at an exposure of one."""
    some = next(iter(inputs.values()))
    one = jnp.ones((), some.dtype)
    return METHODS[method].combine(network, inputs, exposure=one)
