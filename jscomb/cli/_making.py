"""An image that `combine` has made, of what, and why so."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from jscomb import methods
from jscomb.cli._telling import sentence, summary
from jscomb.frame import Frame
from jscomb.typing import Image


class Made(NamedTuple):
    """An image, by which method or tier, of which estimates, and what a tier tells."""

    method: str
    image: Image
    bases: list[str]
    by: methods.Combined | None = None

    def reason(self, frame: Frame) -> str:
        """Why not by the tier that was asked for or the best; may be empty."""
        if self.by is None:
            return ""
        if lacks_noise(frame):
            return f"the frame has neither variance nor half buffers{remedy(frame)}"
        return self.by.reason

    def sentence(self, frame: Frame) -> str:
        """What a tier did and why."""
        assert self.by is not None
        return sentence(self.by, self.reason(frame))

    def summary(self, frame: Frame) -> dict[str, Any]:
        """What was done and why, for JSON."""
        by, about = self.by, {"bases": self.bases}
        if by is None:
            return {"tier": None, "method": self.method, **about}
        why = {"skipped": by.skipped, "reason": self.reason(frame)}
        return {"tier": by.tier, "method": None, **about, **why, **summary(by)}


def lacks_noise(frame: Frame) -> bool:
    """Return whether nothing tells how noisy a frame is.

    Args:
        frame: to combine.
    """
    return frame.buffers.variance is None and frame.sub_buffers < 2


def remedy(frame: Frame) -> str:
    """Return what would make more possible; empty if nothing is missing.

    Args:
        frame: to combine.
    """
    if not lacks_noise(frame):
        return ""
    return (
        "; a second render with another seed (--halves) or a variance (--variance) "
        "lets it be combined better"
    )


def by_tier(
    frame: Frame,
    tier: str | None,
    name: str | None = None,
    budget: float | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> Made:
    """Combine a frame by a tier.

    Args:
        frame: to combine.
        tier: a name; None for the best within the budget.
        name: of the biased image; None for the tier's.
        budget: seconds; None for any.
        progress: told what is about to be made.
    """
    made = methods.combine_tier(
        jax.random.key(0),
        frame,
        tier=tier,
        biased=name,
        budget=budget,
        progress=progress,
    )
    return Made(made.tier, made.estimate.image, list(made.bases), made)


def made_of(frame: Frame, name: str | None, method: str) -> list[str]:
    """Return the names of the estimates that a method combines.

    Args:
        frame: that is combined.
        name: of the biased image; None for any.
        method: a name.
    """
    chosen = methods.METHODS[method]
    if chosen.takes == "estimates":
        return list(methods.inputs(frame.normalised(), biased=name, method=method)[0])
    if chosen.takes == "nothing":
        return [chosen.denoiser] if chosen.denoiser else []
    return [methods.input_name(frame, biased=name)]
