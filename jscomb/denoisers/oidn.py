"""Open Image Denoise, with guards: normalisation, invalid pixels, halves.

The filter is not scale-equivariant at very low radiance, one infinite pixel corrupts a
large area, and NaN counts as black. So images are normalised to a median luminance of
one, and each invalid pixel is filled from its neighbours before the filter sees it.
Images [H,W,3], linear radiance.

For `jit`, `vmap` (one image after the other) and forward derivatives: the filter itself
runs on the host, and its derivative is a central difference. It has no reverse
derivative.

Needs the extra `oidn` (`pip install "jscomb[oidn]"`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import ArrayLike

from jscomb.frame import Estimate, Frame, Needs, Package, with_halves
from jscomb.numerics.guards import finite
from jscomb.numerics.luminance import median_luminance
from jscomb.numerics.windows import window_max, window_mean
from jscomb.typing import Image

__all__ = [
    "NEEDS",
    "available",
    "denoise",
    "denoise_color",
    "denoise_frame",
    "denoise_normalised",
]

NEEDS = Needs(channels=3, normalised=True, package=Package("pyoidn", "oidn"))

_LARGEST = 1e5  # normalised radiance; beyond, the filter's half floats overflow
_STEP = 0.03  # of a difference, relative to the typical pixel


def available() -> bool:
    """Return whether Open Image Denoise is installed.

    Returns:
        True if `denoise` can run.

    Example:
        >>> from jscomb import denoisers
        >>> denoiser = denoisers.oidn if available() else denoisers.bilateral
    """
    return not NEEDS.missing_package()


def denoise(
    color: ArrayLike,
    *,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
) -> Array:
    """Denoise one image.

    Args:
        color: linear radiance, shape [H,W,3]; may hold invalid pixels.
        albedo: shape [H,W,3], clipped to [0, 1] here; optional.
        normal: shape [H,W,3], components in [-1, 1]; optional, needs `albedo`.

    Returns:
        the denoised image, linear radiance, finite, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if a shape is wrong, or a normal comes without an albedo.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> noisy = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> if available():
        ...     assert jax.jit(denoise)(noisy).std() < 0.1 * noisy.std()
    """
    image = _checked(color)
    unit = median_luminance(image)
    return unit * denoise_normalised(image / unit, albedo=albedo, normal=normal)


def denoise_normalised(
    color: ArrayLike,
    *,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
) -> Array:
    """Denoise one normalised image.

    For halves and crops of a normalised frame, and for derivatives: those of `denoise`
    include its unit's, which follows the noise.

    Args:
        color: normalised radiance, shape [H,W,3]; may hold invalid pixels.
        albedo: shape [H,W,3], clipped to [0, 1] here; optional.
        normal: shape [H,W,3], components in [-1, 1]; optional, needs `albedo`.

    Returns:
        the denoised image, normalised radiance, finite, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if a shape is wrong, or a normal comes without an albedo.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> noisy = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> if available():
        ...     assert jax.jit(denoise_normalised)(noisy).std() < 0.1 * noisy.std()
    """
    image = _checked(color)
    if normal is not None and albedo is None:
        raise ValueError("normal needs albedo: Open Image Denoise takes both or albedo")
    features = {}
    for name, feature, minimum in (("albedo", albedo, 0.0), ("normal", normal, -1.0)):
        if feature is not None:
            clean = _fill(jnp.asarray(feature, jnp.float32))
            if clean.shape != image.shape:
                raise ValueError(f"{name} has shape {clean.shape}, not {image.shape}")
            features[name] = jnp.clip(clean, minimum, 1.0)
    return _filter(jnp.clip(_fill(image), 0.0, _LARGEST), features)


def denoise_color(color: Image, frame: Frame, *, features: bool = True) -> Image:
    """Denoise another colour of a normalised frame, guided by the frame's features.

    For derivatives with respect to the colour, as `progressive` takes them.

    Args:
        color: normalised radiance, shape [H,W,3].
        frame: normalised, of the same size.
        features: use the frame's albedo and normal.

    Returns:
        the denoised colour, normalised radiance, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised or does not have three channels.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> from jscomb.frame import make_frame
        >>> noise = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> frame = make_frame(noise).normalised()
        >>> if available():
        ...     made = denoise_color(frame.color, frame)
        ...     assert (made == denoise_frame(frame).image).all()
    """
    frame.require("oidn", NEEDS)
    albedo = frame.albedo if features else None
    normal = None if albedo is None else frame.normal
    return denoise_normalised(color, albedo=albedo, normal=normal)


def denoise_frame(frame: Frame, *, features: bool = True) -> Estimate:
    """Denoise a normalised frame, guided by its albedo and normal.

    Args:
        frame: normalised, with three channels.
        features: use its albedo, and its normal if it has both.

    Returns:
        the estimate, normalised radiance.

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the frame is not normalised or does not have three channels.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> from jscomb.frame import make_frame
        >>> shape = 2, 32, 32, 3
        >>> noise = jax.random.exponential(jax.random.key(0), shape, jnp.float32)
        >>> if available():
        ...     made = denoise_frame(make_frame(noise).normalised())
        ...     assert made.image.std() < made.halves.std() < 0.1 * noise.std()
    """
    frame.require("oidn", NEEDS)
    one = lambda part: denoise_color(part.color, part, features=features)
    return with_halves(frame, one, needs=NEEDS)


def _checked(color: ArrayLike) -> Array:
    """Return the image in float32, if the filter can denoise it."""
    if missing := NEEDS.missing_package():
        raise ImportError(f"Open Image Denoise needs {missing}")
    image = jnp.asarray(color, jnp.float32)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"color must have shape [H,W,3], got {image.shape}")
    return image


@jax.custom_jvp
def _filter(color: Array, features: dict[str, Array]) -> Array:
    """Filter on the host, [H,W,3]."""
    shape = jax.ShapeDtypeStruct(color.shape, jnp.float32)
    return jax.pure_callback(_on_host, shape, color, features, vmap_method="sequential")


def _on_host(color: ArrayLike, features: dict[str, ArrayLike]) -> np.ndarray:
    """Filter NumPy arrays."""
    import pyoidn

    guides = {name: np.asarray(feature) for name, feature in features.items()}
    result = pyoidn.denoise(
        np.asarray(color), guides.get("albedo"), guides.get("normal"), hdr=True
    )
    return np.asarray(result, np.float32)


@_filter.defjvp
def _filter_jvp(
    primals: tuple[Array, dict[str, Array]], tangents: tuple[Array, dict[str, Array]]
) -> tuple[Array, Array]:
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
    at = lambda side: _filter(
        *jax.tree.map(lambda p, t: p + side * step * t, primals, tangents)
    )
    return _filter(*primals), (at(1.0) - at(-1.0)) / (2 * step)


def _fill(image: Array) -> Array:
    """Set invalid pixels to the mean of valid neighbours, ring by ring."""
    valid = finite(image)

    def ring(state: tuple[Array, Array]) -> tuple[Array, Array]:
        filled, known = state
        near = window_mean(filled, 3, mask=known)
        reached = window_max(known.astype(image.dtype), 3) > 0
        return jnp.where(known, filled, near), reached

    some_left = lambda state: jnp.any(state[1]) & ~jnp.all(state[1])
    start = jnp.where(valid, image, 0.0), valid
    return lax.while_loop(some_left, ring, start)[0]
