"""Every denoiser and combiner by its name, with what it needs; and which to choose.

`combine` makes an estimate of a frame by one of them; `choose` finds the one of minimum
estimated error. The table `METHODS` is the only place that names methods: the command,
the sweep, the tests and these pages read it. To add one, assign a `Method`.

`choose` needs no reference: each method makes an image of each half, and
`metrics.rel_l2_change` estimates from the other half by how much its error differs from
that of the cheapest method, with fireflies limited. It takes the method of minimum
estimated error, each plus one standard error; the cheapest where none is better. A half
has half the samples, and combining gains more with more samples, so it chooses rather
cautiously.
"""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jscomb import (
    double_shrinkage,
    ensemble,
    james_stein,
    metrics,
    progressive,
)
from jscomb.denoisers import (
    bilateral,
    nfor,
    nonlocal_means,
    oidn,
    rdfc,
    smoothing,
)
from jscomb.frame import Estimate, Frame, Maker, Needs, estimates_of, with_halves
from jscomb.numerics.tiles import Local
from jscomb.typing import Image, Key

__all__ = [
    "BASES",
    "CANDIDATES",
    "METHODS",
    "Choice",
    "Method",
    "Trial",
    "choose",
    "combine",
    "inputs",
    "plan",
    "table",
]

_EPSILON = 0.01  # of the relative L2 of normalised frames
_LIMIT = 2.0  # of the influence of a firefly on the choice
_DENOISER = "oidn"  # for frames without an estimate


class Method(NamedTuple):
    """A denoiser or combiner: a `plan`, or a `make` for what has none.

    Attributes:
        summary: what it does, in one line.
        needs: what it needs of a frame.
        takes: what it takes beside the frame: nothing, one estimate, or several by
            name.
        plan: of a key, a normalised frame and its estimates, to a local function of
            images.
        make: of a key, a normalised frame and what it takes (each an `Estimate` or a
            `Maker`), to an `Estimate`.
        denoiser: the denoiser that it runs by itself, where it takes no estimate.
        pure: decides on no values, for `jit` and `vmap`.
    """

    summary: str
    needs: Needs
    takes: Literal["nothing", "one estimate", "estimates"]
    plan: Callable[..., Local] | None = None
    make: Callable[..., Estimate] | None = None
    denoiser: str | None = None
    pure: bool = False

    def image(self, key: Key, frame: Frame, *estimates: Any) -> Image:
        """Return the image alone, [H,W,C]."""
        key = jax.random.clone(key)  # the parts of a frame share their probes
        if self.plan is not None:
            return self.plan(key, frame, *estimates).whole()
        assert self.make is not None
        return self.make(key, frame, *estimates).image

    def estimate(self, key: Key, frame: Frame, *given: Any) -> Estimate:
        """Return the image, and that of each half where it can be made."""
        if self.make is not None:
            return self.make(jax.random.clone(key), frame, *given)
        image = functools.partial(self.image, key)
        return with_halves(frame, image, *given, needs=self.needs)


def _denoiser(summary: str, needs: Needs, denoise: Callable[..., Estimate], **options):
    """A method that denoises a frame as a whole."""
    make = lambda key, frame: denoise(frame, **options)
    return Method(summary, needs, "nothing", make=make)


def _filter(summary: str, room: Any) -> Method:
    """A method that denoises a frame by a local function."""
    plan = lambda key, frame: room.plan_frame(frame)
    return Method(summary, room.NEEDS, "nothing", plan, pure=True)


def _network(name: str) -> Any:
    """The trained network of a method."""
    from jscomb.learning.recipes import shipped  # flax is slow to import

    return shipped(name)


def _james_stein(summary: str, **options: Any) -> Method:
    """James-Stein without its network."""
    plan = lambda key, frame, y: james_stein.plan_frame(frame, y, **options)
    return Method(summary, james_stein.NEEDS, "one estimate", plan, pure=True)


_OIDN = oidn.NEEDS.package_of()

