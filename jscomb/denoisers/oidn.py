"""Open Image Denoise, guarded: exposure, invalid pixels, halves.

The filter is not scale-equivariant at very low radiance, one infinite pixel spreads
far, and NaN counts as black. So the image is brought to an exposure of one first (and
back after), and each pixel that is not finite is filled from its neighbours before the
filter sees it. Images [H,W,3], linear radiance. NumPy at the edge: not for `jit`.

Needs the extra `oidn` (`pip install "jscomb[oidn]"`).
"""

import importlib.util

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import ArrayLike

from jscomb.denoisers.parts import of_parts
from jscomb.frame import Biased, Frame, make_frame
from jscomb.numerics.guards import finite
from jscomb.numerics.windows import window_mean

_LARGEST = 1e5  # radiance over exposure; beyond, the filter's half floats overflow


def available() -> bool:
    """Whether Open Image Denoise is installed.

    Returns:
        True if `denoise` can run.
    """
    return importlib.util.find_spec("pyoidn") is not None


def denoise(
    color: ArrayLike,
    *,
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    exposure: ArrayLike | None = None,
) -> Array:
    """Denoise one image.

    Args:
        color: linear radiance, shape [H,W,3]; may hold pixels that are not finite.
        albedo: shape [H,W,3], clipped to [0, 1] here; optional.
        normal: shape [H,W,3], components in [-1, 1]; optional, needs `albedo`.
        exposure: a radiance typical of the image, such as `Frame.exposure`; computed
            from `color` if None.

    Returns:
        the denoised image, linear radiance, finite, float32, shape [H,W,3].

    Raises:
        ImportError: if Open Image Denoise is not installed; says how to install it.
        ValueError: if a shape is wrong, or a normal comes without an albedo.
        RuntimeError: if the filter reports a failure.
    """
    if not available():
        raise ImportError('Open Image Denoise is missing: pip install "jscomb[oidn]"')
    import pyoidn

    image = jnp.asarray(color, jnp.float32)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"color must have shape [H,W,3], got {image.shape}")
    if normal is not None and albedo is None:
        raise ValueError("normal needs albedo: Open Image Denoise takes both or albedo")
    features = {}
    for name, feature, least in (("albedo", albedo, 0.0), ("normal", normal, -1.0)):
        if feature is not None:
            clean = _fill(jnp.asarray(feature, jnp.float32))
            if clean.shape != image.shape:
                raise ValueError(f"{name} has shape {clean.shape}, not {image.shape}")
            features[name] = np.asarray(jnp.clip(clean, least, 1.0))
    scale = make_frame(image).exposure if exposure is None else jnp.asarray(exposure)
    scaled = jnp.clip(_fill(image) / scale, 0.0, _LARGEST)
    result = pyoidn.denoise(np.asarray(scaled), hdr=True, **features)
    return jnp.asarray(result) * scale


def denoise_frame(frame: Frame, *, features: bool = True) -> Biased:
    """Denoise a frame, and each of its halves by itself where it has sub-buffers.

    Args:
        frame: with colour of three channels; its albedo and normal guide the filter.
        features: use them.

    Returns:
        the denoised full frame, and halves (None if the frame has no sub-buffers).

    Raises:
        ImportError: if Open Image Denoise is not installed.
        ValueError: if the colour does not have three channels.
        RuntimeError: if the filter reports a failure.
    """

    def one(part: Frame) -> Array:
        albedo = part.albedo if features else None
        normal = None if albedo is None else part.normal
        return denoise(
            part.color, albedo=albedo, normal=normal, exposure=frame.exposure
        )

    return of_parts(frame, one, variance=False)


def _fill(image: Array) -> Array:
    """Pixels that are not finite become the mean of a window of finite ones."""
    valid = finite(image)
    filled = jnp.where(valid, image, 0.0)
    missing, window = ~valid, 3
    while bool(missing.any()) and bool(valid.any()) and window < 2 * max(image.shape):
        near = window_mean(image, window, mask=valid)
        reached = window_mean(valid.astype(image.dtype), window) > 0
        filled = jnp.where(missing & reached, near, filled)
        missing, window = missing & ~reached, 2 * window + 1
    return filled
