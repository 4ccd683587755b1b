"""What the networks are trained to lower; `metrics.smape` is the others' loss."""

import jax.numpy as jnp

from jscomb.learning.networks import compress
from jscomb.numerics.guards import check_same_shape
from jscomb.typing import Image, Scalar


def log_l2(image: Image, reference: Image, *, epsilon: float = 0.01) -> Scalar:
    """Relative squared error of signed logarithms.

    A noisy reference only adds to it what does not depend on the image, as long as its
    noise is small where it matters to the logarithm and the weight.

    Args:
        image: linear radiance at an exposure of one, shape [H,W,C].
        reference: likewise.
        epsilon: what keeps black pixels from deciding.

    Returns:
        the mean over the elements.

    Raises:
        ValueError: while tracing, if shapes differ.

    Example:
        >>> import jax.numpy as jnp
        >>> one = jnp.ones((2, 2, 3))
        >>> print(f"{log_l2(3 * one, one):.3f}")
        0.980

    Source: NJS eq. 14.
    """
    check_same_shape(image=image, reference=reference)
    found, truth = compress(image), compress(reference)
    weight = jnp.mean(jnp.square(truth), axis=-1, keepdims=True) + epsilon
    return jnp.mean(jnp.square(found - truth) / weight)
