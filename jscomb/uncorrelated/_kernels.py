"""Kernels: weights as a function of the differences of B sub-averages.

A kernel takes B arrays of one shape, the differences D_ci z^1, ..., D_ci z^B, or those
of y, or of both, and returns weights in [0, 1] of that shape, elementwise.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jscomb.numerics.medians import median_of
from jscomb.typing import Key, Scalar
from jscomb.uncorrelated._pairs import Samples, check_rate

Kernel = Callable[..., Array]

_TRIALS = 4096


def variance_kernel(gamma: Scalar | float, samples: Samples) -> Kernel:
    """Return the paper's kernel: less weight where sub-averages differ more.

    For any number of sub-averages the square is twice their sample variance: the mean
    square of the pairs' differences, of the same expectation and less noise the more
    there are.

    Args:
        gamma: at least zero, per squared radiance.
        samples: n, samples a pixel in each sub-average, at least 1.

    Returns:
        a kernel of two differences or more.

    Raises:
        ValueError: if gamma is negative or `samples` is less than 1.

    Example:
        >>> kernel = variance_kernel(0.01, 8)
        >>> weights = kernel(jnp.array([1.0, 1.0]), jnp.array([1.0, 4.0]))
        >>> print([f"{w:.3f}" for w in weights])
        ['1.000', '0.487']

    Source: IDU eq. 8.
    """
    check_rate(gamma, samples)

    def kernel(*differences: Array) -> Array:
        first, *others = differences
        rate, count = rate_of(gamma, samples, first.dtype), len(differences)
        if count == 2:  # the same in fewer operations
            return jnp.exp(-rate * jnp.square(first - others[0]))
        mean = sum(others, start=first) / count
        square = sum(jnp.square(d - mean) for d in differences)
        return jnp.exp(-2 * rate / (count - 1) * square)

    return kernel


def median_kernel(gamma: Scalar | float, samples: Samples) -> Kernel:
    """Return a kernel by the median square of the pairs' differences.

    One sub-average with a firefly hardly changes the median where there are at least
    five: less than half of the pairs have it. A pixel keeps the weight that the others
    give it.

    Args:
        gamma: at least zero, per squared radiance.
        samples: n, samples a pixel in each sub-average, at least 1.

    Returns:
        a kernel of two differences or more; of two the paper's.

    Raises:
        ValueError: if gamma is negative or `samples` is less than 1.

    Example:
        >>> kernel = median_kernel(1.0, 1)
        >>> one, firefly = jnp.ones(1), jnp.full(1, 1e6)
        >>> print(kernel(one, one, one, one, firefly))
        [1.]

    Source: ours, after IDU eq. 8; admissible by theorem 2.
    """
    check_rate(gamma, samples)

    def kernel(*differences: Array) -> Array:
        pairs = itertools.combinations(differences, 2)
        square = median_of(jnp.stack([jnp.square(d - e) for d, e in pairs]))
        return jnp.exp(-rate_of(gamma, samples, square.dtype) * square)

    return kernel


def rate_of(gamma: Scalar | float, samples: Samples, dtype: jnp.dtype | type) -> Scalar:
    """Gamma n, the factor of a squared difference, per squared radiance."""
    return jnp.asarray(gamma, dtype) * jnp.asarray(samples, dtype)


class Admissibility(NamedTuple):
    """What theorem 2 demands of a kernel: both are zero up to rounding.

    Attributes:
        shift: maximum change of a weight when a constant is added to all differences.
        sign: maximum change of a weight when all differences change sign.
    """

    shift: Scalar
    sign: Scalar


def admissibility(
    key: Key, kernel: Kernel, *, sub_averages: int = 2, scale: float = 1.0
) -> Admissibility:
    """Test a kernel on random differences.

    Args:
        key: of the differences and the constants.
        kernel: of `sub_averages` arrays.
        sub_averages: B.
        scale: typical size of the differences, linear radiance: where weights fall.

    Returns:
        how far the kernel is from what makes a combination unbiased.

    Example:
        >>> by_noise = lambda first, second: jnp.exp(-((first - second) ** 2))
        >>> by_mean = lambda first, second: jnp.exp(-((first + second) ** 2))
        >>> for kernel in (by_noise, by_mean):
        ...     found = admissibility(jax.random.key(0), kernel)
        ...     print(f"{found.shift:.1f} {found.sign:.1f}")
        0.0 0.0
        1.0 0.0

    Source: IDU eq. 7.
    """
    of_size, of_differences, of_constants = jax.random.split(key, 3)
    # Over four decades: a kernel may fail at any size.
    size = scale * 10 ** jax.random.uniform(of_size, (_TRIALS,), minval=-2, maxval=2)
    shape = (sub_averages, _TRIALS)
    differences = size[None] * jax.random.normal(of_differences, shape)
    constants = size * jax.random.normal(of_constants, (_TRIALS,))
    weights = kernel(*differences)
    return Admissibility(
        jnp.max(jnp.abs(kernel(*(differences + constants[None])) - weights)),
        jnp.max(jnp.abs(kernel(*-differences) - weights)),
    )
