"""Every method at its settings, as a function of a frame: what `sweep` compares.

The methods of `jscomb.methods`, and variants of them. A frame is normalised, and has
halves, features and `oidn` with halves.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jscomb import ensemble, james_stein, methods
from jscomb.denoisers import nfor, oidn
from jscomb.frame import Frame
from jscomb.methods import METHODS, Method
from jscomb.numerics.sure import monte_carlo_sure
from jscomb.typing import Image

FEW = "oidn", "oidn-color", "bilateral", "rdfc"  # bases of a small ensemble


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


def _told(frame: Frame, scale: float) -> Frame:
    """The frame with another variance."""
    variance = frame.variance * scale
    k = frame.sub_buffers
    stacked = jnp.broadcast_to(k * variance, (k, *variance.shape))
    return frame._replace(buffers=frame.buffers._replace(variance=stacked))


def _james_stein(
    frame: Frame, scale: float, *, window: int, whiten: bool = False
) -> Image:
    """Without its network, in windows of another width."""
    y = frame.estimates["oidn"]._replace(halves=None)
    options = {"window": window, "whiten": whiten}
    return james_stein.combine_frame(_told(frame, scale), y, **options).image


def _dual(frame: Frame, scale: float) -> Image:
    """Each half's x with the other half's y, whitened."""
    a, b = frame.halves()
    ya, yb = frame.estimates["oidn"].halves
    v = scale * james_stein.robust_variance(frame.variance)
    options = {"window": 7, "whiten": True}
    return james_stein.combine_dual(a.color, b.color, ya, yb, v, **options)


def _regressed(frame: Frame, *, stride: int, always: bool = False) -> Image:
    """Whitened, with y* where the halves show that it helps, or always."""
    y = frame.estimates["oidn"]
    found = james_stein.regress(
        jax.random.key(0), frame, y, stride=stride, always=always
    )
    star = found.estimate._replace(halves=None)
    return james_stein.combine_frame(frame, star).image


def _corrected(frame: Frame) -> Image:
    """Whitened, corrected for the covariance of y with x."""
    v = james_stein.robust_variance(frame.variance)
    denoise = lambda color: oidn.denoise_color(color, frame)
    risk = monte_carlo_sure(jax.random.key(0), denoise, frame.color, v, slope_limit=1.0)
    return _corrected_of(frame.color, risk.denoised, v, divergence=risk.divergence)


_corrected_of = jax.jit(
    functools.partial(james_stein.combine, window=7, whiten=True),
)


def _ensemble(frame: Frame, *, bases: tuple[str, ...]) -> Image:
    """Multi-scale weights of several denoisers, those that the frame needs."""
    made = {n: methods.combine(jax.random.key(0), frame, method=n) for n in bases[1:]}
    made = {"oidn": frame.estimates["oidn"], **made}
    return ensemble.combine_frame(frame, made, select=True).image


def _by(frame: Frame, *, method: str) -> Image:
    """As `jscomb combine --method` does."""
    return methods.plan(jax.random.key(0), frame, method=method).whole()


def _of_tier(frame: Frame, *, name: str) -> Image:
    """By a tier of the default method."""
    return methods.combine(jax.random.key(0), frame, method=name).image


def _pure(frame: Frame, scale: float, *, method: Method) -> Image:
    """A method that may be traced."""
    y = frame.estimates["oidn"]
    given = (y,) if method.takes == "one estimate" else ()
    return method.image(jax.random.key(0), _told(frame, scale), *given)


def _of_method(name: str, method: Method) -> Combiner:
    """An entry of the table of methods."""
    denoised = {"nothing": 0, "one estimate": 1, "estimates": 3}[method.takes]
    if method.pure:
        return Combiner(functools.partial(_pure, method=method), denoised, traced=True)
    halves = 3 if denoised else 0
    return Combiner(functools.partial(_by, method=name), halves)


_of = functools.partial


def combiners() -> dict[str, Combiner]:
    """All methods and their variants by name.

    Uncorrelated kernels are not here: they combine two renderings, not a rendering and
    its denoised image (`experiments.uncorrelated.error`).
    """
    return {
        "path tracing": Combiner(lambda frame, scale: frame.color, 0, traced=True),
        **{
            name: _of_method(name, method)
            for name, method in METHODS.items()
            if method.input is None  # a second rendering is not one of these frames'
        },
        # The frame's own, whose time is counted apart.
        "oidn": Combiner(
            lambda frame, scale: frame.estimates["oidn"].image, 1, traced=True
        ),
        "nfor of stride 2": Combiner(
            lambda frame: nfor.denoise_frame(frame, stride=2).image, 0
        ),
        **{
            f"james-stein {w}x{w}": Combiner(
                _of(_james_stein, window=w), 1, traced=True
            )
            for w in (7, 31)
        },
        **{
            f"whitened {w}x{w}": Combiner(
                _of(_james_stein, window=w, whiten=True), 1, traced=True
            )
            for w in (5, 15)
        },
        "whitened, dual": Combiner(_dual, 3, traced=True),
        "whitened, corrected": Combiner(_corrected, 0),
        **{
            f"whitened, y* of stride {s}": Combiner(_of(_regressed, stride=s), 3)
            for s in (2, 8)
        },
        "whitened, always y*": Combiner(_of(_regressed, stride=2, always=True), 3),
        "ensemble of 2": Combiner(_of(_ensemble, bases=FEW[:2]), 3),
        "ensemble of 4": Combiner(_of(_ensemble, bases=FEW), 3),
        **{
            name: Combiner(_of(_of_tier, name=name), 1 if name == "fast" else 3)
            for name in methods.TIERS
        },
    }
