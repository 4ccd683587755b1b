"""Scene files rendered by independent and by common random numbers, with references."""

import pathlib
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jscomb import rendering
from jscomb.frame import Frame, Reference
from jscomb.rendering import Settings

SubAverages = Float[Array, "b h w c"]

COMMON_SEED = 1_000_000
SUB_AVERAGES = 8
_FEATURE_SPP = 4


def scene_files(scenes: pathlib.Path, references: pathlib.Path) -> list[pathlib.Path]:
    """Every SCENES/NAME/scene.xml with a REFERENCES/NAME.npz (`archives`).

    Args:
        scenes: folder of folders with a Mitsuba scene.xml each.
        references: folder of archives with references of the same names.

    Returns:
        the XML files.

    Raises:
        ValueError: if no scene has a reference.
    """
    paths = sorted(scenes.glob("*/scene.xml"))
    paths = [p for p in paths if (references / f"{p.parent.name}.npz").exists()]
    if not paths:
        raise ValueError(f"no scene in {scenes} has an archive in {references}")
    return paths


def read_reference(
    scene: pathlib.Path, references: pathlib.Path, shrink: int = 1
) -> Reference:
    """The reference of a scene, or of the same scene in fewer pixels.

    Args:
        scene: the XML file.
        references: folder of archives.
        shrink: pixels that are averaged along each axis: by a box filter what a smaller
            film shows.

    Returns:
        the reference.
    """
    with np.load(references / f"{scene.parent.name}.npz") as data:
        both = data["reference"], data["reference_half_difference"]

    def smaller(image: np.ndarray) -> np.ndarray:
        height, width = (size // shrink for size in image.shape[:2])
        cut = image[: height * shrink, : width * shrink]
        return cut.reshape(height, shrink, width, shrink, -1).mean(axis=(1, 3))

    return Reference(*(jnp.asarray(smaller(i), jnp.float32) for i in both))


def frame_pair(
    scene: pathlib.Path, samples: int, reference: Reference, work: pathlib.Path
) -> tuple[Frame, Frame]:
    """Frames of independent and common random numbers, or what a run has left of them.

    Args:
        scene: the XML file.
        samples: samples a pixel of common numbers; there are twice as many independent,
            for the methods that have no use for common ones.
        reference: of the scene; says the size.
        work: folder for them.

    Returns:
        sixteen sub-buffers with the reference, and eight, of equally many samples;
        both normalised.
    """
    height, width, _ = reference.image.shape
    each = []
    kinds = ("independent", 2, 0), ("common", 1, COMMON_SEED)
    for kind, parts, seed in kinds:
        settings = Settings(
            spp=samples * parts,
            width=width,
            height=height,
            buffers=SUB_AVERAGES * parts,
            feature_spp=_FEATURE_SPP,
            numbers=kind,
            seed=seed,
        )
        partial = work / f"{scene.parent.name}-{width}-{samples}-{kind}.npz"
        each.append(rendering.render(f"{scene}", settings, partial=partial))
    every = each[0]._replace(reference=reference).normalised()
    return every, each[1].normalised(every.unit)


def merged(sub_averages: SubAverages, count: int) -> SubAverages:
    """Average sub-averages to fewer of them, as many in each."""
    return jnp.mean(sub_averages.reshape(count, -1, *sub_averages.shape[1:]), axis=1)


def named(
    paths: Sequence[pathlib.Path], samples: Sequence[int]
) -> dict[str, tuple[pathlib.Path, int]]:
    """All frames by "name samples": path and samples, those of few samples first."""
    return {f"{p.parent.name} {n}": (p, n) for n in samples for p in paths}
