"""The network tuned on one frame, noise against noise.

Every channel of every layer has a gain and a bias, w (1 + g) and c + b, which minimise

    L = sum over pixels of W(x_a) (N(x_a) - x_b)^2,  and a and b exchanged.

The noise of x_b is independent of N(x_a) and of the weight, which is made of x_a alone:
so L has the expectation of the weighted squared error and a constant, whatever the
distribution of the noise. A weight that saw x_b would favour an image without its
fireflies, which is too dark.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jscomb.denoisers.oidn._denoise import NEEDS, denoise_normalised, pretrained
from jscomb.frame import Estimate, Frame, with_halves
from jscomb.numerics.guards import zero_invalid
from jscomb.numerics.tiles import compiled
from jscomb.numerics.variances import relative_precision
from jscomb.typing import Image

TUNING_NEEDS = NEEDS._replace(halves=True)
_STEPS = 40
_RATE = 0.001  # of Adam
_CROP = 256  # pixels along the side of what a step sees

Shifts = list[Array]  # a gain or a bias of every channel, layer by layer


class _Pair(NamedTuple):
    """What is denoised, guides by name, what it is held against, and its weight."""

    color: Image
    guides: dict[str, Array]
    target: Image
    weight: Array


def tune(frame: Frame, *, steps: int = _STEPS, rate: float = _RATE) -> Any:
    """Tune the network's gains and biases on the halves of a frame.

    Args:
        frame: normalised, with three channels and half buffers.
        steps: of Adam, each on a crop of at most 256x256 pixels.
        rate: of Adam.

    Returns:
        the network, for `denoise_normalised` with the frame's features.

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised, or has no three channels or halves.
        RuntimeError: if the installed version's weights cannot be read.

    Example:
        >>> from jscomb.frame import make_frame
        >>> shape = 2, 32, 32, 3
        >>> noise = jax.random.exponential(jax.random.key(0), shape, jnp.float32)
        >>> frame = make_frame(noise).normalised()
        >>> if not NEEDS.missing_package():
        ...     network = tune(frame, steps=1)
        ...     made = denoise_normalised(frame.color, network=network)
        ...     assert made.std() < 0.5 * frame.color.std()

    Source: ours; noise against noise is of Lehtinen et al. 2018.
    """
    import optax  # slow to import

    frame.require("oidn.tune", TUNING_NEEDS)
    network = pretrained(features=tuple(_guides(frame)))
    a, b = frame.halves()
    pairs = _pair(a, b), _pair(b, a)
    zeros = lambda leaf: jnp.zeros(leaf.shape[-1:], leaf.dtype)
    shifts = [zeros(leaf) for leaf in jax.tree.leaves(network)]
    state = optax.adam(rate).init(shifts)
    step = compiled(_step, rate=rate)
    random = np.random.default_rng(0)
    for number in range(steps):
        crop = _crop(pairs[number % 2], random)
        shifts, state = step(network, shifts, state, crop)
    return _shifted(network, shifts)


def tune_frame(frame: Frame, *, steps: int = _STEPS, rate: float = _RATE) -> Estimate:
    """Denoise a frame by the network tuned on it.

    An estimate beside others: `frame.with_estimate("tuned", tune_frame(frame))`. Where
    samples are few it is often worse than the network as it is; the weights of an
    ensemble find where.

    Args:
        frame: normalised, with three channels and half buffers.
        steps: as for `tune`.
        rate: as for `tune`.

    Returns:
        the estimate, normalised radiance. With four sub-buffers it has halves: each is
        denoised by a network tuned on its own two sub-buffers alone, or it would say
        nothing independent of the other half.

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised, or has no three channels or halves.
        RuntimeError: if the installed version's weights cannot be read.

    Example:
        >>> from jscomb.frame import make_frame
        >>> shape = 2, 32, 32, 3
        >>> noise = jax.random.exponential(jax.random.key(0), shape, jnp.float32)
        >>> if not NEEDS.missing_package():
        ...     made = tune_frame(make_frame(noise).normalised(), steps=1)
        ...     assert made.image.std() < 0.5 * noise.std() and made.halves is None

    Source: as `tune`.
    """
    frame.require("oidn.tune_frame", TUNING_NEEDS)

    def one(part: Frame) -> Image:
        network = tune(part, steps=steps, rate=rate)
        return _denoised(part.color, _guides(part), network)

    return with_halves(frame, one, needs=TUNING_NEEDS)


def _guides(frame: Frame) -> dict[str, Array]:
    """The features that guide the network: both, the albedo, or none."""
    if frame.albedo is None:
        return {}
    if frame.normal is None:
        return {"albedo": frame.albedo}
    return {"albedo": frame.albedo, "normal": frame.normal}


def _denoised(color: Image, guides: dict[str, Array], network: Any = None) -> Image:
    """By a network, the installed one if none is given."""
    albedo, normal = (guides.get(name) for name in ("albedo", "normal"))
    return denoise_normalised(color, albedo=albedo, normal=normal, network=network)


def _pair(half: Frame, other: Frame) -> _Pair:
    """One half to denoise, the other to hold it against."""
    guides = _guides(half)
    y = _denoised(half.color, guides)
    x, target = (jnp.asarray(part.color, y.dtype) for part in (half, other))
    return _Pair(x, guides, target, compiled(_weight)(x, y))


def _weight(x: Image, y: Image) -> Float[Array, "h w 1"]:
    """Inverse squared radiance, less where the half is noisy; of one half alone."""
    valid, x, y = zero_invalid(x, y)
    square = jnp.square(jnp.mean(y, axis=-1, keepdims=True))
    square += 0.01 * jnp.mean(square)
    noise = jnp.mean(jnp.square(x - y), axis=-1, keepdims=True)
    return relative_precision(square, noise, valid)


def _crop(pair: _Pair, random: np.random.Generator) -> _Pair:
    """A part of the images, somewhere."""
    top, left = (
        int(random.integers(max(n - _CROP, 0) + 1)) for n in pair.color.shape[:2]
    )
    cut = lambda image: image[top : top + _CROP, left : left + _CROP]
    return jax.tree.map(cut, pair)


def _step(
    network: Any, shifts: Shifts, state: Any, pair: _Pair, *, rate: float
) -> tuple[Shifts, Any]:
    """One step of Adam."""
    import optax

    slope = jax.grad(functools.partial(_loss, network, pair=pair))(shifts)
    with jax.numpy_dtype_promotion("standard"):  # optax counts in integers
        updates, state = optax.adam(rate).update(slope, state)
    return jax.tree.map(jnp.add, shifts, updates), state


def _loss(network: Any, shifts: Shifts, *, pair: _Pair) -> Array:
    """The weighted squared difference from the other half."""
    tuned = _shifted(network, shifts)
    made = _denoised(pair.color, pair.guides, tuned)
    valid, target = zero_invalid(pair.target)
    square = jnp.square(made - target)
    return jnp.mean(jnp.where(valid, pair.weight * square, 0.0))


def _shifted(network: Any, shifts: Shifts) -> Any:
    """The network with gains of its weights and biases added to its own."""
    leaves, tree = jax.tree.flatten(network)

    def moved(leaf: Array, shift: Array) -> Array:
        if leaf.ndim == 1:
            return leaf + shift
        return leaf * (1 + shift.reshape(*(1,) * (leaf.ndim - 1), -1))

    return jax.tree.unflatten(tree, map(moved, leaves, shifts))
