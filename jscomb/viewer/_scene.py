"""What the viewer shows."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jscomb.frame import Reference
from jscomb.metrics import rel_l2
from jscomb.numerics.guards import finite

REFERENCE = "reference"


class Scene(NamedTuple):
    """Images of one view, to be flipped between.

    Attributes:
        name: of the scene.
        images: by name, linear radiance, [H,W,3] or [H,W,1]; the reference, if there is
            one, last and by that name.
        notes: a few words about images, by name, such as an error.
        maps: maps of images' errors by kind ("flip", "hdr-flip", "estimated", or
            another word), then by name, [H,W,1]. Relative squared errors are not
            needed: the viewer computes them.
    """

    name: str
    images: Mapping[str, np.ndarray]
    notes: Mapping[str, str]
    maps: Mapping[str, Mapping[str, np.ndarray]]


def make_scene(
    name: str,
    images: Mapping[str, ArrayLike],
    *,
    reference: Reference | ArrayLike | None = None,
    maps: Mapping[str, Mapping[str, ArrayLike]] | None = None,
) -> Scene:
    """Make a scene, with the relative L2 of every image as its note.

    Args:
        name: of the scene.
        images: by name, linear radiance, [H,W,3] or [H,W,1], all of one shape.
        reference: of that shape; its own noise is subtracted where it is known.
        maps: as in `Scene`.

    Returns:
        the scene, its arrays in the host's memory. Pixels that are not finite are
        excluded from the errors, and shown in magenta.

    Raises:
        ValueError: if there is no image, shapes differ, or a map is of no image.

    Example:
        >>> grey = np.full((4, 4, 3), 0.2, np.float32)
        >>> scene = make_scene("grey", {"darker": 0.9 * grey}, reference=grey)
        >>> print(list(scene.images), scene.notes["darker"])
        ['darker', 'reference'] relative L2 0.008
    """
    held = {n: np.asarray(image) for n, image in images.items()}
    if not held:
        raise ValueError(f"{name}: a scene needs an image")
    if reference is not None and not isinstance(reference, Reference):
        reference = Reference(jnp.asarray(reference))
    notes = {}
    if reference is not None:
        held = {n: i for n, i in held.items() if n != REFERENCE}
        held[REFERENCE] = np.asarray(reference.image)
    _check(name, held, maps or {})
    for n, image in held.items():
        if reference is None or n == REFERENCE:
            continue
        a, r = jnp.asarray(image), jnp.asarray(reference.image)
        noise, mask = reference.half_difference, finite(a, r)
        error = rel_l2(a, r, half_difference=noise, mask=mask)
        notes[n] = f"relative L2 {float(error):.3g}"
    kept = {
        k: {n: np.asarray(m) for n, m in of.items()} for k, of in (maps or {}).items()
    }
    return Scene(name, held, notes, kept)


def _check(
    name: str, images: Mapping[str, np.ndarray], maps: Mapping[str, Mapping]
) -> None:
    """Raise unless all images have one shape and all maps an image."""
    first, image = next(iter(images.items()))
    if image.ndim != 3 or image.size == 0 or image.shape[-1] not in (1, 3):
        raise ValueError(f"{name}: {first} is {image.shape}, expected (H, W, 3 or 1)")
    for other, another in images.items():
        if another.shape != image.shape:
            what = f"{other} is {another.shape}, {first} is {image.shape}"
            raise ValueError(f"{name}: {what}: one scene has images of one shape")
    for kind, of in maps.items():
        for other, error in of.items():
            if other not in images or np.shape(error) != (*image.shape[:2], 1):
                what = f"the {kind} map of {other} is {np.shape(error)}"
                wanted = f"one [H,W,1] of {', '.join(images)}"
                raise ValueError(f"{name}: {what}, expected {wanted}")
