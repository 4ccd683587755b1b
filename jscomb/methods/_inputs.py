"""What a method is given of a frame: its estimates, made where they are missing."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jscomb.denoisers import oidn
from jscomb.frame import Estimate, Frame, Maker
from jscomb.methods._table import METHODS
from jscomb.numerics.tiles import cut, padded
from jscomb.typing import Key

_LARGE = 2**21  # pixels
_DENOISER = "oidn"  # for frames without an estimate


def inputs(
    frame: Frame,
    *,
    biased: str | Sequence[str] | None = None,
    method: str = "ensemble",
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return which bases an ensemble of a frame has, and why others are skipped.

    Args:
        frame: the frame.
        biased: names of estimates and denoisers; None for all of the frame's estimates
            and the `bases` of the method.
        method: that takes several estimates.

    Returns:
        the names, and the reasons by name.

    Raises:
        ValueError: if a name is neither an estimate nor a method.

    Example:
        >>> from jscomb.frame import make_frame
        >>> names, skipped = inputs(make_frame(jnp.ones((2, 4, 4, 1))).normalised())
        >>> print(names, sorted(set(skipped) - set(oidn.VARIANTS)))
        () ['bilateral', 'pd', 'rdfc']
    """
    if isinstance(biased, str):
        biased = [biased]
    if biased is None:
        biased = [*frame.estimates, *METHODS[method].bases]
    names, skipped = [], {}
    for name in dict.fromkeys(biased):
        if name in frame.estimates:
            has = frame.estimates[name].halves is not None
            reason = "" if has or can_make(name, frame) else "it has no halves"
        elif name in METHODS:
            reason = _unfit(name, frame)
        else:
            raise ValueError(_unknown(name, frame))
        if reason:
            skipped[name] = reason
        else:
            names.append(name)
    return tuple(names), skipped


def _unfit(name: str, frame: Frame) -> str:
    """Why a method cannot make an estimate with halves; empty if it can."""
    method = METHODS[name]
    missing = method.missing_for_halves(frame)
    if not missing and method.takes == "one estimate":
        wanted = method.input or _DENOISER
        held = frame.estimates.get(wanted)
        of_halves = method.needs.halves and wanted in METHODS  # made anew of each half
        if held is None or held.halves is None or of_halves:
            missing = _missing_input(wanted, frame)
    return f"needs {missing}" if missing else ""


def _missing_input(name: str, frame: Frame) -> str:
    """What is missing of an estimate that has no halves; empty if it can be made."""
    if name in METHODS:
        return METHODS[name].missing_for_halves(frame)
    return f"an estimate {name!r} with halves: frame.with_estimate({name!r}, ...)"


