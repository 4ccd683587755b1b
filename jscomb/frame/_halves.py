"""Estimates with halves: the same image made of each half of a frame alone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jscomb.frame._frame import Estimate, Frame
from jscomb.frame._needs import Needs
from jscomb.typing import Image

Maker = Callable[[Frame], Estimate]
"""A denoiser, or a combiner with its other arguments bound."""


def with_halves(
    frame: Frame,
    make: Callable[..., Image],
    *given: Any,
    needs: Needs = Needs(),  # noqa: B008 (immutable)
) -> Estimate:
    """Make an image of a frame, and the same image of each half alone.

    Args:
        frame: the frame.
        make: from a frame, or a half as a frame, and its estimates to an image [H,W,C].
        given: what `make` takes beside the frame: estimates, makers of them, or trees
            of both. For a half, an estimate stands for its half, which has no halves
            of its own; a maker is called with the half.
        needs: what `make` needs of a frame; with `needs.halves` estimates must have
            halves.

    Returns:
        the estimate; its halves are None where a half lacks what is needed
        (`needs.missing_for_halves`), or an estimate has no halves to pass on.

    Example:
        >>> from jscomb.frame import make_frame
        >>> frame = make_frame(jnp.stack([jnp.zeros((2, 2, 1)), jnp.ones((2, 2, 1))]))
        >>> double = lambda part: 2 * part.color
        >>> made = with_halves(frame, double)
        >>> print(made.image[0, 0], made.halves[:, 0, 0, 0])
        [1.] [0. 2.]
        >>> add = lambda part, estimate: part.color + estimate.image
        >>> print(with_halves(frame, add, made).halves[:, 0, 0, 0])
        [0. 3.]
    """
    image = make(frame, *estimates_of(frame, given))
    if not halves_possible(frame, *given, needs=needs):
        return Estimate(image)
    parts = [
        (half, estimates_of(half, given, number=number))
        for number, half in enumerate(frame.halves())
    ]
    made = _leaves([own for _, own in parts])
    if needs.halves and any(estimate.halves is None for estimate in made):
        return Estimate(image)  # a maker could not make them of a half
    return Estimate(image, jnp.stack([make(half, *own) for half, own in parts]))


def halves_possible(frame: Frame, *given: Any, needs: Needs) -> bool:
    """Return whether a combiner can be run on each half of a frame alone.

    Args:
        frame: the frame.
        given: estimates of it, makers, or trees of both.
        needs: what the combiner needs of a frame; with `needs.halves` an estimate is
            not enough, because its halves have no halves of their own.

    Returns:
        whether; `needs.missing_for_halves` is the reason if the frame is in the way.

    Example:
        >>> from jscomb.frame import make_frame
        >>> frame = make_frame(jnp.ones((2, 2, 2, 1)))
        >>> print(halves_possible(frame, needs=Needs(halves=True)))
        False
    """
    fixed = [e for e in _leaves(given) if isinstance(e, Estimate)]
    passed_on = all(e.halves is not None for e in fixed)
    return passed_on and not (
        needs.missing_for_halves(frame) or (needs.halves and fixed)
    )


def estimates_of(part: Frame, given: Any, *, number: int | None = None) -> Any:
    """Return the estimates of a frame, or of one of its halves.

    Args:
        part: the frame or the half.
        given: estimates of the frame, makers, or a tree of both.
        number: of the half, 0 or 1; None for the frame.

    Returns:
        the tree with an estimate in place of each maker.

    Example:
        >>> from jscomb.frame import make_frame
        >>> frame = make_frame(jnp.ones((2, 2, 2, 1)))
        >>> maker = lambda part: Estimate(3 * part.color)
        >>> print(estimates_of(frame, {"three": maker})["three"].image[0, 0])
        [3.]
    """

    def one(each: Estimate | Maker) -> Estimate:
        if not isinstance(each, Estimate):
            return each(part)
        return each if number is None else each.half(number)

    return jax.tree.map(one, given, is_leaf=_is_leaf)


def _leaves(given: Any) -> list[Any]:
    """The estimates and makers of a tree."""
    return jax.tree.leaves(given, is_leaf=_is_leaf)


def _is_leaf(tree: Any) -> bool:
    """Whether a part of a tree is one estimate."""
    return isinstance(tree, Estimate)
