"""Images, guarded: their exposure, invalid pixels, the range of the features."""

from typing import Any, get_args

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import ArrayLike

from jscomb.denoisers.oidn import _filter, _weights
from jscomb.denoisers.oidn._models import GUIDES, Model, Quality
from jscomb.frame import Needs
from jscomb.numerics.convolution import doubled
from jscomb.numerics.guards import check_image, finite
from jscomb.numerics.luminance import median_luminance
from jscomb.numerics.tiles import compiled
from jscomb.numerics.windows import window_max, window_mean

NEEDS = Needs(channels=3, normalised=True, package=_weights.PACKAGE)
EXPOSURE = 0.18  # of normalised radiance: the median luminance becomes middle grey

_LARGEST = 1e5  # normalised radiance; beyond, the filter's half floats overflow


def available() -> bool:
    """Return whether Open Image Denoise is installed.

    Returns:
        True if `denoise` can run.

    Example:
        >>> from jscomb import denoisers
        >>> denoiser = denoisers.oidn if available() else denoisers.bilateral
    """
    return not NEEDS.missing_package()


def pretrained(
    *,
    features: tuple[str, ...] = ("albedo", "normal"),
    clean: bool = False,
    quality: Quality = "high",
) -> Any:
    """Read a network's weights from the installed package.

    Args:
        features: names of those that guide it: (), ("albedo",) or both.
        clean: trained for features without noise; needs both.
        quality: "high", "balanced" or "fast", as the filter understands them.

    Returns:
        a `flax.nnx` module, a pytree of its weights: for `denoise_normalised`, and to
        be tuned.

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if there is no such network.
        RuntimeError: if the installed version's weights cannot be read.

    Example:
        >>> if available():
        ...     count = sum(a.size for a in jax.tree.leaves(pretrained()))
        ...     assert count == 919811
    """
    _check_installed()
    network = _weights.network(color_model(features, clean, quality))
    if network is None:
        raise RuntimeError(
            "the installed version of Open Image Denoise has no weights that can be "
            "read: pip install pyoidn==2.5.1.0"
        )
    return jax.tree.map(jnp.asarray, network)


def denoise(
    color: ArrayLike,
    *,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    clean: bool = False,
    quality: Quality = "high",
) -> Array:
    """Denoise one image.

    Args:
        color: linear radiance, shape [H,W,3]; may hold invalid pixels.
        albedo: shape [H,W,3], clipped to [0, 1] here; optional.
        normal: shape [H,W,3], components in [-1, 1]; optional, needs `albedo`.
        clean: the features are free of noise, such as those of `denoise_feature`; needs
            both.
        quality: "high", "balanced" or "fast".

    Returns:
        the denoised image, linear radiance, finite, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if a shape is wrong, or a feature is missing.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> noisy = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> if available():
        ...     assert jax.jit(denoise)(noisy).std() < 0.1 * noisy.std()
    """
    image = compiled(_fill)(_checked("color", color))  # NaN would spread by the unit
    unit = compiled(median_luminance)(image)
    options = {"clean": clean, "quality": quality}
    return unit * denoise_normalised(
        image / unit, albedo=albedo, normal=normal, **options
    )


def denoise_normalised(
    color: ArrayLike,
    *,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    clean: bool = False,
    quality: Quality = "high",
    network: Any = None,
) -> Array:
    """Denoise one normalised image.

    For halves and crops of a normalised frame, and for derivatives: those of `denoise`
    include its unit's, which follows the noise.

    Args:
        color: normalised radiance, shape [H,W,3]; may hold invalid pixels.
        albedo: shape [H,W,3], clipped to [0, 1] here; optional.
        normal: shape [H,W,3], components in [-1, 1]; optional, needs `albedo`.
        clean: as for `denoise`.
        quality: as for `denoise`.
        network: in place of the installed one, such as a tuned `pretrained`.

    Returns:
        the denoised image, normalised radiance, finite, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if a shape is wrong, or a feature is missing.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> noisy = jax.random.exponential(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> if available():
        ...     assert jax.jit(denoise_normalised)(noisy).std() < 0.1 * noisy.std()
    """
    image = _checked("color", color)
    guides = {"albedo": albedo, "normal": normal}
    features = {
        name: guarded(name, guide, image.shape)
        for name, guide in guides.items()
        if guide is not None
    }
    model = color_model(tuple(features), clean, quality)
    images = {"color": guarded("color", image, image.shape), **features}
    if network is not None:
        return _filter.apply(network, model, images, EXPOSURE)
    return _filter.run(model, images, EXPOSURE)