METHODS: dict[str, Method] = {
    "oidn": _denoiser(
        "Open Image Denoise with the frame's albedo and normal",
        oidn.NEEDS,
        oidn.denoise_frame,
    ),
    "oidn-color": _denoiser(
        "Open Image Denoise with the colour alone",
        oidn.NEEDS,
        oidn.denoise_frame,
        features=False,
    ),
    "nfor": _denoiser(
        "first-order regression on the features", nfor.NEEDS, nfor.denoise_frame
    ),
    "bilateral": _filter("joint bilateral filter", bilateral),
    "nonlocal-means": _filter("non-local means", nonlocal_means),
    "rdfc": _filter("non-local means restricted by the features", rdfc),
    "gaussian": _filter("Gaussian blur", smoothing),
    "denoised": Method(
        "the biased image, unchanged",
        Needs(),
        "one estimate",
        lambda key, frame, y: Local(lambda image: image, y.image, 0),
        pure=True,
    ),
    "james-stein": _james_stein(
        "James-Stein with one variance a 15x15 window", window=15, whiten=False
    ),
    "whitened": _james_stein("James-Stein with a robust variance for each pixel"),
    "progressive": Method(
        "mixing with Open Image Denoise by SURE",
        progressive.NEEDS._replace(channels=3, **_OIDN),
        "nothing",
        make=lambda key, frame: progressive.combine_frame(
            key, oidn.denoise_color, frame
        ),
        denoiser="oidn",
    ),
    "double-shrinkage": Method(
        "double shrinkage with errors from half buffers",
        double_shrinkage.NEEDS,
        "one estimate",
        make=lambda key, frame, y: double_shrinkage.combine_frame(frame, y),
    ),
    "njs": Method(
        "James-Stein with a trained network",
        james_stein.NEURAL_NEEDS,
        "one estimate",
        lambda key, frame, y: james_stein.plan_neural(key, _network("njs"), frame, y),
    ),
    "pd": Method(
        "progressive denoising with a trained network, of Open Image Denoise",
        progressive.NEEDS._replace(channels=3, **_OIDN),
        "nothing",
        lambda key, frame: progressive.plan_neural(
            key, oidn.denoise_color, _network("pd"), frame
        ),
        denoiser="oidn",
    ),
    "dsc": Method(
        "double shrinkage with a trained network",
        double_shrinkage.NEEDS._replace(channels=3),
        "one estimate",
        lambda key, frame, y: double_shrinkage.plan_neural(_network("dsc"), frame, y),
    ),
    "ensemble": Method(
        "weights of minimum error for all the frame's estimates and several denoisers",
        ensemble.NEEDS,
        "estimates",
        make=lambda key, frame, bases: ensemble.combine_frame(frame, bases),
    ),
}
"""By name; the cheaper first among the combiners. Uncorrelated kernels are not here:
they combine two renderings (`uncorrelated.combine_frame`)."""

CANDIDATES = "denoised", "whitened", "njs", "pd", "dsc"
"""What `choose` chooses from, the cheapest first."""

BASES = "oidn", "oidn-color", "bilateral", "rdfc", "pd"
"""What an ensemble is made of beside a frame's own estimates."""


class Trial(NamedTuple):
    """A method that `choose` tried.

    Attributes:
        method: its name.
        change: estimated change of the relative L2 against the cheapest method; None if
            it could not be judged.
        seconds: of one half without compilation; 0 if not judged.
        reason: why it was skipped; else empty.
    """

    method: str
    change: metrics.Change | None
    seconds: float
    reason: str


class Choice(NamedTuple):
    """The method to combine a frame by.

    Attributes:
        method: a key of `METHODS`.
        trials: all that were tried, in order.
        halves: its images of each half, normalised radiance, [2,H,W,C]; None if none
            were made.
    """

    method: str
    trials: tuple[Trial, ...]
    halves: Float[Array, "2 h w c"] | None


