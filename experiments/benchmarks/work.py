"""How much arithmetic a function does, and how fast a machine does it at best."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend import core

from experiments.common.timing import medians

LAYOUT = {
    "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "copy_p",
    "device_put", "dynamic_slice", "dynamic_update_slice", "expand_dims", "gather",
    "iota", "pad", "reshape", "rev", "slice", "split", "squeeze", "stop_gradient",
    "transpose",
}  # fmt: skip
"""What moves numbers and computes nothing."""

EXPONENTIAL = {
    "cos", "erf", "exp", "exp2", "expm1", "log", "log1p", "logistic", "pow", "sin",
    "tanh",
}  # fmt: skip
"""What takes as long as an exponential."""


class Work(NamedTuple):
    """What a function takes at least, or what a machine does a second.

    Attributes:
        products: multiplications and additions of matrix products and convolutions.
        operations: of all other arithmetic.
        exponentials: and what is as slow.
        moved: bytes of arguments and results.
    """

    products: float = 0.0
    operations: float = 0.0
    exponentials: float = 0.0
    moved: float = 0.0

    def plus(self, other: "Work", *, times: float = 1.0) -> "Work":
        """Both, the other several times."""
        pairs = zip(self, other, strict=True)
        return Work(*(own + times * added for own, added in pairs))

    def seconds(self, rates: "Work") -> float:
        """Time at these rates: to compute, or to move if that is longer."""
        *computed, moved = (own / rate for own, rate in zip(self, rates, strict=True))
        return max(sum(computed), moved)


def work_of(function: Callable[..., Any], *arguments: Any) -> Work:
    """The work of a call, by its program's primitives.

    What is repeated until a condition holds is counted once, and what is done on the
    host not at all.

    Args:
        function: of arrays.
        arguments: arrays, or their shapes.

    Returns:
        its work.
    """
    traced = jax.make_jaxpr(function)(*arguments)
    made = traced.jaxpr.outvars
    used = {id(v) for e in traced.jaxpr.eqns for v in e.invars} | set(map(id, made))
    ends = [v for v in traced.jaxpr.invars if id(v) in used] + list(made)
    moved = sum(_size(end) * end.aval.dtype.itemsize for end in ends)
    return _count(traced.jaxpr)._replace(moved=float(moved))


def _count(jaxpr: core.Jaxpr) -> Work:
    """All equations."""
    total = Work()
    for equation in jaxpr.eqns:
        inner = [_count(each) for each in inside(equation)]
        if equation.primitive.name == "cond":
            inner = [max(inner, key=sum)]
        for each in inner:
            total = total.plus(each, times=equation.params.get("length", 1))
        if not inner:
            total = total.plus(_own(equation))
    return total


def inside(equation: core.JaxprEqn) -> list[core.Jaxpr]:
    """Return the programs that an equation runs."""
    if equation.primitive.name.startswith(("reduce", "scatter", "cum", "sort", "arg")):
        return []  # what it does to two numbers
    if equation.primitive.name == "custom_linear_solve":
        return [equation.params["jaxprs"].solve.jaxpr]  # forward, not its transpose
    found = []
    for value in equation.params.values():
        for each in value if isinstance(value, tuple | list) else (value,):
            if isinstance(each, core.ClosedJaxpr):
                found.append(each.jaxpr)
            elif isinstance(each, core.Jaxpr):
                found.append(each)
    return found


def _own(equation: core.JaxprEqn) -> Work:
    """What a primitive does."""
    name, given, params = equation.primitive.name, equation.invars, equation.params
    made = float(sum(map(_size, equation.outvars)))
    if name == "dot_general":
        (along, _), _ = params["dimension_numbers"]
        summed = math.prod(given[0].aval.shape[axis] for axis in along)
        return Work(products=2 * summed * made)
    if name == "conv_general_dilated":
        kernel = given[1].aval.shape
        filters = kernel[params["dimension_numbers"].rhs_spec[0]]
        return Work(products=2 * made * math.prod(kernel) / filters)
    if name in EXPONENTIAL:
        return Work(exponentials=made)
    if name.startswith("reduce_window"):
        return Work(operations=made * math.prod(params["window_dimensions"]))
    if name in ("fft", "sort"):
        return Work(operations=5 * made * max(1.0, math.log2(max(made, 2))))
    if name in LAYOUT or name.startswith("random"):
        return Work()
    taken = float(max(map(_size, given), default=0))
    return Work(operations=max(made, taken))


def _size(variable: Any) -> int:
    """Numbers that it holds."""
    return math.prod(getattr(variable.aval, "shape", ()))


def rates(*, repeats: int) -> Work:
    """What this machine does a second of each kind, alone and at its best.

    Args:
        repeats: timed calls.

    Returns:
        numbers a second; they move as a copy does, read and written.
    """
    side, large = 1024, jnp.linspace(0.0, 1.0, 2**22)
    matrix = jnp.full((side, side), 0.5)

    def chain(x: jax.Array) -> jax.Array:
        for _ in range(64):
            x = x * 0.5 + 0.25
        return x

    def powers(x: jax.Array) -> jax.Array:
        for _ in range(4):
            x = jnp.exp(-x)
        return x

    calls = {
        "products": (lambda m: m @ m, matrix, 2.0 * side**3),
        "operations": (chain, large, 2.0 * 64 * large.size),
        "exponentials": (powers, large, 4.0 * large.size),
        "moved": (lambda x: x + 1, jnp.tile(large, 8), 2.0 * 8 * large.nbytes),
    }
    bound = {n: functools.partial(jax.jit(f), x) for n, (f, x, _) in calls.items()}
    seconds = medians(bound, repeats)
    return Work(**{name: calls[name][2] / seconds[name] for name in calls})
