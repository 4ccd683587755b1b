"""Estimate images of a frame, stacked for an ensemble."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp

from jscomb.ensemble.errors import Bases
from jscomb.frame import Estimate


class Stacked(NamedTuple):
    """The bases of an ensemble, as `combine` and `select_bases` take them.

    Attributes:
        biased: made from the full frame, radiance, [N,H,W,C].
        biased_a: made from half a, likewise.
        biased_b: made from half b, likewise.
    """

    biased: Bases
    biased_a: Bases
    biased_b: Bases


def stack_bases(bases: Mapping[str, Estimate]) -> Stacked:
    """Stack biased images and those of the halves.

    Args:
        bases: biased images with halves, all of one shape, by name.

    Returns:
        the stacks, in the order of the names.

    Raises:
        ValueError: names the base that has no halves, or another shape than the first.

    Example:
        >>> y = jnp.ones((4, 5, 3))
        >>> stacked = stack_bases({"oidn": Estimate(y, jnp.stack([y, y]))})
        >>> print(*(images.shape for images in stacked))
        (1, 4, 5, 3) (1, 4, 5, 3) (1, 4, 5, 3)
    """
    if not bases:
        raise ValueError("an ensemble needs at least one base, got none")
    first, *_ = bases
    shape = bases[first].image.shape
    for name, base in bases.items():
        if base.halves is None:
            raise ValueError(f"base {name!r} was not made from each half too")
        if base.image.shape != shape:
            raise ValueError(
                f"base {name!r} has shape {base.image.shape}, {first!r} has {shape}"
            )
        if base.halves.shape != (2, *shape):
            raise ValueError(
                f"base {name!r} has halves of shape {base.halves.shape}, expected "
                f"{(2, *shape)}"
            )
    full, halves = zip(*bases.values(), strict=True)
    a, b = (jnp.stack([pair[k] for pair in halves]) for k in (0, 1))
    return Stacked(jnp.stack(full), a, b)
