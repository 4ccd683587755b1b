r"""RDFC-style filter: non-local means that compares features as well.

A pixel counts as far as both its surroundings *and* its features are similar:

    w_pq = min(w_pq of non-local means on the radiance, w_pq of the features)

The original has three such candidates, sensitive to the colour, less to its noise, and
to the features alone, and takes at each pixel the one of minimum estimated error.
`denoise` is one of them, for an ensemble to mix; `denoise_selected` selects, by SURE:

    risk_k     SURE of candidate k, averaged by the weights of the first one
    share_k    1 where risk_k is the minimum, averaged in the same way
    result     sum_k share_k y_k, the shares of sum one

Source: F. Rousselle, M. Manzi, M. Zwicker, "Robust denoising using feature and color
information", 2013.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb.denoisers import nonlocal_means
from jscomb.features import stack
from jscomb.frame import Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import check_same_shape, repeat_channel
from jscomb.numerics.sure import monte_carlo_sure
from jscomb.numerics.tiles import Local, compiled
from jscomb.numerics.weights import (
    Weights,
    feature_weights,
    gaussian_weights,
    minimum_of,
    weighted_mean,
)
from jscomb.typing import Image, Key, Variance

__all__ = [
    "CANDIDATES",
    "NEEDS",
    "Candidate",
    "denoise",
    "denoise_frame",
    "denoise_selected",
    "denoise_selected_frame",
    "plan_frame",
    "reach",
]

NEEDS = Needs(variance=True)

_SLOPE_LIMIT = 1.0  # no mean follows a pixel by more than its own noise


def denoise(
    image: Image,
    guide: Image,
    variance: Variance,
    features: Float[Array, "h w f"],
    *,
    window: int = 21,
    patch: int = 7,
    strength: float = 0.5,
    strength_features: float = 0.6,
) -> Image:
    """Replace each pixel by the mean of those with similar patches and features.

    Pure, differentiable in every array, and scale-equivariant.

    Args:
        image: radiance, shape [H,W,C]; the guide, or the other half.
        guide: radiance whose patches are compared, shape [H,W,C].
        variance: of the mean of the guide, squared radiance, shape [H,W,C].
        features: of a range of about one, shape [H,W,F]; F may be 0.
        window: width in pixels of the window that is searched, odd.
        patch: width in pixels of the patches, odd.
        strength: > 0, of the radiance; a larger one averages more, infinity compares
            the features alone.
        strength_features: > 0, of the features.

    Returns:
        the mean, shape [H,W,C]. Invalid pixels are excluded; there the result is the
        image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, a width is even or a strength is
            not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.array([1.0, 1.2, 1.4, 5.0]).reshape(1, 4, 1)
        >>> depth = jnp.array([0.0, 1.0, 1.0, 1.0]).reshape(1, 4, 1)
        >>> v = jnp.full_like(image, 0.04)
        >>> y = denoise(image, image, v, depth, window=7, patch=1)
        >>> print([f"{value:.2f}" for value in y.ravel()])
        ['1.00', '1.30', '1.30', '5.00']
    """
    variance = repeat_channel(variance, guide)
    check_same_shape(image=image, guide=guide, variance=variance)
    if features.shape[:2] != image.shape[:2]:
        raise ValueError(f"features has shape {features.shape}, image {image.shape}")
    candidate = Candidate(patch, strength, strength_features)
    weights = _weights(guide, variance, features, candidate)
    return weighted_mean(image, weights, window=window)


class Candidate(NamedTuple):
    """One of the filters to select from.

    Attributes:
        patch: width in pixels of the patches, odd.
        strength: of the radiance; infinity for the features alone.
        strength_features: of the features.
    """

    patch: int
    strength: float
    strength_features: float = 0.6


CANDIDATES = (Candidate(3, 0.45), Candidate(7, 0.45), Candidate(7, math.inf))
"""Sensitive to the colour, more robust against its noise, and to features alone."""


def denoise_selected(
    key: Key,
    image: Image,
    variance: Variance,
    features: Float[Array, "h w f"],
    *,
    window: int = 21,
    candidates: Sequence[Candidate] = CANDIDATES,
) -> Image:
    """Denoise by several filters, and take the one of minimum estimated error.

    Scale-equivariant. Takes two filters and a derivative for each candidate.

    Args:
        key: of SURE's probe.
        image: x, radiance, shape [H,W,C].
        variance: of the mean x, squared radiance, shape [H,W,C].
        features: of a range of about one, shape [H,W,F]; F may be 0.
        window: width in pixels of the window that is searched, odd.
        candidates: the filters; the first also filters risks and shares.

    Returns:
        the mean of the candidates by their shares, shape [H,W,C]; at an invalid pixel
        the image where it is finite, else 0.

    Raises:
        ValueError: while tracing, if shapes differ, a width is even or there is no
            candidate.

    Example:
        >>> import jax
        >>> import numpy as np
        >>> x = jnp.asarray(np.random.default_rng(0).normal(1, 0.5, (16, 16, 1)))
        >>> v, none = jnp.full_like(x, 0.25), x[..., :0]
        >>> made = denoise_selected(jax.random.key(0), x, v, none, window=9)
        >>> print(made.std() < 0.2 * x.std())
        True

    Source: Rousselle et al. 2013, section 5; the divergence of SURE by a random probe.
    """
    if not candidates:
        raise ValueError("there must be a candidate, got none")
    variance = repeat_channel(variance, image)
    every, risks = [], []
    for of_probe, candidate in zip(
        jax.random.split(key, len(candidates)), candidates, strict=True
    ):

        def filtered(noisy: Image, candidate: Candidate = candidate) -> Image:
            return denoise(
                noisy, noisy, variance, features, window=window, **candidate._asdict()
            )

        found = monte_carlo_sure(
            of_probe, filtered, image, variance, slope_limit=_SLOPE_LIMIT
        )
        every.append(found.denoised)
        risks.append(jnp.mean(found.squared_error, axis=-1))
    weights = _weights(image, variance, features, candidates[0])
    risk = weighted_mean(jnp.stack(risks, axis=-1), weights, window=window)
    best = jnp.argmin(risk, axis=-1)
    chosen = jax.nn.one_hot(best, len(candidates), dtype=image.dtype)
    shares = weighted_mean(chosen, weights, window=window)
    return sum(
        (shares[..., k, None] * y for k, y in enumerate(every)),
        start=jnp.zeros_like(image),
    )


def _weights(
    guide: Image,
    variance: Variance,
    features: Float[Array, "h w f"],
    candidate: Candidate,
) -> Weights:
    """The weights of a filter: the minimum of those by colour and by features."""
    patch, strength, of_features = candidate
    kinds = []
    if not math.isinf(strength):
        kinds.append(
            nonlocal_means.weights(guide, variance, patch=patch, strength=strength)
        )
    if features.shape[-1]:
        kinds.append(feature_weights(features, strength=of_features))
    if not kinds:
        return gaussian_weights(jnp.zeros_like(guide), 1.0)
    return functools.reduce(minimum_of, kinds)


def reach(*, window: int = 21, patch: int = 7) -> int:
    """Return the distance in pixels that `denoise` depends on.

    Features reach no farther than half the window: their gradient, one pixel, is taken
    at its centre only.

    Args:
        window: width in pixels of the window that is searched, odd, at least 3.
        patch: width in pixels of the patches, odd.

    Returns:
        that of non-local means.

    Example:
        >>> reach(window=21, patch=7)
        13
    """
    return nonlocal_means.reach(window=window, patch=patch)


def denoise_frame(frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame, guided by those of albedo, normal and depth that it has.

    Visibility is a Monte Carlo estimate, whose noise would look like edges: not used.

    Args:
        frame: with variances, or sub-buffers to estimate them from.
        window: width in pixels, odd.

    Returns:
        the estimate.

    Raises:
        ValueError: if the frame has no variance, or `window` is even.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> frame = make_frame(noise, variance=np.full_like(noise, 0.25))
        >>> made = denoise_frame(frame, window=9)
        >>> print([f"{i.std():.2f}" for i in (frame.color, made.image, made.halves)])
        ['0.36', '0.06', '0.09']
    """
    frame.require("rdfc", NEEDS)
    image = lambda part: plan_frame(part, window=window).whole()
    return with_halves(frame, image, needs=NEEDS)


