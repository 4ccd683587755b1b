"""Choose for a frame the method that combines it best, from its half buffers alone.

Each method makes an image of either half, and `metrics.rel_l2_change` tells by the
other half how much less error it has than the cheapest method's, fireflies limited. The
one of least estimated error is taken, each at one standard error to its disadvantage;
the cheapest where none is better.

A half has half the samples, and combining gains more the more samples there are, so the
choice is rather a cautious one.
"""

import functools
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb import james_stein, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.numerics.tiles import Local
from jscomb.typing import Image, Key, Variance

KEEP = "kept"
_EPSILON = 0.01  # of the relative L2, at an exposure of one
_LIMIT = 2.0  # of what a firefly may say about a method
_UNJUDGED = "whitened"  # where there are no halves to ask


class Trial(NamedTuple):
    """What was found out about a method.

    Attributes:
        method: its name.
        change: of the relative L2 against the cheapest method, estimated; None if it
            could not be judged.
        seconds: that one half took, compilation apart; 0 if not judged.
        reason: why it was not judged, or may not be taken; else empty.
    """

    method: str
    change: metrics.Change | None
    seconds: float
    reason: str


class Choice(NamedTuple):
    """What to combine a frame by.

    Attributes:
        method: a key of `METHODS`.
        trials: all that were tried, in order.
    """

    method: str
    trials: tuple[Trial, ...]


@jax.jit
def _james_stein(x: Image, y: Image, variance: Variance) -> Image:
    """As in the paper without its network: 15x15 windows, box-filtered variance."""
    return james_stein.combine(x, y, james_stein.smooth_variance(variance))


@jax.jit
def _whitened(x: Image, y: Image, variance: Variance) -> Image:
    """A variance for each pixel, made robust, and windows of 7x7."""
    robust = james_stein.robust_variance(variance)
    return james_stein.combine(x, y, robust, window=7, whiten=True)


UNTRAINED: dict[str, Callable[[Image, Image, Variance], Image]] = {
    "james-stein": _james_stein,
    "whitened": _whitened,
}
"""The estimators without a network, as `METHODS` uses them: of x, y and the variance of
the mean x, [H,W,C] each."""


def _keep(key: Key, frame: Frame, name: str) -> Local:
    """The biased image as it is."""
    del key
    return Local(lambda y: y, frame.biased[name].full, 0)


def _untrained(key: Key, frame: Frame, name: str, *, method: str) -> Local:
    """By an estimator without a network."""
    del key
    images = frame.color, frame.biased[name].full, frame.variance
    return Local(lambda i: UNTRAINED[method](*i), images, _HALOS[method])


def _learned(key: Key, frame: Frame, name: str, *, method: str) -> Local:
    """By a trained network."""
    from jscomb.learning import methods  # flax is slow to import

    return methods.local(key, frame, name, method=method)


# Windows twice: of the variance or the share, and of its mean.
_HALOS = {"james-stein": 7 + 7, "whitened": 9 + 3 + 3}

METHODS: dict[str, Callable[[Key, Frame, str], Local]] = {
    KEEP: _keep,
    **{method: functools.partial(_untrained, method=method) for method in UNTRAINED},
    **{
        method: functools.partial(_learned, method=method)
        for method in ("njs", "pd", "dsc")
    },
}
"""Of a key, a frame and the name of its biased image, to the combination as a function
of what it takes; the cheapest first. Some decide on values, so they are not for `jit`.
"""

CANDIDATES = tuple(method for method in METHODS if method != "james-stein")
"""What `choose` tries: of the two without a network only the better one."""


def combine(key: Key, frame: Frame, name: str, *, method: str) -> Image:
    """Combine a frame with one of its biased images.

    Args:
        key: of random probes, a typed key.
        frame: with variance.
        name: of the biased image.
        method: a key of `METHODS`.

    Returns:
        the combination, linear radiance, shape [H,W,C].

    Raises:
        ValueError: if there is no such method or biased image, or the frame lacks what
            the method needs.
        ImportError: for pd, if Open Image Denoise is not installed.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x, y = jnp.full((3, 3, 1), 3.0), jnp.ones((3, 3, 1))
        >>> frame, key = make_frame(x, variance=y, biased={"y": y}), jax.random.key(0)
        >>> for method in ("kept", "james-stein"):
        ...     print(combine(key, frame, "y", method=method)[0, 0].round(3))
        [1.]
        [2.611]
    """
    found = local(key, frame, name, method=method)
    return found.function(found.images)


