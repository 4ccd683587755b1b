"""Errors of an image against a reference.

Layout: images [H,W,C], linear radiance. Errors are means over pixels and channels.
Nothing is left out silently: a pixel that is not finite makes the error NaN or
infinite. A `mask` [H,W,1] says which pixels count; `numerics.guards.finite(image,
reference)` is the usual one, and the count of the others belongs beside the error.

`rel_l2`, `rmse`, `smape` and `dssim` are pure and differentiable. `flip` and `hdr_flip`
call NVIDIA's evaluator (extra `flip`) in a process of its own, because it ends the
whole process on some input.
"""

import importlib.util
import io
import subprocess
import sys
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jscomb.numerics.guards import check_same_shape, divide, finite
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image, Mask, Scalar

_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2


def rel_l2(
    image: Image,
    reference: Image,
    *,
    epsilon: float = 0.01,
    half_difference: Image | None = None,
    mask: Mask | None = None,
) -> Scalar:
    """Relative squared error: mean of (a-r)^2 / (mean_rgb(r)^2 + epsilon).

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: squared radiance that keeps black pixels from deciding.
        half_difference: difference of the reference's two independent halves, shape
            [H,W,C]. Then the part of the error that is the reference's own noise,
            mean of difference^2 / 4 / weight, is subtracted. The result may be
            slightly negative for an image as good as the reference.
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error, no unit.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(rel_l2(jnp.full((2, 2, 3), 1.1), jnp.ones((2, 2, 3))).round(4))
        0.0099

    Source: Rousselle et al. 2011; the form with the channels' mean is NJS's.
    """
    image, reference = _pair(image, reference, mask)
    weight = _grey_square(reference) + epsilon
    square = jnp.square(image - reference)
    if half_difference is not None:
        check_same_shape(reference=reference, half_difference=half_difference)
        square = square - jnp.square(_masked(mask, half_difference)) / 4
    return _mean(square / weight, mask)


class Change(NamedTuple):
    """An estimated change of an error, and how far to trust it.

    Attributes:
        mean: the estimate, shape []; negative where the error falls.
        standard_error: of the estimate over the frame's pixels, shape [].
    """

    mean: Scalar
    standard_error: Scalar

    @property
    def helps(self) -> Bool[Array, ""]:
        """Whether the error falls by more than the standard error."""
        return self.mean + self.standard_error < 0


def rel_l2_change(
    candidates: Float[Array, "2 h w c"],
    baselines: Float[Array, "2 h w c"],
    unbiased: Float[Array, "2 h w c"],
    *,
    epsilon: Scalar | float = 0.01,
    limit: float | None = None,
) -> Change:
    """Estimate from half buffers, without a reference, what a change does to the error.

    With z the candidate, y the baseline and x the unbiased image of independent halves,

        (z_a - x_b)^2 - (y_a - x_b)^2 = 2 (z_a - y_a) ((z_a + y_a) / 2 - x_b),

    whose expectation over x_b is the difference of the true squared errors: the noise
    of x_b cancels. Both directions, averaged over the whole frame; a single pixel's
    value is far too noisy to decide anything.

    Args:
        candidates: z made from each half, linear radiance, shape [2,H,W,C].
        baselines: y made from each half, likewise.
        unbiased: x of each half, likewise.
        epsilon: squared radiance that keeps black pixels from deciding, as in `rel_l2`.
        limit: how far x counts as away from the middle of z and y, in units of their
            radiance: so no firefly decides for the frame, but the estimate is biased,
            towards the darker image where noise is skewed. None for an unbiased one.

    Returns:
        relative L2 of the candidates less that of the baselines, relative to the mean
        radiance of both. Unbiased, for images made from one half. The standard error
        takes pixels as independent, and the spread of the true change over the frame
        for noise, so it is rather too large. Pixels that are not finite are left out;
        NaN if none is left.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> two = lambda value: jnp.full((2, 4, 4, 3), value)
        >>> change = rel_l2_change(two(1.1), two(1.2), two(1.0))
        >>> print(f"{change.mean:.4f}", change.helps)
        -0.0225 True
    """
    changes = []
    for half in (0, 1):
        z, y, x = candidates[half], baselines[half], unbiased[1 - half]
        check_same_shape(unbiased=x, candidates=z, baselines=y)
        middle = (z + y) / 2
        if limit is not None:
            reach = limit * _root(_grey_square(middle) + epsilon)
            x = middle + jnp.clip(x - middle, -reach, reach)
        square = 2 * (z - y) * (middle - x)
        changes.append(mean_change(square, middle, epsilon=epsilon))
    means, errors = (jnp.stack(i) for i in zip(*changes, strict=True))
    return Change(jnp.mean(means), _root(jnp.sum(jnp.square(errors))) / 2)


