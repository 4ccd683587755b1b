"""What denoisers and combiners need of a frame."""

import importlib.util
from typing import NamedTuple

from jscomb.frame._frame import Frame


class Package(NamedTuple):
    """An optional package.

    Attributes:
        module: its name in Python.
        extra: the extra of jscomb that installs it.
    """

    module: str
    extra: str


class Needs(NamedTuple):
    """What a denoiser or combiner needs of a frame.

    Attributes:
        variance: the variance, or sub-buffers to estimate it from.
        halves: half buffers.
        variance_of_halves: the variance of each half, or sub-buffers to estimate it
            from.
        channels: of the colour; None for any number.
        features: names of features, such as albedo.
        normalised: radiance divided by the median luminance.
        package: a package beside jscomb's own; None for none.
    """

    variance: bool = False
    halves: bool = False
    variance_of_halves: bool = False
    channels: int | None = None
    features: tuple[str, ...] = ()
    normalised: bool = False
    package: Package | None = None

    def summary(self) -> str:
        """Return all needs in a few words; empty if there are none."""
        some = {
            "variance": self.variance,
            "half buffers": self.halves,
            f"{self.channels} channels": self.channels is not None,
            ", ".join(self.features): bool(self.features),
            f"extra `{self.package and self.package.extra}`": bool(self.package),
        }
        return ", ".join(name for name, needed in some.items() if needed)

    def missing_package(self) -> str:
        """Return which package is missing and how to install it; empty if none."""
        if self.package is None or importlib.util.find_spec(self.package.module):
            return ""
        module, extra = self.package
        return f'the package {module}: pip install "jscomb[{extra}]"'

    def missing(self, frame: Frame) -> str:
        """Return what a frame lacks and how to get it, in one line; empty if nothing.

        Args:
            frame: the frame.

        Returns:
            the line, to follow "needs".
        """
        return self._missing(frame, parts=1)

    def missing_for_halves(self, frame: Frame) -> str:
        """Return what the halves of a frame lack; empty if each half has enough.

        Args:
            frame: the full frame.

        Returns:
            the line, to follow "needs".
        """
        return self._missing(frame, parts=2)

    def _missing(self, frame: Frame, *, parts: int) -> str:
        """What a frame lacks that is used as one or as two parts."""
        if self.normalised and frame.unit is None:
            return "a normalised frame: call frame.normalised(), or use jscomb.combine"
        has, channels = frame.sub_buffers, frame.buffers.color.shape[-1]
        unknown = frame.buffers.variance is None
        estimates = (self.variance or self.variance_of_halves) and unknown
        halves = self.halves or self.variance_of_halves
        wanted = parts * (2 if estimates or halves else 1)
        if self.variance_of_halves and unknown:
            wanted *= 2
        lacking = [f for f in self.features if getattr(frame.buffers, f) is None]
        if has < wanted:
            what = "half buffers" if halves or not estimates else "the variance"
            also = " with variances, or" if estimates else ""
            return (
                f"{what}: render{also} at least {wanted} sub-buffers (this frame has "
                f"{has})"
            )
        if self.channels not in (None, channels):
            return f"{self.channels} channels of colour, not {channels}"
        if lacking:
            return f"{', '.join(lacking)}: render with these features"
        return self.missing_package()