def local(key: Key, frame: Frame, name: str, *, method: str) -> Local:
    """A frame's combination as a function of what it takes: for large ones by crops.

    What the whole frame decides, such as its exposure, is decided here.

    Args:
        key: of random probes, a typed key.
        frame: with variance.
        name: of the biased image.
        method: a key of `METHODS`: kept (the biased image as it is), james-stein,
            whitened, or by a trained network njs, pd, dsc.

    Returns:
        the function and its images.

    Raises:
        ValueError: if there is no such method or biased image, or the frame lacks what
            the method needs.
        ImportError: for pd, if Open Image Denoise is not installed.

    Example:
        >>> from jscomb.frame import make_frame
        >>> from jscomb.numerics import tiles
        >>> x, y = jnp.full((3, 3, 1), 3.0), jnp.ones((3, 3, 1))
        >>> frame = make_frame(x, variance=y, biased={"y": y})
        >>> found = local(jax.random.key(0), frame, "y", method="james-stein")
        >>> image = tiles.map_crops(**found._asdict(), tile=2)
        >>> print(found.halo, image[0, 0].round(3))
        14 [2.611]
    """
    if method not in METHODS:
        raise ValueError(f"no method {method!r}; there are {', '.join(METHODS)}")
    if name not in frame.biased:
        raise ValueError(f"no biased image {name!r}; there are {list(frame.biased)}")
    return METHODS[method](key, frame, name)


def choose(
    frame: Frame,
    *,
    name: str | None = None,
    budget: float | None = None,
    methods: Sequence[str] = CANDIDATES,
    seed: int = 0,
) -> Choice:
    """Find the method of least estimated error for a frame.

    Decides on values, so it is not for `jit`. Takes about twice as long as all methods
    together, each of which is compiled when it is first used on a size of image. To
    judge one that itself needs halves takes four sub-buffers, and the denoiser for the
    quarters.

    Args:
        frame: with variance, and a biased image with halves.
        name: of the biased image; None for the only one.
        budget: seconds that a method may take for the frame; None for any.
        methods: to choose from, the cheapest first.
        seed: of random probes.

    Returns:
        the method for `combine`, and why. A frame without halves of both images is told
        nothing about; it gets `whitened`, and no trials.

    Raises:
        ValueError: if there is no such biased image or method, no method at all, or
            several images and no name.

    Example:
        >>> import jax
        >>> from jscomb.frame import Biased, make_frame
        >>> noise = jax.random.normal(jax.random.key(0), (2, 32, 32, 3))
        >>> y = jnp.ones((32, 32, 3))
        >>> smooth = Biased(y, jnp.stack([y, y]))
        >>> frame = make_frame(
        ...     1 + noise / 4, variance=y / 32, biased={"y": smooth}
        ... )
        >>> print(choose(frame, methods=["kept", "whitened"]).method)
        kept

    Source: ours.
    """
    name = _only(frame) if name is None else name
    if name not in frame.biased:
        raise ValueError(f"no biased image {name!r}; there are {list(frame.biased)}")
    if not methods or not set(methods) <= METHODS.keys():
        raise ValueError(f"methods {list(methods)}: there are {', '.join(METHODS)}")
    if frame.sub_buffers < 2 or frame.biased[name].halves is None:
        return Choice(_UNJUDGED, ())
    halves = [_quartered(half, name) for half in frame.halves()]
    make = functools.partial(_made, seed, halves, name)
    cheapest, *others = methods
    y, _ = make(cheapest)
    x = jnp.stack([half.color for half in halves])
    epsilon = _EPSILON * jnp.square(frame.exposure)
    trials = []
    for method in others:
        try:
            z, seconds = make(method)
        except (ValueError, ImportError) as error:
            trials.append(Trial(method, None, 0.0, str(error)))
            continue
        change = metrics.rel_l2_change(z, y, x, epsilon=epsilon, limit=_LIMIT)
        late = budget is not None and seconds > budget
        reason = f"takes {seconds:.2g} s of {budget:.2g}" if late else ""
        trials.append(Trial(method, change, seconds, reason))
    return Choice(_least(trials) or cheapest, tuple(trials))


def _least(trials: Sequence[Trial]) -> str | None:
    """The method of least error among those that may be taken and surely lower it."""
    judged = {t.method: t.change for t in trials if t.change and not t.reason}
    sure = {m: float(sum(change)) for m, change in judged.items() if change.helps}
    return min(sure, key=lambda method: sure[method], default=None)


def _only(frame: Frame) -> str:
    """The name of the only biased image."""
    names = list(frame.biased)
    if len(names) != 1:
        raise ValueError(f"of which biased image? there are {names}")
    return names[0]


def _quartered(half: Frame, name: str) -> Frame:
    """A half with halves of its own denoised image, where they can be made."""
    if name != "oidn" or half.sub_buffers < 2 or not oidn.available():
        return half
    quarters = oidn.denoise_frame(half).halves
    return half.with_biased(name, half.biased[name]._replace(halves=quarters))


def _made(
    seed: int, halves: list[Frame], name: str, method: str
) -> tuple[Float[Array, "2 h w c"], float]:
    """A method's images of both halves, and the seconds that one takes."""
    images, seconds = [], 0.0
    for number, half in enumerate(halves):
        start = time.perf_counter()
        key = jax.random.key(seed + number)
        image = combine(key, half, name, method=method)
        images.append(jax.block_until_ready(image))
        seconds = time.perf_counter() - start  # the second time without compilation
    return jnp.stack(images), seconds
