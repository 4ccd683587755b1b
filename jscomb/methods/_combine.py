"""The front door: normalise a frame, make its estimate, scale the result back."""

from collections.abc import Sequence

import jax

from jscomb.frame import Estimate, Frame, estimates_of
from jscomb.methods._inputs import given_to, input_name
from jscomb.methods._table import METHODS
from jscomb.methods._tiers import TIERS, combine_tier
from jscomb.numerics.tiles import Local
from jscomb.typing import Key


def combine(
    key: Key,
    frame: Frame,
    *,
    method: str | None = None,
    biased: str | Sequence[str] | None = None,
    budget: float | None = None,
) -> Estimate:
    """Make the estimate of a frame by a method, or by the default one.

    Normalises the frame, and scales the result back. Some methods decide on values, so
    this is not for `jit`; the papers' own functions are, where their parts are.

    Args:
        key: of random probes, a typed key.
        frame: in any unit.
        method: a key of `METHODS`, or of `TIERS`, as `combine_tier` takes it; None for
            the best tier within the budget.
        biased: the biased image to combine with: an estimate of the frame, or a
            denoiser of `METHODS`; several for an ensemble. None for the frame's only
            estimate, or Open Image Denoise if it has none; for an ensemble all of them
            and the method's `bases`.
        budget: seconds that a tier may take, without compilation; None for any.

    Returns:
        the estimate, in the frame's unit. Its halves are None where they cannot be
        made: `METHODS[method].missing_for_halves(frame)` returns the reason. With
        two sub-buffers, and in a tier, the halves of an ensemble share its weights.

    Raises:
        ValueError: if there is no such method or biased image, or the frame lacks what
            the method needs; says what and how to get it.
        ImportError: if a package is missing; says how to install it.

    Example:
        >>> import jax.numpy as jnp
        >>> from jscomb.frame import make_frame
        >>> x, y = jnp.full((3, 3, 1), 3.0), jnp.ones((3, 3, 1))
        >>> frame = make_frame(x, variance=y, estimates={"y": y})
        >>> for method in ("denoised", "james-stein"):
        ...     made = combine(jax.random.key(0), frame, method=method)
        ...     print(made.image[0, 0].round(3))
        [1.]
        [2.611]
    """
    if method is None or method in TIERS:
        made = combine_tier(key, frame, tier=method, biased=biased, budget=budget)
        return made.estimate
    if (unchanged := _unchanged(frame, method, biased)) is not None:
        return unchanged
    whole, given = given_to(key, frame.normalised(), method, biased)
    made = METHODS[method].estimate(key, whole, *given)
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
        >>> import jax.numpy as jnp
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
    whole, given = given_to(key, frame.normalised(), method, biased)
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
    return frame.estimates.get(input_name(frame, biased=biased))