def combine(
    key: Key,
    frame: Frame,
    *,
    method: str | None = None,
    biased: str | Sequence[str] | None = None,
    budget: float | None = None,
) -> Estimate:
    """Make the estimate of a frame by a method, or by the one that `choose` finds.

    Normalises the frame, and scales the result back. Some methods decide on values, so
    this is not for `jit`; the papers' own functions are, where their parts are.

    Args:
        key: of random probes, a typed key.
        frame: in any unit.
        method: a key of `METHODS`; None to choose.
        biased: the biased image to combine with: an estimate of the frame, or a
            denoiser of `METHODS`; several for an ensemble. None for the frame's only
            estimate, or Open Image Denoise if it has none; for an ensemble all of them
            and `BASES`.
        budget: seconds that a chosen method may take for a half; None for any.

    Returns:
        the estimate, in the frame's unit. Its halves are None where they cannot be
        made: `METHODS[method].needs.missing_for_halves(frame)` returns the reason. With
        two sub-buffers the halves of an ensemble share its weights.

    Raises:
        ValueError: if there is no such method or biased image, or the frame lacks what
            the method needs; says what and how to get it.
        ImportError: if a package is missing; says how to install it.

    Example:
        >>> from jscomb.frame import make_frame
        >>> x, y = jnp.full((3, 3, 1), 3.0), jnp.ones((3, 3, 1))
        >>> frame = make_frame(x, variance=y, estimates={"y": y})
        >>> for method in ("denoised", "james-stein"):
        ...     made = combine(jax.random.key(0), frame, method=method)
        ...     print(made.image[0, 0].round(3))
        [1.]
        [2.611]
    """
    whole, halves = frame.normalised(), None
    if method is None:
        found = choose(key, whole, biased=biased, budget=budget)
        method, halves = found.method, found.halves
    if (unchanged := _unchanged(frame, method, biased)) is not None:
        return unchanged
    whole, given = _given(key, whole, method, biased)
    chosen = METHODS[method]
    if halves is None:
        made = chosen.estimate(key, whole, *given)
    else:
        image = chosen.image(key, whole, *estimates_of(whole, given))
        made = Estimate(image, halves)
    assert whole.unit is not None
    return made if frame.unit is not None else made.scaled(whole.unit)


def plan(
    key: Key,
    frame: Frame,
    *,
    method: str,
    biased: str | Sequence[str] | None = None,
) -> Local:
    """Return `combine` as a local function of images, to combine large frames by crops.

    What depends on the whole frame is computed here.

    Args:
        key: of random probes, a typed key.
        frame: in any unit.
        method: a key of `METHODS`.
        biased: as for `combine`.

    Returns:
        the function, its images and how far it sees; its result is in the frame's unit.

    Raises:
        ValueError: as `combine`.
        ImportError: as `combine`.

    Example:
        >>> from jscomb.frame import make_frame
        >>> from jscomb.numerics import tiles
        >>> x, y = jnp.full((3, 3, 1), 3.0), jnp.ones((3, 3, 1))
        >>> frame = make_frame(x, variance=y, estimates={"y": y})
        >>> found = plan(jax.random.key(0), frame, method="james-stein")
        >>> image = tiles.map_crops(**found._asdict(), tile=2)
        >>> print(found.halo, image[0, 0].round(3))
        14 [2.611]
    """
    if (unchanged := _unchanged(frame, method, biased)) is not None:
        return Local(lambda image: image, unchanged.image, 0)
    whole, given = _given(key, frame.normalised(), method, biased)
    chosen, estimates = METHODS[method], estimates_of(whole, given)
    if chosen.plan is not None:
        local = chosen.plan(jax.random.clone(key), whole, *estimates)
    else:
        local = Local(lambda image: image, chosen.image(key, whole, *estimates), 0)
    if frame.unit is not None:
        return local
    return local._replace(function=lambda images: whole.unit * local.function(images))


def _unchanged(
    frame: Frame, method: str, biased: str | Sequence[str] | None
) -> Estimate | None:
    """The frame's own estimate, bit by bit, if that is what the method returns."""
    if method != "denoised":
        return None
    return frame.estimates.get(_input_name(frame, biased))


