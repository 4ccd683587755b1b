r"""Least squares on the simplex: how much of each of N images to take.

Layout: N on the first axis, any batch axes behind it; every problem is solved by
itself. Notation:

    w      weights, at least zero, of sum one
    p_i    point of base i in the plane, (points_a_i, points_b_i)
    t      target, (target_b, target_a): the points of one half aim at the other half
    M      matrix, symmetric and positive semidefinite on differences of weights

    hull         least |sum_i w_i p_i - t|^2, exact: the point next to t of the convex
                 hull of the p_i
    quadratic    least w'Mw, exact
    iterative    the paper's solver, for comparison; `iterative_quadratic` likewise
    reference    jaxopt's OSQP in float64, for tests; `reference_quadratic` likewise

Adding a number to all elements of M changes w'Mw by that number, so it changes no
weights, and M itself need not be semidefinite.

Where some number of a problem is not finite all bases get the same weight.

The exact solvers are deterministic, and differentiable: which bases take part is found
without derivatives, then their weights are a formula. Where two choices are as good (a
tie) the derivative is that of one of them.

Sources:
    S. Zheng, F. Zheng, K. Xu, L.-Q. Yan, "Ensemble Denoising for Monte Carlo
    Renderings", 2021 (ED; eq. numbers below). Both exact solvers are ours; the search
    is a primal active-set method (J. Nocedal, S. Wright, "Numerical Optimization",
    section 16.5).
"""

from jscomb.numerics.simplex.hull import hull as hull
from jscomb.numerics.simplex.hull import two as two
from jscomb.numerics.simplex.iterative import iterative as iterative
from jscomb.numerics.simplex.iterative import iterative_quadratic as iterative_quadratic
from jscomb.numerics.simplex.quadratic import affine as affine
from jscomb.numerics.simplex.quadratic import quadratic as quadratic
from jscomb.numerics.simplex.reference import reference as reference
from jscomb.numerics.simplex.reference import reference_quadratic as reference_quadratic
