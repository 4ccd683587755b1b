"""What the ensemble experiments share: six real denoisers, and rendered frames."""

import functools
import pathlib
from collections.abc import Callable, Sequence

import jax

from experiments.common import archives
from experiments.common.errors import Row
from jscomb import rendering
from jscomb.frame import Estimate, Frame, Maker, with_halves
from jscomb.methods import METHODS

BASES = "oidn", "oidn-color", "bilateral", "nonlocal-means", "rdfc", "nfor"


def maker(name: str) -> Maker:
    """A denoiser of the table of methods.

    Args:
        name: key of `METHODS`.

    Returns:
        the function from a normalised frame to its estimate.
    """
    return functools.partial(METHODS[name].estimate, jax.random.key(0))


def bases_of(frame: Frame) -> dict[str, Estimate]:
    """The bases of a frame and of its halves, in the order of `BASES`.

    Args:
        frame: normalised, with halves and variances; its own `oidn` is taken if it has
            one.

    Returns:
        the estimates, with halves.
    """
    made = {name: maker(name) for name in BASES if name not in frame.estimates}
    of = lambda name: frame.estimates.get(name) or made[name](frame)
    return {name: of(name) for name in BASES}


def unbiased_of(frame: Frame) -> Estimate:
    """The unbiased image as one more base."""
    return with_halves(frame, lambda part: part.color)


def best(row: Row) -> float:
    """Error of the best base."""
    return min(row[base] for base in BASES)


def measured(
    folders: Sequence[pathlib.Path],
    measure: Callable[[Frame], dict[str, float]],
    *,
    results: pathlib.Path | None,
    quick: bool,
) -> dict[str, dict[str, float]]:
    """Measure all frames of some folders, see `archives`.

    Args:
        folders: of archives and EXR files.
        measure: function of a normalised frame to numbers by name.
        results: file that results are kept in; None to keep none.
        quick: only the first frame.

    Returns:
        numbers by "folder/scene samples".
    """
    some = functools.partial(archives.measured, results=results, quick=quick)
    return {
        f"{folder.name}/{frame}": row
        for folder in folders[: 1 if quick else None]
        for frame, row in some(folder, {"": measure}).items()
    }


def rendered(scene: str, work: pathlib.Path, settings: rendering.Settings) -> Frame:
    """Render a scene, or take what a run has left.

    Args:
        scene: name of a scene, see `jscomb.rendering`, or an XML file.
        work: .npz file that keeps what is rendered; its folder is made.
        settings: what is rendered.

    Returns:
        the frame.
    """
    work.parent.mkdir(parents=True, exist_ok=True)
    return rendering.render(scene, settings, partial=work)