def choose(
    key: Key,
    frame: Frame,
    *,
    biased: str | None = None,
    budget: float | None = None,
    methods: Sequence[str] = CANDIDATES,
) -> Choice:
    """Find the method of minimum estimated error for a frame.

    Decides on values, so not for `jit`. Takes about twice as long as all methods
    together, each of which is compiled when it is first used on a size of image. To
    judge one that needs halves takes four sub-buffers, and denoises the quarters.

    Args:
        key: of random probes, a typed key.
        frame: with half buffers, of itself and of the biased image.
        biased: as for `combine`.
        budget: seconds that a method may take for a half; None for any.
        methods: to choose from, the cheapest first.

    Returns:
        the method and the evidence for it. Without halves nothing can be judged: then
        `whitened`, or `denoised` for a frame without variance, and no trials.

    Raises:
        ValueError: if there is no such biased image or method, no method at all, or
            several estimates and no name.

    Example:
        >>> from jscomb.frame import make_frame
        >>> noise = jax.random.normal(jax.random.key(0), (2, 32, 32, 3))
        >>> y = jnp.ones((2, 32, 32, 3))
        >>> frame = make_frame(
        ...     1 + noise / 4, variance=y[0] / 32, estimates={"y": Estimate(y[0], y)}
        ... )
        >>> found = choose(jax.random.key(0), frame, methods=["denoised", "whitened"])
        >>> print(found.method)
        denoised

    Source: ours.
    """
    if not methods or not set(methods) <= METHODS.keys():
        raise ValueError(f"methods {list(methods)}: there are {', '.join(METHODS)}")
    frame = frame.normalised()
    name = _input_name(frame, biased)
    frame = _with_input(key, frame, name)
    if frame.sub_buffers < 2 or frame.estimates[name].halves is None:
        known = not METHODS["whitened"].needs.missing(frame)
        return Choice("whitened" if known else "denoised", (), None)
    cheapest, *others = methods
    make = functools.partial(_halves, key, frame, name)
    x = jnp.stack([half.color for half in frame.halves()])
    y, _ = make(cheapest)
    made, trials = {cheapest: y}, []
    for method in others:
        if reason := _unfit(method, frame, name):
            trials.append(Trial(method, None, 0.0, reason))
            continue
        made[method], seconds = make(method)
        change = metrics.rel_l2_change(
            made[method], y, x, epsilon=_EPSILON, limit=_LIMIT
        )
        late = budget is not None and seconds > budget
        reason = f"takes {seconds:.2g} s of {budget:.2g}" if late else ""
        trials.append(Trial(method, change, seconds, reason))
    best = _best(trials) or cheapest
    return Choice(best, tuple(trials), made[best])


def _best(trials: Sequence[Trial]) -> str | None:
    """The method of minimum error among those within budget that surely lower it."""
    judged = {t.method: t.change for t in trials if t.change and not t.reason}
    sure = {m: float(sum(change)) for m, change in judged.items() if change.helps}
    return min(sure, key=lambda method: sure[method], default=None)


def _unfit(method: str, frame: Frame, name: str) -> str:
    """Why a method cannot be judged with this biased image; else empty."""
    chosen = METHODS[method]
    if chosen.takes == "nothing" and name != chosen.denoiser:
        return f"{method} does not take {name}"
    if missing := chosen.needs.missing_for_halves(frame):
        return f"{method} needs {missing}"
    if chosen.needs.halves and not _can_make(name, frame):
        return f"{method} needs {name} of quarters, which only a denoiser can make"
    return ""


def _halves(
    key: Key, frame: Frame, name: str, method: str
) -> tuple[Float[Array, "2 h w c"], float]:
    """A method's images of both halves, and the seconds of one."""
    images, seconds = [], 0.0
    for half in frame.halves():
        start = time.perf_counter()
        half, given = _given(key, half, method, name)
        image = METHODS[method].image(key, half, *estimates_of(half, given))
        images.append(jax.block_until_ready(image))
        seconds = time.perf_counter() - start  # the second half without compilation
    return jnp.stack(images), seconds


