r"""Least squares on the simplex: how much of each of N images to take.

Layout: N on the first axis, any batch axes behind it; every problem is solved on its
own. Notation:

    w      weights, at least zero, of sum one
    p_i    point of base i in the plane, (points_a_i, points_b_i)
    t      target, (target_b, target_a): the points of one half aim at the other half
    M      matrix, symmetric and positive semidefinite on differences of weights

    hull         minimum |sum_i w_i p_i - t|^2, exact: the point nearest to t of the
                 convex hull of the p_i
    quadratic    minimum w'Mw, exact
    affine       the same with weights of either sign
    iterative    the paper's solver, for comparison; also `iterative_quadratic`
    reference    jaxopt's OSQP in float64, for tests; also `reference_quadratic`

Adding a number to all elements of M changes w'Mw by that number, so it changes no
weights, and M itself need not be semidefinite.

Where a number of a problem is not finite all bases get the same weight.

The exact solvers are deterministic and differentiable: which weights are positive is
found without derivatives, then these weights are a formula. At a tie the derivative is
that of one of the best choices.

Sources:
    S. Zheng, F. Zheng, K. Xu, L.-Q. Yan, "Ensemble Denoising for Monte Carlo
    Renderings", 2021 (ED; eq. numbers below). Both exact solvers are ours; the search
    is a primal active-set method (J. Nocedal, S. Wright, "Numerical Optimization",
    section 16.5).
"""

from jscomb.numerics.simplex._hull import hull, two
from jscomb.numerics.simplex._iterative import iterative, iterative_quadratic
from jscomb.numerics.simplex._quadratic import affine, quadratic
from jscomb.numerics.simplex._reference import reference, reference_quadratic

__all__ = [
    "affine",
    "hull",
    "iterative",
    "iterative_quadratic",
    "quadratic",
    "reference",
    "reference_quadratic",
    "two",
]
