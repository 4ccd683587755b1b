"""Every combiner at its settings, as a function of a frame: what `sweep` compares.

A frame is at an exposure of one and has halves, features and `oidn` with halves.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments.bases import BASES
from jscomb import choice, double_shrinkage, ensemble, james_stein, progressive
from jscomb.denoisers import nfor, oidn
from jscomb.frame import Frame
from jscomb.numerics.sure import Risk, monte_carlo_sure
from jscomb.typing import Image, Variance


class Combiner(NamedTuple):
    """How to make an image of a frame.

    Attributes:
        combine: of a frame; where `traced`, of a frame and a factor for the variance
            that it is told.
        denoised: how many images by Open Image Denoise it takes from the frame: none,
            that of the full frame, or those of the halves too.
        traced: pure, for `jit` and `vmap`.
    """

    combine: Callable[..., Image]
    denoised: int
    traced: bool = False


def _james_stein(frame: Frame, scale: float, *, window: int) -> Image:
    """As in the paper, without its network."""
    v = james_stein.smooth_variance(scale * frame.variance, window=window)
    return james_stein.combine(frame.color, _y(frame), v, window=window)


def _whitened(frame: Frame, scale: float, *, window: int) -> Image:
    """Each pixel with a variance of its own."""
    v = scale * james_stein.robust_variance(frame.variance)
    return james_stein.combine(frame.color, _y(frame), v, window=window, whiten=True)


def _dual(frame: Frame, scale: float) -> Image:
    """Each half's x with the other half's y, whitened."""
    a, b = frame.halves()
    ya, yb = (half.estimates["oidn"].image for half in (a, b))
    v = scale * james_stein.robust_variance(frame.variance)
    options = {"window": 7, "whiten": True}
    return james_stein.combine_dual(a.color, b.color, ya, yb, v, **options)


def _regressed(frame: Frame, *, stride: int, always: bool = False) -> Image:
    """Whitened, with y* where the halves say that it pays, or always."""
    key = jax.random.key(0)
    found = james_stein.regress(key, frame, "oidn", stride=stride, always=always)
    return choice.UNTRAINED["whitened"](frame.color, found.estimate.image, frame.variance)


def _sure(frame: Frame) -> tuple[Variance, Risk]:
    """A robust variance, and the denoised image with its risk."""
    v = james_stein.robust_variance(frame.variance)
    one = jnp.ones((), v.dtype)
    guides = {"albedo": frame.albedo, "normal": frame.normal, "exposure": one}
    denoise = functools.partial(oidn.denoise, **guides)
    return v, monte_carlo_sure(jax.random.key(0), denoise, frame.color, v)


def _corrected(frame: Frame) -> Image:
    """Whitened, corrected for what y has in common with x."""
    v, risk = _sure(frame)
    return _corrected_of(frame.color, risk.denoised, v, divergence=risk.divergence)


def _progressive(frame: Frame) -> Image:
    """PD without its network, whitened."""
    v, risk = _sure(frame)
    return _mixed(frame.color, risk.denoised, v, risk.squared_error)


def _ensemble(frame: Frame, *, bases: tuple[str, ...]) -> Image:
    """Multi-scale weights of several denoisers, those that the frame needs."""
    made = {name: BASES[name](frame) for name in bases}
    full, a, b = ensemble.stack_bases(made)
    x_a, x_b = (half.color for half in frame.halves())
    kept = jnp.array(ensemble.select_bases(a, b, x_a, x_b).kept)
    return _weighted(full[kept], a[kept], b[kept], x_a, x_b)


def _chosen(frame: Frame) -> Image:
    """By the method that the halves choose."""
    return _by(frame, method=choice.choose(frame, name="oidn").method)


def _by(frame: Frame, *, method: str) -> Image:
    """As `jscomb combine --method` does."""
    return choice.combine(jax.random.key(0), frame, "oidn", method=method)


def _y(frame: Frame) -> Image:
    """The denoised image."""
    return frame.estimates["oidn"].image


# Called with values: a loop inside would be compiled anew each time.
_corrected_of = jax.jit(
    functools.partial(james_stein.combine, window=7, whiten=True),
)
_mixed = jax.jit(
    functools.partial(
        progressive.combine, mix=functools.partial(progressive.mixing, whiten=True)
    )
)
_weighted = jax.jit(
    functools.partial(ensemble.combine, solver="multi-scale", filter=False)
)

_of = functools.partial
_FOUR = ("oidn", "oidn, no features", "bilateral", "rdfc")
COMBINERS: dict[str, Combiner] = {
    "path tracing": Combiner(lambda frame, scale: frame.color, 0, traced=True),
    "oidn": Combiner(lambda frame, scale: _y(frame), 1, traced=True),
    "nfor": Combiner(lambda frame: nfor.denoise_frame(frame, stride=2).image, 0),
    **{
        f"james-stein {w}x{w}": Combiner(_of(_james_stein, window=w), 1, traced=True)
        for w in (7, 15, 31)
    },
    **{
        f"whitened {w}x{w}": Combiner(_of(_whitened, window=w), 1, traced=True)
        for w in (5, 7, 15)
    },
    "whitened, dual": Combiner(_dual, 3, traced=True),
    "whitened, corrected": Combiner(_corrected, 0),
    **{
        f"whitened, y* of stride {s}": Combiner(_of(_regressed, stride=s), 3)
        for s in (2, 8)
    },
    "whitened, always y*": Combiner(_of(_regressed, stride=2, always=True), 3),
    "progressive": Combiner(_progressive, 0),
    "ensemble of 2": Combiner(_of(_ensemble, bases=_FOUR[:2]), 3),
    "ensemble of 4": Combiner(_of(_ensemble, bases=_FOUR), 3),
    "double shrinkage": Combiner(
        lambda frame: double_shrinkage.combine_frame(frame, "oidn").image, 3
    ),
    "njs": Combiner(_of(_by, method="njs"), 3),
    "pd": Combiner(_of(_by, method="pd"), 0),
    "dsc": Combiner(_of(_by, method="dsc"), 3),
    "chosen": Combiner(_chosen, 3),
}
"""By name. Uncorrelated kernels are not here: they combine two renderings, not a
rendering and its denoised image (`experiments.uncorrelated`)."""
