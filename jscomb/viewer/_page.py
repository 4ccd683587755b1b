"""The page: images as text, and what shows them."""

import base64
import dataclasses
import html
import importlib.resources
import json
import zlib
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jscomb.numerics.luminance import median_luminance
from jscomb.numerics.tiles import compiled
from jscomb.viewer._scene import REFERENCE, Scene

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>body {{ margin: 0; background: #1d1d1f; }}</style>
{element}
</html>
"""
_GREY = 0.18  # what the median is displayed as, before the tone curve
_EPSILON = 0.01  # of the relative squared error, as `metrics.rel_l2`
_LEVEL = 4  # of compression: more takes long and saves a hundredth


def page(scenes: Sequence[Scene], *, title: str = "jscomb view") -> str:
    """Return a page that shows scenes.

    Args:
        scenes: by `make_scene`.
        title: of the page.

    Returns:
        HTML that needs nothing else; about two bytes for a channel of a pixel.

    Raises:
        ValueError: if there is no scene.

    Example:
        >>> from jscomb.viewer import make_scene
        >>> text = page([make_scene("grey", {"a": np.full((2, 2, 3), 0.2)})])
        >>> print(text.splitlines()[0], "http" in text)
        <!doctype html> False
    """
    return _PAGE.format(title=html.escape(title), element=element(scenes, address=True))


def element(scenes: Sequence[Scene], *, address: bool = False) -> str:
    """Return the viewer as an element of a page.

    Args:
        scenes: by `make_scene`.
        address: keep what is looked at in the page's address, and listen to its keys:
            for one element of a page. Others listen while they have the focus.

    Returns:
        HTML with its style and scripts.

    Raises:
        ValueError: if there is no scene.

    Example:
        >>> from jscomb.viewer import make_scene
        >>> text = element([make_scene("grey", {"a": np.full((2, 2, 3), 0.2)})])
        >>> print(text[:26])
        <div class="jscomb-viewer"
    """
    if not scenes:
        raise ValueError("the viewer needs a scene")
    blobs: list[str] = []
    about = {"scenes": [_described(s, blobs) for s in scenes], "colours": _colours()}
    # Inside a script element only this could end it.
    data = json.dumps(about).replace("</", "<\\/")
    held = "\n".join(
        f'<script type="text/plain" data-blob="{number}">{blob}</script>'
        for number, blob in enumerate(blobs)
    )
    code = "\n".join(_file(f"{name}.js") for name in ("painter", "widgets", "viewer"))
    return (
        f'<div class="jscomb-viewer" data-address="{"yes" if address else ""}">\n'
        f"<style>\n{_file('viewer.css')}</style>\n"
        f'<script type="application/json" data-scenes>{data}</script>\n{held}\n</div>\n'
        f'<script>\n"use strict";\n(() => {{\n{code}}})();\n</script>\n'
    )


@dataclasses.dataclass(frozen=True)
class Cell:
    """The viewer as the output of a notebook's cell.

    Attributes:
        scenes: by `make_scene`.
        height: in pixels.

    Example:
        >>> from jscomb.viewer import make_scene
        >>> cell = Cell([make_scene("grey", {"a": np.full((2, 2, 3), 0.2)})])
        >>> print(cell._repr_html_()[:7])
        <iframe
    """

    scenes: Sequence[Scene]
    height: int = 720

    def _repr_html_(self) -> str:
        """A frame of its own, so that the notebook's style and keys stay outside."""
        inside = html.escape(page(self.scenes))
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe style="{style}" srcdoc="{inside}"></iframe>'


def _described(scene: Scene, blobs: list[str]) -> dict[str, Any]:
    """What the viewer reads of a scene; its pixels are added to `blobs`."""
    names, images = list(scene.images), scene.images
    chosen = np.asarray(images.get(REFERENCE, images[names[0]]), np.float32)
    unit = float(compiled(median_luminance)(jnp.asarray(chosen)))
    height, width, _ = chosen.shape

    def stored(values: np.ndarray) -> dict[str, Any]:
        kind, text = packed(values)
        blobs.append(text)
        return {"id": len(blobs) - 1, "type": kind, "channels": values.shape[-1]}

    return {
        "name": scene.name,
        "width": width,
        "height": height,
        "unit": unit,
        "stops": round(np.log2(_GREY / unit)),
        "epsilon": _EPSILON / unit**2,
        "reference": names.index(REFERENCE) if REFERENCE in names else None,
        "images": [
            {
                "name": name,
                "note": scene.notes.get(name, ""),
                "pixels": stored(np.asarray(images[name]) / unit),
                "maps": {
                    kind: stored(np.asarray(of[name]))
                    for kind, of in scene.maps.items()
                    if name in of
                },
            }
            for name in names
        ],
    }


def packed(values: np.ndarray) -> tuple[str, str]:
    """Return the type of number, half or float, and the numbers as a short text.

    The bytes of like place stand together, deflated, as base64: exponents compress.
    """
    values = np.asarray(values, np.float32)
    some = np.abs(values[np.isfinite(values)])
    fits = some.size == 0 or some.max() <= np.finfo(np.float16).max
    numbers = values.astype("<f2" if fits else "<f4")
    planes = numbers.reshape(-1, 1).view(np.uint8).T
    deflated = zlib.compress(np.ascontiguousarray(planes).tobytes(), _LEVEL)
    return "half" if fits else "float", base64.b64encode(deflated).decode()


def _colours() -> str:
    """The colour map of errors: 256 RGB bytes."""
    import matplotlib as mpl  # slow to import

    magma = mpl.colormaps["magma"](np.arange(256), bytes=True)[:, :3]
    return base64.b64encode(magma.tobytes()).decode()


def _file(name: str) -> str:
    """A file beside this one."""
    return (importlib.resources.files("jscomb.viewer") / name).read_text()
