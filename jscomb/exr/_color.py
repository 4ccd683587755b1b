"""What the numbers of a file mean: its primaries and white point.

Chromaticities are eight numbers: x and y of red, green, blue and white. A file that
states none is of Rec. 709, as OpenEXR has it.
"""

from typing import Any

import numpy as np
import OpenEXR

Chromaticities = tuple[float, ...]
REC_709: Chromaticities = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
_NAME = "colorInteropID"
_SAME = 1e-4  # chromaticities that differ by less are rounded ones


def stated(attributes: dict[str, Any]) -> Chromaticities | None:
    """Return the chromaticities of a header; None if it states none that are usable.

    Stated as such, or by the name of a linear colour space.
    """
    found = attributes.get("chromaticities")
    known = getattr(OpenEXR, "colorInteropIDToChromaticities", None)
    if found is None and known and isinstance(attributes.get(_NAME), str):
        found = known(attributes[_NAME])
    if not isinstance(found, tuple) or len(found) != 8:
        return None
    matrix = _to_xyz(found)
    usable = np.isfinite(matrix).all() and abs(np.linalg.det(matrix)) > 1e-6
    return tuple(float(x) for x in found) if usable else None


def agree(a: Chromaticities | None, b: Chromaticities | None) -> bool:
    """Return whether two files mean the same by their numbers."""
    return bool(np.allclose(a or REC_709, b or REC_709, rtol=0, atol=_SAME))


def conversion(source: Chromaticities, target: Chromaticities) -> np.ndarray:
    """Return the matrix from linear RGB of one kind to another, [3,3].

    White becomes white (the Bradford transform).
    """
    from_xyz = np.linalg.inv(_to_xyz(target))
    whites = [_BRADFORD @ _white(c) for c in (source, target)]
    adapt = np.linalg.inv(_BRADFORD) @ np.diag(whites[1] / whites[0]) @ _BRADFORD
    return from_xyz @ adapt @ _to_xyz(source)


def luminance_weights(chromaticities: Chromaticities | None) -> np.ndarray:
    """Return how much of the luminance is red, green and blue, [3]; they add to one."""
    return _to_xyz(chromaticities or REC_709)[1]


def _white(chromaticities: Chromaticities) -> np.ndarray:
    """X, Y and Z of white."""
    x, y = chromaticities[6:]
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _to_xyz(chromaticities: Chromaticities) -> np.ndarray:
    """The matrix from linear RGB to CIE XYZ; not finite for impossible primaries."""
    pairs = np.reshape(np.asarray(chromaticities, float), (4, 2))
    with np.errstate(all="ignore"):
        columns = np.stack([pairs[:3, 0], pairs[:3, 1], 1 - pairs[:3].sum(axis=1)])
        try:
            return columns * np.linalg.solve(columns, _white(chromaticities))
        except (np.linalg.LinAlgError, ZeroDivisionError):
            return np.full((3, 3), np.nan)
