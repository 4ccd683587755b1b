"""The filter as a JAX function: by its network, or on the host.

The network is the same function to rounding, and has exact derivatives of both kinds.
Where the host is faster, the image is the host's and its derivative the network's.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jscomb.denoisers.oidn import _host, _weights
from jscomb.denoisers.oidn._models import Images, Model
from jscomb.numerics.tiles import compiled, map_crops

_STEP = 3e-4  # of a difference, relative to the typical pixel
_COMPILED = 0.8  # network's part of the filter's time that is worth compiling it for
_LARGEST = 2.0  # of radiance as the network makes it; the curve back would overflow
_WHOLE = 2**21  # pixels; larger images are computed by crops
_TILE = 1024  # pixels, its width


def run(model: Model, images: Images, exposure: float) -> Array:
    """Filter images [H,W,3] where it is faster; derivatives by the network."""
    found = _weights.identify(model)
    if found is None:
        return _on_host(model, exposure, dict(images))
    if jax.default_backend() == "cpu" and found.time > _COMPILED:
        return _mixed(model, exposure, dict(images))
    return apply(_weights.network(model), model, images, exposure)


def apply(network: Any, model: Model, images: Images, exposure: float) -> Array:
    """Filter images [H,W,3] by a network; large ones by crops."""
    images = {name: images[name] for name in model.inputs}
    return compiled(_apply, model=model, exposure=exposure)(network, images)


def _apply(network: Any, images: Images, *, model: Model, exposure: float) -> Array:
    """As `apply`, not compiled."""
    whole = functools.partial(_whole, network, model=model, exposure=exposure)
    height, width, _ = images[model.inputs[0]].shape
    if height * width <= _WHOLE:
        return whole(images)
    reach, multiple = network.reach, network.multiple
    return map_crops(whole, images, tile=_TILE, halo=reach, multiple=multiple)


def _whole(network: Any, images: Images, *, model: Model, exposure: float) -> Array:
    """Filter by a network: through the curve, and back."""
    from jscomb.denoisers.oidn._network import CURVES

    forward, inverse = CURVES[model.curve]
    main, *guides = model.inputs
    image = images[main]
    scale = 1.0 if model.bounded else exposure
    positive = (image + 1) / 2 if model.signed else image
    shown = [forward(scale * positive)]
    shown += [(images[g] + 1) / 2 if g == "normal" else images[g] for g in guides]
    largest = 1.0 if model.bounded else _LARGEST
    made = jnp.clip(network(jnp.concatenate(shown, axis=-1)), 0.0, largest)
    made = inverse(made) / scale
    return 2 * made - 1 if model.signed else made


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _mixed(model: Model, exposure: float, images: dict[str, Array]) -> Array:
    """Filter on the host, with the network's derivative."""
    return _callback(model, exposure, images)


@_mixed.defjvp
def _mixed_jvp(model: Model, exposure: float, primals, tangents):
    """Differentiate the network."""
    network = _weights.network(model)
    by_network = lambda images: apply(network, model, images, exposure)
    return jax.jvp(by_network, primals, tangents)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _on_host(model: Model, exposure: float, images: dict[str, Array]) -> Array:
    """Filter on the host, with a difference for its derivative."""
    return _callback(model, exposure, images)


@_on_host.defjvp
def _on_host_jvp(model: Model, exposure: float, primals, tangents):
    """Central difference; its step changes the typical pixel by `_STEP` of its value.

    Typical is the geometric mean of those that change at all: if the largest decided,
    the steps of all others would be lost to rounding beside a firefly.
    """
    size = jnp.concatenate([abs(i).ravel() for i in jax.tree.leaves(primals)])
    speed = jnp.concatenate([abs(i).ravel() for i in jax.tree.leaves(tangents)])
    moves = speed > 0
    relative = jnp.log(jnp.where(moves, speed, 1.0) / (size + 1))
    count = jnp.maximum(jnp.sum(moves), 1).astype(relative.dtype)
    step = _STEP * jnp.exp(-jnp.sum(jnp.where(moves, relative, 0.0)) / count)

    def at(side: float) -> Array:
        moved = jax.tree.map(lambda p, t: p + side * step * t, primals, tangents)
        return _on_host(model, exposure, *moved)

    return _on_host(model, exposure, *primals), (at(1.0) - at(-1.0)) / (2 * step)


def _callback(model: Model, exposure: float, images: Mapping[str, Array]) -> Array:
    """Call the filter on the host."""
    main = images[model.inputs[0]]
    shape = jax.ShapeDtypeStruct(main.shape, jnp.float32)

    def call(images: Mapping[str, Any]) -> np.ndarray:
        arrays = {name: np.asarray(i, np.float32) for name, i in images.items()}
        return _host.run(model, arrays, exposure)

    used = {name: images[name] for name in model.inputs}
    return jax.pure_callback(call, shape, used, vmap_method="sequential")