def mean_change(
    square: Image, baseline: Image, *, epsilon: Scalar | float = 0.01
) -> Change:
    """Mean over the frame of estimated changes of the squared error.

    Args:
        square: change of each pixel's squared error, squared radiance, shape [H,W,C].
        baseline: radiance that it is relative to, shape [H,W,C].
        epsilon: squared radiance that keeps black pixels from deciding.

    Returns:
        the change of the relative L2; pixels that are not finite are left out.

    Raises:
        ValueError: while tracing, if the shapes differ.

    Example:
        >>> change = mean_change(jnp.full((4, 4, 3), 0.03), jnp.ones((4, 4, 3)))
        >>> print(f"{change.mean:.4f}")
        0.0297
    """
    check_same_shape(square=square, baseline=baseline)
    mask = finite(square, baseline)
    square, baseline = _masked(mask, square), _masked(mask, baseline)
    weight = _grey_square(baseline) + epsilon
    change = jnp.mean(square / weight, axis=-1, keepdims=True)
    mean = _mean(change, mask)
    spread = _mean(jnp.square(change - mean), mask)
    return Change(mean, _root(spread / jnp.sum(mask).astype(mean.dtype)))


def rmse(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Root of the mean squared error.

    Args:
        image: linear radiance, shape [H,W,C].
        reference: linear radiance, shape [H,W,C].
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error in radiance. Its derivative at an error of zero is 0.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(f"{rmse(jnp.full((1, 1, 3), 3.0), jnp.ones((1, 1, 3))):.3f}")
        2.000
    """
    image, reference = _pair(image, reference, mask)
    square = _mean(jnp.square(image - reference), mask)
    return _root(square)


def smape(
    image: Image,
    reference: Image,
    *,
    epsilon: float = 0.001,
    mask: Mask | None = None,
) -> Scalar:
    """Symmetric mean absolute percentage error: |a-r| / (|a| + |r| + epsilon).

    Args:
        image: a, linear radiance, shape [H,W,C].
        reference: r, linear radiance, shape [H,W,C].
        epsilon: radiance that keeps black pixels from deciding.
        mask: pixels that count, shape [H,W,1].

    Returns:
        the error, in [0, 1].

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> print(f"{smape(jnp.full((1, 1, 3), 3.0), jnp.ones((1, 1, 3))):.3f}")
        0.500

    Source: DSC eq. 18 (epsilon 0.001).
    """
    image, reference = _pair(image, reference, mask)
    scale = jnp.abs(image) + jnp.abs(reference) + epsilon
    return _mean(jnp.abs(image - reference) / scale, mask)


def dssim(image: Image, reference: Image, *, mask: Mask | None = None) -> Scalar:
    """Structural dissimilarity (1 - SSIM) / 2 of the displayed images.

    Both are tone mapped (`tone_map`) first. Windows are Gaussian (11x11, sigma 1.5)
    and clipped to the image, so any size works.

    Args:
        image: linear radiance, shape [H,W,C].
        reference: linear radiance, shape [H,W,C].
        mask: pixels that count, and take part in windows, shape [H,W,1].

    Returns:
        the dissimilarity, 0 for equal images, at most 1.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import jax
        >>> stripes = jnp.tile(jnp.array([0.1, 0.4]), (8, 4))[..., None]
        >>> for image in (stripes, jnp.full_like(stripes, 0.2)):
        ...     print(f"{jax.jit(dssim)(image, stripes):.3f}")
        0.000
        0.487

    Source: Wang et al. 2004, "Image quality assessment".
    """
    image, reference = _pair(image, reference, mask)
    # The display would show an infinite pixel as white, and so hide it.
    bad = jnp.where(jnp.isfinite(image) & jnp.isfinite(reference), 0.0, jnp.nan)
    a, r = tone_map(image) + bad, tone_map(reference)

    def mean(i: Image) -> Image:
        return window_mean(i, _SSIM_WINDOW, mask=mask, sigma=_SSIM_SIGMA)

    mean_a, mean_r = mean(a), mean(r)
    var_a, var_r = mean(a * a) - mean_a**2, mean(r * r) - mean_r**2
    covariance = mean(a * r) - mean_a * mean_r
    ssim = (2 * mean_a * mean_r + _SSIM_C1) * (2 * covariance + _SSIM_C2)
    ssim /= (mean_a**2 + mean_r**2 + _SSIM_C1) * (var_a + var_r + _SSIM_C2)
    return _mean((1 - ssim) / 2, mask)


def tone_map(image: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Linear radiance to display values: filmic ACES curve, then the sRGB curve.

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
    """Mean FLIP error of the displayed images, as seen when flipping between them.

    Args:
        image: linear radiance, shape [H,W,3], tone mapped here (`tone_map`).
        reference: linear radiance, shape [H,W,3].

    Returns:
        the mean error in [0, 1]. Not differentiable, not for `jit`.

    Raises:
        ValueError: if a shape is wrong or a value is not finite.
        ImportError: if the evaluator is not installed.
        RuntimeError: if the evaluator fails; holds what it said.

    Example:
        >>> grey = np.full((16, 16, 3), 0.2)
        >>> if importlib.util.find_spec("flip_evaluator"):
        ...     assert flip(grey, grey) == 0 and flip(2 * grey, grey) > 0.1

    Source: Andersson et al. 2020.
    """
    return _run_flip(image, reference, "LDR")


def hdr_flip(image: ArrayLike, reference: ArrayLike) -> float:
    """Mean HDR-FLIP error: the greatest FLIP over a range of exposures.

    Args:
        image: linear radiance, shape [H,W,3]; negative values count as 0.
        reference: linear radiance, shape [H,W,3]; not all black, since the range of
            exposures comes from it.

    Returns:
        the mean error in [0, 1]. Not differentiable, not for `jit`.

    Raises:
        ValueError: if a shape is wrong, a value is not finite, or the reference is
            all black.
        ImportError: if the evaluator is not installed.
        RuntimeError: if the evaluator fails; holds what it said.

    Example:
        >>> grey = np.full((16, 16, 3), 0.2)
        >>> if importlib.util.find_spec("flip_evaluator"):
        ...     assert hdr_flip(grey, grey) == 0 and hdr_flip(2 * grey, grey) > 0.1

    Source: Andersson et al. 2021.
    """
    return _run_flip(image, reference, "HDR")


_FLIP_PROGRAM = """
import io, sys
import flip_evaluator, numpy
data = numpy.load(io.BytesIO(sys.stdin.buffer.read()))
_, error, _ = flip_evaluator.evaluate(
    data["reference"], data["image"], sys.argv[1], inputsRGB=sys.argv[1] == "LDR",
    applyMagma=False)
print("FLIP", repr(float(error)))
"""


def _run_flip(image: ArrayLike, reference: ArrayLike, dynamic_range: str) -> float:
    """Validate, then evaluate in another process, which some input would end."""
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
    done = subprocess.run(
        [sys.executable, "-c", _FLIP_PROGRAM, dynamic_range],
        input=payload.getvalue(),
        capture_output=True,
        check=False,
    )
    *_, word, value = (done.stdout.decode(errors="replace").split() or ["", ""])[-2:]
    if done.returncode or word != "FLIP":
        said = (done.stdout + done.stderr).decode(errors="replace").strip()
        raise RuntimeError(f"the FLIP evaluator failed ({done.returncode}): {said}")
    return float(value)


def _grey_square(image: Image) -> Array:
    """Squared mean of a pixel's channels, [H,W,1]."""
    return jnp.square(jnp.mean(image, axis=-1, keepdims=True))


def _root(square: Array) -> Array:
    """Square root with derivative 0 at 0; NaN stays NaN."""
    exact = square == 0
    return jnp.where(exact, 0.0, jnp.sqrt(jnp.where(exact, 1.0, square)))


def _pair(image: Image, reference: Image, mask: Mask | None) -> tuple[Image, Image]:
    """Image and reference of one shape, ready for arithmetic."""
    check_same_shape(image=image, reference=reference)
    return _masked(mask, image), _masked(mask, reference)


def _masked(mask: Mask | None, image: Image) -> Image:
    """The image with 0 where a pixel does not count, for finite derivatives."""
    return image if mask is None else jnp.where(mask, image, 0.0)


def _mean(values: Image, mask: Mask | None) -> Scalar:
    """Mean over pixels that count and all channels; NaN if there are none."""
    if mask is None:
        return jnp.mean(values)
    total = jnp.sum(jnp.where(mask, values, 0.0))
    count = jnp.sum(mask).astype(total.dtype) * values.shape[-1]
    return divide(total, count, where=count > 0, otherwise=jnp.nan)