def inputs(
    frame: Frame, biased: str | Sequence[str] | None = None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return which bases an ensemble of a frame has, and why others are skipped.

    Args:
        frame: the frame.
        biased: names of estimates and denoisers; None for all of the frame's estimates
            and `BASES`.

    Returns:
        the names, and the reasons by name.

    Raises:
        ValueError: if a name is neither an estimate nor a method.

    Example:
        >>> from jscomb.frame import make_frame
        >>> names, skipped = inputs(make_frame(jnp.ones((2, 4, 4, 1))).normalised())
        >>> print(names, sorted(skipped))
        () ['bilateral', 'oidn', 'oidn-color', 'pd', 'rdfc']
    """
    if isinstance(biased, str):
        biased = [biased]
    wanted = [*frame.estimates, *BASES] if biased is None else list(biased)
    names, skipped = [], {}
    for name in dict.fromkeys(wanted):
        if name in frame.estimates:
            has = frame.estimates[name].halves is not None
            reason = "" if has or _can_make(name, frame) else "it has no halves"
        elif name in METHODS:
            reason = METHODS[name].needs.missing_for_halves(frame)
            reason = f"needs {reason}" if reason else ""
        else:
            raise ValueError(_unknown(name, frame))
        if reason:
            skipped[name] = reason
        else:
            names.append(name)
    return tuple(names), skipped


def _given(
    key: Key, frame: Frame, method: str, biased: str | Sequence[str] | None
) -> tuple[Frame, tuple[Any, ...]]:
    """The frame with the estimates that a method takes, and the makers of those."""
    if method not in METHODS:
        raise ValueError(f"no method {method!r}; there are {', '.join(METHODS)}")
    chosen = METHODS[method]
    frame.require(method, chosen.needs)
    if chosen.takes == "nothing":
        if biased not in (None, chosen.denoiser):
            raise ValueError(f"{method} takes no biased image, got {biased!r}")
        return frame, ()
    if chosen.takes == "estimates":
        names, skipped = inputs(frame, biased)
        if not names:
            raise ValueError(f"{method} has no bases: {_listed(skipped)}")
        for name in names:
            frame = _with_input(key, frame, name)
        return frame, ({name: _maker(key, frame, name) for name in names},)
    name = _input_name(frame, biased)
    frame = _with_input(key, frame, name)
    return frame, (_maker(key, frame, name),)


def _listed(reasons: Mapping[str, str]) -> str:
    """Names and reasons in one line."""
    return "; ".join(f"{name} {reason}" for name, reason in reasons.items())


def _input_name(frame: Frame, biased: str | Sequence[str] | None) -> str:
    """The biased image to combine with."""
    held = list(frame.estimates)
    if biased is None:
        if len(held) > 1:
            raise ValueError(f"which biased image? this frame has {', '.join(held)}")
        return held[0] if held else _DENOISER
    if not isinstance(biased, str):
        raise ValueError(f"expected one biased image, got {list(biased)}")
    if biased not in held and biased not in METHODS:
        raise ValueError(_unknown(biased, frame))
    return biased


def _unknown(name: str, frame: Frame) -> str:
    """The error for a biased image that is neither held nor can be made."""
    held = ", ".join(frame.estimates) or "none"
    return (
        f"no biased image {name!r}: this frame has {held}, and there is no such method"
    )


def _with_input(key: Key, frame: Frame, name: str) -> Frame:
    """The frame with an estimate, made if it is not there."""
    if name in frame.estimates:
        return frame
    method = METHODS[name]
    frame.require(name, method.needs)
    if method.takes != "nothing":
        raise ValueError(
            f"{name} takes a biased image itself: make it first, and add it by "
            f"frame.with_estimate({name!r}, ...)"
        )
    return frame.with_estimate(name, method.estimate(key, frame))


def _can_make(name: str, frame: Frame) -> bool:
    """Whether the table's method of this name can make it anew of a half."""
    method = METHODS.get(name)
    return (
        method is not None
        and method.takes == "nothing"
        and not method.needs.missing_for_halves(frame)
    )


def _maker(key: Key, frame: Frame, name: str) -> Estimate | Maker:
    """The estimate of any part of a frame, with halves where a denoiser can make them.

    An estimate whose name is no denoiser's stays what it is.
    """
    if not _can_make(name, frame):
        return frame.estimates[name]
    method = METHODS[name]

    def make(part: Frame) -> Estimate:
        image, halves = part.estimates[name]
        if halves is None and not method.needs.missing_for_halves(part):
            of_halves = [method.image(key, half) for half in part.halves()]
            halves = jnp.stack(of_halves)
        return Estimate(image, halves)

    return make


def table() -> str:
    """Return all methods as a Markdown table: name, what each does, takes and needs.

    Returns:
        the table.

    Example:
        >>> print(table().splitlines()[0])
        | method | what it does | takes | needs |
    """
    rows = [
        f"| `{name}` | {m.summary} | {m.takes} | {m.needs.summary()} |"
        for name, m in METHODS.items()
    ]
    head = ["| method | what it does | takes | needs |", "| --- | --- | --- | --- |"]
    return "\n".join([*head, *rows])


__doc__ += f"\n{table()}\n"