def given_to(
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
        names, skipped = inputs(frame, biased=biased, method=method)
        if not names:
            raise ValueError(f"{method} has no bases: {_listed(skipped)}")
        frame = with_inputs(key, frame, names)
        return frame, ({name: _maker(key, frame, name) for name in names},)
    if biased is None and chosen.input is not None:
        if chosen.input not in frame.estimates:
            raise ValueError(f"{method} needs {_missing_input(chosen.input, frame)}")
        biased = chosen.input
    name = input_name(frame, biased=biased)
    frame = with_input(key, frame, name)
    if not chosen.needs.halves and frame.estimates[name].halves is not None:
        return frame, (frame.estimates[name],)  # its halves need no halves
    return frame, (_maker(key, frame, name),)


def taken_by(
    method: str, biased: str | Sequence[str] | None
) -> str | Sequence[str] | None:
    """The biased image, if the method takes one; None for what it takes by itself."""
    return biased if METHODS[method].takes == "one estimate" else None


def _listed(reasons: Mapping[str, str]) -> str:
    """Names and reasons in one line."""
    return "; ".join(f"{name} {reason}" for name, reason in reasons.items())


def input_name(frame: Frame, *, biased: str | Sequence[str] | None = None) -> str:
    """Return the name of the biased image that a method of one estimate takes.

    Args:
        frame: the frame.
        biased: as for `combine`.

    Returns:
        the name.

    Raises:
        ValueError: if there are several and none is named, or the name is unknown.

    Example:
        >>> from jscomb.frame import make_frame
        >>> print(input_name(make_frame(jnp.ones((2, 4, 4, 3)))))
        oidn
    """
    held = list(frame.estimates)
    if biased is None:
        if len(held) > 1:
            raise ValueError(
                f"which biased image? this frame has {', '.join(held)}: name one by "
                "biased (--biased)"
            )
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


def with_input(key: Key, frame: Frame, name: str) -> Frame:
    """The frame with an estimate, made if it is not there; a combiner's of `oidn`."""
    if name in frame.estimates:
        return frame
    method = METHODS[name]
    if method.takes == "estimates":
        raise ValueError(
            f"{name} takes several estimates itself: make it first, and add it by "
            f"frame.with_estimate({name!r}, ...)"
        )
    frame, given = given_to(key, frame, name, taken_by(name, method.input or _DENOISER))
    return frame.with_estimate(name, method.estimate(key, frame, *given))


def with_inputs(
    key: Key,
    frame: Frame,
    names: Sequence[str],
    *,
    progress: Callable[[str], None] | None = None,
) -> Frame:
    """Return the frame with estimates, made if they are not there.

    Args:
        key: of random probes, a typed key.
        frame: normalised.
        names: of the frame's estimates, or of methods.
        progress: called with what is about to be made ("making pd"), once all before is
            computed; None to compute without waiting.

    Returns:
        the frame with all of them; those of one kind are made together.

    Raises:
        ValueError: if the frame lacks what a method needs.

    Example:
        >>> import jax
        >>> from jscomb.frame import make_frame
        >>> frame = make_frame(jnp.ones((2, 4, 4, 3))).normalised()
        >>> print(*with_inputs(jax.random.key(0), frame, ["path-tracing"]).estimates)
        path-tracing
    """
    made = {n: METHODS[n].variant for n in names if n not in frame.estimates}
    variants = {n: variant for n, variant in made.items() if variant is not None}
    if variants:
        tell(progress, f"making {', '.join(variants)}", frame)
        estimates = oidn.denoise_variants(frame, list(variants.values()))
        for name, estimate in zip(variants, estimates, strict=True):
            frame = frame.with_estimate(name, estimate)
    local = []
    for name in names:
        if name in frame.estimates:
            continue
        if _sees_only_pixels(name, frame):
            local.append(name)
            continue
        tell(progress, f"making {name}", frame)
        frame = with_input(key, frame, name)
    wide = of_shared_size(frame) if local else frame
    for name in local:
        tell(progress, f"making {name}", wide)
        wide = with_input(key, wide, name)
        estimate = cut(wide.estimates[name], *frame.color.shape[:2])
        frame = frame.with_estimate(name, estimate)
    return frame


def of_shared_size(frame: Frame) -> Frame:
    """The frame with invalid pixels beside it, so that sizes near it share programs.

    A large one as it is: it takes longer than its compilation, and a copy of it room.
    """
    return padded(frame) if frame.color[..., 0].size <= _LARGE else frame


def _sees_only_pixels(name: str, frame: Frame) -> bool:
    """Whether invalid pixels beside a frame change nothing of an estimate.

    So it is for local functions of what is there; denoisers fill such pixels first.
    """
    method, held = METHODS[name], frame.estimates.get(_DENOISER)
    there = held is not None and held.halves is not None
    return method.pure and (method.takes == "nothing" or there)


def tell(progress: Callable[[str], None] | None, what: str, before: Any) -> None:
    """Call with what is about to be made, when all arrays before it are computed."""
    if progress is not None:
        jax.block_until_ready(before)
        progress(what)


def can_make(name: str, frame: Frame) -> bool:
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
    if not can_make(name, frame):
        return frame.estimates[name]
    method = METHODS[name]

    def make(part: Frame) -> Estimate:
        image, halves = part.estimates[name]
        if halves is None and method.own_halves:
            halves = method.estimate(key, part).halves
        elif halves is None and not method.needs.missing_for_halves(part):
            of_halves = [method.image(key, half) for half in part.halves()]
            halves = jnp.stack(of_halves)
        return Estimate(image, halves)

    return make
