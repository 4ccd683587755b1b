r"""Screened Poisson: the image nearest to a given image and to given differences.

Layout: images [H,W,C], linear radiance; channels are solved separately. Notation:

    y       primal image, for example independent estimates
    g, h    differences to the right and to the lower neighbour, for example of
            correlated estimates: g_ij ~ u_i,j+1 - u_ij, [H,W-1,C]; h_ij ~ u_i+1,j -
            u_ij, [H-1,W,C]
    D       forward differences, none across the border (natural boundaries)
    alpha   weight of the primal image

    u = argmin alpha^2 |u - y|^2 + |D_x u - g|^2 + |D_y u - h|^2,
    (alpha^2 + D_x'D_x + D_y'D_y) u = alpha^2 y + D_x'g + D_y'h.

With natural boundaries the cosines of the type-2 transform are the eigenvectors and
2 - 2 cos(pi k / N) the eigenvalues along each axis, so a transform, a division and the
inverse transform solve the equation. Where values are missing they precondition
conjugate gradients, which take one step if none is.

Sources:
    P. Bhat, B. Curless, M. Cohen, C. Zitnick, "Fourier analysis of the 2D screened
    Poisson equation for gradient domain problems", 2008; IDU section 5 (L2
    reconstruction).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.fft import dctn, idctn
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float

from jscomb.numerics.guards import check_same_shape
from jscomb.typing import Image

__all__ = ["reconstruct"]

_STEPS = 100  # at most, of conjugate gradients


def reconstruct(
    primal: Image,
    gradient_x: Float[Array, "_ _ _"],
    gradient_y: Float[Array, "_ _ _"],
    *,
    alpha: float = 0.2,
) -> Image:
    """Return the image of least squared distance from a primal image and gradients.

    Linear in the arrays and differentiable. A value that is not finite is excluded,
    without its neighbours. Transforms couple all pixels, so rounding errors are
    relative to the frame's largest value.

    Args:
        primal: y, linear radiance, shape [H,W,C].
        gradient_x: g, differences to the right neighbour, shape [H,W-1,C].
        gradient_y: h, differences to the neighbour below, shape [H-1,W,C].
        alpha: > 0, weight of the primal image relative to the gradients.

    Returns:
        u, linear radiance, shape [H,W,C]; 0 at pixels without any finite value. If all
        values are finite its mean is that of y.

    Raises:
        ValueError: while tracing, if shapes do not fit or `alpha` is not positive.

    Example:
        >>> y = jnp.array([0.0, 3.0, 0.0]).reshape(1, 3, 1)
        >>> flat = jnp.zeros((1, 2, 1)), jnp.zeros((0, 3, 1))
        >>> print([f"{v:.3f}" for v in reconstruct(y, *flat, alpha=1.0).ravel()])
        ['0.750', '1.500', '0.750']

    Source: IDU section 5 (L2 reconstruction).
    """
    check_same_shape(primal=primal)
    h, w, c = primal.shape
    if not alpha > 0:
        raise ValueError(f"alpha must be positive, got {alpha}")
    for name, array, shape in (
        ("gradient_x", gradient_x, (h, w - 1, c)),
        ("gradient_y", gradient_y, (h - 1, w, c)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    given = primal, gradient_x, gradient_y
    return _solve(given, jax.tree.map(jnp.isfinite, given), alpha)


Rows = tuple[Array, Array, Array]  # an equation for each value of y, g and h


def _solve(given: Rows, known: tuple[Bool[Array, "..."], ...], alpha: float) -> Image:
    """The least squares solution for the known values."""
    only_known = lambda rows: jax.tree.map(
        lambda mask, row: jnp.where(mask, row, 0.0), known, rows
    )
    rows = lambda u: (alpha * u, jnp.diff(u, axis=1), jnp.diff(u, axis=0))
    transposed = jax.linear_transpose(rows, given[0])
    normal = lambda u: transposed(only_known(rows(u)))[0]

    primal, *gradients = only_known(given)
    (right,) = transposed((alpha * primal, *gradients))
    # In units of its largest value, whose square may leave the range of float32.
    largest = jnp.max(jnp.abs(lax.stop_gradient(right)))
    unit = jnp.where(largest > 0, largest, 1.0)
    u, _ = cg(
        normal,
        right / unit,
        tol=10 * float(jnp.finfo(right.dtype).eps),
        maxiter=_STEPS,
        M=lambda right: _cosine_solve(right, alpha),
    )
    return jnp.where(_touched(*known), unit * u, 0.0)


def _cosine_solve(right: Image, alpha: float) -> Image:
    """The solution where every value is known."""
    across, down = (
        2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in right.shape[1::-1]
    )
    eigenvalues = (alpha**2 + np.add.outer(down, across))[..., None]
    inverse = jnp.asarray(1 / eigenvalues, right.dtype)
    return idctn(inverse * dctn(right, axes=(0, 1)), axes=(0, 1))


def _touched(primal: Array, gradient_x: Array, gradient_y: Array) -> Bool[Array, "..."]:
    """Pixels with a known value of their own or a known difference to a neighbour."""
    for axis, gradient in ((1, gradient_x), (0, gradient_y)):
        for side in ((1, 0), (0, 1)):
            ends = [side if a == axis else (0, 0) for a in range(3)]
            primal = primal | jnp.pad(gradient, ends)
    return primal