def denoise_selected_frame(key: Key, frame: Frame, *, window: int = 21) -> Estimate:
    """Denoise a frame by `denoise_selected`, guided as `denoise_frame`.

    Args:
        key: of SURE's probe, which the halves share.
        frame: with variances, or sub-buffers to estimate them from.
        window: width in pixels, odd.

    Returns:
        the estimate.

    Raises:
        ValueError: if the frame has no variance, or `window` is even.

    Example:
        >>> import numpy as np
        >>> from jscomb.frame import make_frame
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> frame = make_frame(noise, variance=np.full_like(noise, 0.25))
        >>> made = denoise_selected_frame(jax.random.key(0), frame, window=9)
        >>> print(made.image.std() < 0.3 * frame.color.std())
        True

    Source: Rousselle et al. 2013.
    """
    frame.require("rdfc", NEEDS)
    run = compiled(denoise_selected, window=window)

    def one(part: Frame) -> Image:
        return run(jax.random.clone(key), part.color, part.variance, _features(part))

    return with_halves(frame, one, needs=NEEDS)


def _features(frame: Frame) -> Image:
    """Albedo, normal and depth, which have little noise."""
    return stack(frame._replace(buffers=frame.buffers._replace(visibility=None)))


def plan_frame(frame: Frame, *, window: int = 21) -> Local:
    """Return `denoise_frame` as a local function of images, for crops.

    Args:
        frame: as for `denoise_frame`.
        window: width in pixels, odd.

    Returns:
        the function, its images and how far it sees.

    Example:
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> one = jnp.ones((2, 4, 4, 1))
        >>> print(plan_frame(make_frame(one, variance=one)).halo)
        13
    """
    run = compiled(denoise, window=window)
    images = frame.color, frame.variance, _features(frame)
    return Local(lambda i: run(i[0], *i), images, reach(window=window))