def denoise_feature(image: ArrayLike, name: str, *, quality: Quality = "high") -> Array:
    """Denoise an albedo or a normal.

    Args:
        image: shape [H,W,3]; may hold invalid pixels.
        name: "albedo" or "normal".
        quality: "high" or "balanced".

    Returns:
        the denoised feature, in its range, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if the shape is wrong, or there is no such feature.
        RuntimeError: if the filter reports a failure.

    Example:
        >>> albedo = jax.random.uniform(jax.random.key(0), (32, 32, 3), jnp.float32)
        >>> if available():
        ...     assert denoise_feature(albedo, "albedo").std() < 0.5 * albedo.std()
    """
    if name not in ("albedo", "normal"):
        raise ValueError(f"name must be 'albedo' or 'normal', got {name!r}")
    checked = _checked(name, image)
    level: Quality = "balanced" if quality == "fast" else quality
    model = Model((name,), quality=level, hdr=False)
    return _filter.run(model, {name: guarded(name, checked, checked.shape)}, 1.0)


def color_model(features: tuple[str, ...], clean: bool, quality: Quality) -> Model:
    """Return the model of linear radiance; raise if there is none."""
    if features not in GUIDES:
        raise ValueError(
            f"Open Image Denoise takes an albedo, or an albedo and a normal, got "
            f"{', '.join(features)}"
        )
    if clean and len(features) < 2:
        raise ValueError("clean needs albedo and normal")
    if quality not in get_args(Quality):
        raise ValueError(f"quality must be one of {get_args(Quality)}, got {quality!r}")
    return Model(("color", *features), clean=clean, quality=quality)


def guarded(name: str, image: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return an image that is finite and in its range, of the colour's shape."""
    array = jnp.asarray(image, jnp.float32)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, not {shape}")
    limits = {"color": (0.0, _LARGEST), "albedo": (0.0, 1.0), "normal": (-1.0, 1.0)}
    return jnp.clip(compiled(_fill)(array), *limits[name])


def _checked(name: str, image: ArrayLike) -> Array:
    """Return the image in float32, if the filter can denoise it."""
    _check_installed()
    array = jnp.asarray(image, jnp.float32)
    check_image(**{name: array})
    if array.shape[2] != 3 or array.size == 0:
        raise ValueError(f"{name} must have shape [H,W,3], got {array.shape}")
    return array


def _check_installed() -> None:
    """Raise if Open Image Denoise is missing."""
    if missing := NEEDS.missing_package():
        raise ImportError(f"Open Image Denoise needs {missing}")


def _fill(image: Array) -> Array:
    """Set invalid pixels to the mean of their valid neighbours, or of larger blocks."""
    valid = finite(image)
    known = jnp.where(valid, image, 0.0)
    return lax.cond(jnp.all(valid), lambda image, _: image, _filled, known, valid)


def _filled(image: Array, valid: Array) -> Array:
    """Fill the first ring of a hole from the pixels around it, the rest by blocks."""
    near = window_mean(image, 3, mask=valid)
    reached = window_max(valid.astype(image.dtype), 3) > 0
    return _by_blocks(jnp.where(valid, image, near), reached)


def _by_blocks(image: Array, valid: Array) -> Array:
    """Set invalid pixels to the mean of the smallest block with valid ones.

    Block sizes are powers of two; unlike a loop until all are filled, this has a
    reverse derivative.
    """
    height, width, _ = image.shape
    if height == width == 1:
        return jnp.where(valid, image, 0.0)
    ends = (0, height % 2), (0, width % 2), (0, 0)

    def summed(pixels: Array) -> Array:
        rows = jnp.pad(pixels, ends)
        rows = rows[::2] + rows[1::2]
        return rows[:, ::2] + rows[:, 1::2]

    count = summed(valid.astype(image.dtype))
    total = summed(jnp.where(valid, image, 0.0))
    coarse = _by_blocks(total / jnp.maximum(count, 1.0), count > 0)
    return jnp.where(valid, image, doubled(coarse)[:height, :width])
