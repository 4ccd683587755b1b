"""Frames from a folder of NumPy archives or EXR files, as `Frame`, for experiments.

An EXR file is `SCENE-SAMPLES.exr`, by `experiments.data`, with its sub-buffers. An
archive holds nested half buffers of S samples, `a_color_S` and `b_color_S`, with
`a_variance_S` and `b_variance_S` of their means; denoised images `a_oidn_S`, `b_oidn_S`
and `full_oidn_S`; features `a_albedo` and so on; `reference`, and the difference of its
halves, `reference_half_difference`.
"""

import functools
import pathlib
from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments.common.results import Results
from jscomb import exr
from jscomb.frame import CHANNELS, Estimate, Frame, Reference, make_frame


def load(path: pathlib.Path, samples: int) -> Frame:
    """One frame at one sample count.

    Args:
        path: an archive, or an EXR file.
        samples: samples a pixel of the full frame; in an archive twice one of the S.

    Returns:
        the frame: two sub-buffers, features, `oidn` with halves, and the reference.

    Raises:
        ValueError: if the archive has no such sample count; names those it has.
    """
    if path.suffix == ".exr":
        return exr.read_frame(path)
    half = samples // 2
    with np.load(path) as data:
        if f"a_color_{half}" not in data:
            raise ValueError(f"{path} has {sample_counts(path)} samples, not {samples}")

        def pair(name: str) -> np.ndarray:
            return np.stack([data[f"a_{name}"], data[f"b_{name}"]])

        features = {name: pair(name) for name in CHANNELS if f"a_{name}" in data}
        for name, feature in features.items():
            features[name] = feature.reshape(*feature.shape[:3], CHANNELS[name])
        if "albedo" in features:
            features["albedo"] = features["albedo"].clip(0, 1)  # metals exceed 1
        return make_frame(
            pair(f"color_{half}"),
            variance=pair(f"variance_{half}"),
            samples=samples,
            estimates={
                "oidn": Estimate(
                    jnp.asarray(data[f"full_oidn_{half}"]),
                    jnp.asarray(pair(f"oidn_{half}")),
                )
            },
            reference=Reference(
                jnp.asarray(data["reference"]),
                jnp.asarray(data["reference_half_difference"]),
            ),
            **features,
        )


def sample_counts(path: pathlib.Path) -> list[int]:
    """The sample counts of the full frames in an archive, ascending."""
    with np.load(path) as data:
        names = [n for n in data.files if n.startswith("a_color_")]
    return sorted(2 * int(name.rpartition("_")[2]) for name in names)


def cases(
    folder: pathlib.Path, *, quick: bool = False
) -> list[tuple[pathlib.Path, int]]:
    """All frames of a folder.

    Args:
        folder: of archives, EXR files, or both.
        quick: only the first, at its least sample count.

    Returns:
        files and sample counts, to `load`.

    Raises:
        ValueError: if the folder holds no frame.
    """
    every = [
        (path, samples)
        for path in sorted(folder.glob("*.npz"))
        for samples in sample_counts(path)
    ]
    for path in sorted(folder.glob("*.exr")):
        samples = path.stem.rpartition("-")[2]
        every += [(path, int(samples))] if samples.isdecimal() else []
    if not every:
        raise ValueError(f"{folder}: no .npz archive and no EXR frame there")
    return every[:1] if quick else every


def measured(
    folder: pathlib.Path,
    measures: Mapping[str, Callable[[Frame], dict[str, float]]],
    *,
    results: pathlib.Path | None = None,
    quick: bool = False,
) -> dict[str, dict[str, float]]:
    """Measure all frames of a folder, normalised.

    Args:
        folder: of archives, EXR files, or both.
        measures: functions of a frame to numbers by name; what each is called.
        results: file of `Results`; None to keep none.
        quick: only the first frame.

    Returns:
        the numbers by "frame samples measure"; by "frame samples" where a measure is
        called "".

    Raises:
        ValueError: if the folder holds no frame.
    """
    kept, found = Results(results), {}
    for path, samples in tqdm(cases(folder, quick=quick), unit="frame"):
        frame = functools.cache(lambda p=path, s=samples: load(p, s).normalised())
        for kind, measure in measures.items():
            scene = path.stem.removesuffix(f"-{samples}")
            name = f"{scene} {samples} {kind}".strip()
            found[name] = kept.get(name, lambda m=measure, f=frame: m(f()))
    return found
