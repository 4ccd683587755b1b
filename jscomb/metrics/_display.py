"""Errors of the displayed image.

Layout: images [H,W,C], linear radiance, tone mapped here. `psnr`, `ssim` and `dssim`
are pure and differentiable. `flip`, `hdr_flip` and their maps call NVIDIA's evaluator
(extra `flip`) in another process, because on some input it ends the process.
"""

import importlib.util
import io
import os
import pathlib
import subprocess
import sys
import tempfile

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jscomb.metrics._errors import counted, mean
from jscomb.numerics.tiles import in_memory
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Mask, Scalar

_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2


def psnr(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Return the peak signal-to-noise ratio of the displayed images.

    Both are tone mapped (`tone_map`) first, so that the peak is 1.

    Args:
        image: linear radiance, shape [H,W,C].
        reference: linear radiance, shape [H,W,C].
        mask: pixels that count, shape [H,W,1].

    Returns:
        the ratio in decibels, -10 log10 of the mean squared error; infinite for equal
        images, where its derivative is 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> grey = jnp.full((4, 4, 1), 0.18)
        >>> print(f"{psnr(grey, grey):.1f} {psnr(1.1 * grey, grey):.1f}")
        inf 31.3
    """
    a, r = _displayed(mask, image=image, reference=reference)
    error = mean(jnp.square(a - r), mask)
    none = error <= 0
    return jnp.where(none, jnp.inf, -10 * jnp.log10(jnp.where(none, 1.0, error)))


def ssim(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Return the structural similarity of the displayed images.

    Both are tone mapped (`tone_map`) first. Windows are Gaussian (11x11, sigma 1.5)
    and clipped to the image, so any size works.

    Args:
        image: linear radiance, shape [H,W,C].
        reference: linear radiance, shape [H,W,C].
        mask: pixels that count, also within windows, shape [H,W,1].

    Returns:
        the similarity, 1 for equal images, at least -1.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import jax
        >>> stripes = jnp.tile(jnp.array([0.1, 0.4]), (8, 4))[..., None]
        >>> for image in (stripes, jnp.full_like(stripes, 0.2)):
        ...     print(f"{jax.jit(ssim)(image, stripes):.3f}")
        1.000
        0.026

    Source: Wang et al. 2004, "Image quality assessment".
    """
    a, r = in_memory(*_displayed(mask, image=image, reference=reference))

    def local(i: Image) -> Image:
        return window_mean(i, _SSIM_WINDOW, mask=mask, sigma=_SSIM_SIGMA)

    mean_a, mean_r = local(a), local(r)
    var_a, var_r = local(a * a) - mean_a**2, local(r * r) - mean_r**2
    covariance = local(a * r) - mean_a * mean_r
    similar = (2 * mean_a * mean_r + _SSIM_C1) * (2 * covariance + _SSIM_C2)
    similar /= (mean_a**2 + mean_r**2 + _SSIM_C1) * (var_a + var_r + _SSIM_C2)
    return mean(similar, mask)


def dssim(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Return the structural dissimilarity (1 - SSIM) / 2 of the displayed images.

    Args:
        image: as for `ssim`.
        reference: as for `ssim`.
        mask: as for `ssim`.

    Returns:
        the dissimilarity, 0 for equal images, at most 1.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> stripes = jnp.tile(jnp.array([0.1, 0.4]), (8, 4))[..., None]
        >>> print(f"{dssim(jnp.full_like(stripes, 0.2), stripes):.3f}")
        0.487
    """
    return (1 - ssim(image, reference, mask=mask)) / 2


def _displayed(mask: Mask | None, **images: Image) -> tuple[Image, ...]:
    """Display values of a pair of images; not a number where either is not finite."""
    image, reference = counted(mask, **images)
    # Tone mapping would show an infinite pixel as white.
    bad = jnp.where(jnp.isfinite(image) & jnp.isfinite(reference), 0.0, jnp.nan)
    return tone_map(image) + bad, tone_map(reference)


def tone_map(image: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Map linear radiance to display values: filmic ACES curve, then sRGB curve.

    Args:
        image: linear radiance, any shape; negative values count as 0.

    Returns:
        display values in [0, 1], same shape.

    Example:
        >>> shown = tone_map(jnp.array([0.0, 0.18, 1.0, 10.0]))
        >>> print([f"{value:.3f}" for value in shown])
        ['0.000', '0.553', '0.908', '1.000']

    Source: K. Narkowicz, "ACES filmic tone mapping curve", 2015; IEC 61966-2-1.
    """
    x = jnp.clip(image, 0, 1e6)  # above, the curve is flat and its squares overflow
    aces = jnp.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    bright = aces > 0.0031308
    power = jnp.where(bright, aces, 1.0) ** (1 / 2.4)
    return jnp.where(bright, 1.055 * power - 0.055, 12.92 * aces)


def flip(image: ArrayLike, reference: ArrayLike) -> float:
    """Return the mean FLIP error, visible when flipping between displayed images.

    Args:
        image: linear radiance, shape [H,W,3], tone mapped here (`tone_map`).
        reference: linear radiance, shape [H,W,3].

    Returns:
        the mean error in [0, 1]. Not differentiable, not for `jit`.

    Raises:
        ValueError: if a shape is wrong or a value is not finite.
        ImportError: if the evaluator is not installed.
        RuntimeError: if the evaluator fails; contains its output.

    Example:
        >>> grey = np.full((16, 16, 3), 0.2)
        >>> if importlib.util.find_spec("flip_evaluator"):
        ...     assert flip(grey, grey) == 0 and flip(2 * grey, grey) > 0.1

    Source: Andersson et al. 2020.
    """
    return float(flip_map(image, reference).mean())


def hdr_flip(image: ArrayLike, reference: ArrayLike) -> float:
    """Return the mean HDR-FLIP error: each pixel's maximum over display exposures.

    Args:
        image: linear radiance, shape [H,W,3]; negative values count as 0.
        reference: linear radiance, shape [H,W,3]; sets the range of exposures, so not
            all black.

    Returns:
        the mean error in [0, 1]. Not differentiable, not for `jit`.

    Raises:
        ValueError: if a shape is wrong, a value is not finite, or the reference is
            all black.
        ImportError: if the evaluator is not installed.
        RuntimeError: if the evaluator fails; contains its output.

    Example:
        >>> grey = np.full((16, 16, 3), 0.2)
        >>> if importlib.util.find_spec("flip_evaluator"):
        ...     assert hdr_flip(grey, grey) == 0 and hdr_flip(2 * grey, grey) > 0.1

    Source: Andersson et al. 2021.
    """
    return float(hdr_flip_map(image, reference).mean())


def flip_map(image: ArrayLike, reference: ArrayLike) -> np.ndarray:
    """Return the FLIP error of every pixel.

    Args:
        image: as for `flip`.
        reference: as for `flip`.

    Returns:
        the errors in [0, 1], shape [H,W,1].

    Raises:
        ValueError: as `flip`.
        ImportError: as `flip`.
        RuntimeError: as `flip`.

    Example:
        >>> grey = np.full((16, 16, 3), 0.2)
        >>> if importlib.util.find_spec("flip_evaluator"):
        ...     assert flip_map(grey, grey).shape == (16, 16, 1)
    """
    return _run_flip(image, reference, "LDR")


def hdr_flip_map(image: ArrayLike, reference: ArrayLike) -> np.ndarray:
    """Return the HDR-FLIP error of every pixel.

    Args:
        image: as for `hdr_flip`.
        reference: as for `hdr_flip`.

    Returns:
        the errors in [0, 1], shape [H,W,1].

    Raises:
        ValueError: as `hdr_flip`.
        ImportError: as `hdr_flip`.
        RuntimeError: as `hdr_flip`.

    Example:
        >>> grey = np.full((16, 16, 3), 0.2)
        >>> if importlib.util.find_spec("flip_evaluator"):
        ...     assert hdr_flip_map(grey, grey).shape == (16, 16, 1)
    """
    return _run_flip(image, reference, "HDR")


_FLIP_PROGRAM = """
import io, sys
import flip_evaluator, numpy
data = numpy.load(io.BytesIO(sys.stdin.buffer.read()))
errors, *_ = flip_evaluator.evaluate(
    data["reference"], data["image"], sys.argv[1], inputsRGB=sys.argv[1] == "LDR",
    applyMagma=False, computeMeanError=False)
numpy.save(sys.argv[2], errors)
"""


def _run_flip(image: ArrayLike, reference: ArrayLike, dynamic_range: str) -> np.ndarray:
    """Validate and evaluate in another process."""
    arrays = {"image": np.asarray(image), "reference": np.asarray(reference)}
    for name, array in arrays.items():
        if array.shape != arrays["image"].shape or array.shape[2:] != (3,):
            shapes = [a.shape for a in arrays.values()]
            raise ValueError(f"image and reference must be [H,W,3], got {shapes}")
        if array.size == 0 or not np.isfinite(array).all():
            raise ValueError(f"{name} must have pixels and be finite for FLIP")
    if dynamic_range == "LDR":
        arrays = {name: tone_map(jnp.asarray(a)) for name, a in arrays.items()}
    elif not (arrays["reference"] > 0).any():
        raise ValueError("reference is all black: HDR-FLIP finds no exposure for it")
    if importlib.util.find_spec("flip_evaluator") is None:
        raise ImportError('FLIP needs its evaluator: pip install "jscomb[flip]"')
    payload = io.BytesIO()
    clipped = {n: np.maximum(np.asarray(a, np.float32), 0) for n, a in arrays.items()}
    np.savez(payload, **clipped)  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as folder:
        made = pathlib.Path(folder, "errors.npy")
        done = subprocess.run(
            [sys.executable, "-c", _FLIP_PROGRAM, dynamic_range, os.fspath(made)],
            input=payload.getvalue(),
            capture_output=True,
            check=False,
        )
        if done.returncode or not made.exists():
            output = (done.stdout + done.stderr).decode(errors="replace").strip()
            raise RuntimeError(
                f"the FLIP evaluator failed ({done.returncode}): {output}"
            )
        height, width, _ = arrays["image"].shape
        return np.load(made).reshape(height, width, 1)
