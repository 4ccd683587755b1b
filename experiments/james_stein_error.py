"""Where does James-Stein lower a denoiser's error, and where does it raise it?

    python -m experiments.james_stein_error FOLDER

Every archive in the folder (see `frames`), at every sample count: relative L2 of
normalised frames, less the reference's noise, of path tracing, of Open Image Denoise,
and of each combiner (`auto` combines only where the half buffers show that it helps);
then the geometric mean over the frames of the ratio to the better of the two inputs.
"""

import dataclasses
import pathlib

import jax
import numpy as np
import tyro

from experiments import frames
from experiments.rendering import UNTRAINED
from jscomb import james_stein, methods
from jscomb.frame import Frame
from jscomb.metrics import rel_l2
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        quick: only the first archive, at its least sample count.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    quick: bool = False


INPUTS = ("path tracing", "oidn")


@jax.jit
def _dual(frame: Frame) -> Image:
    """The dual variant: each half's x with the other half's y."""
    a, b = frame.halves()
    variance = james_stein.smooth_variance(frame.variance)
    ya, yb = a.estimates["oidn"].image, b.estimates["oidn"].image
    return james_stein.combine_dual(a.color, b.color, ya, yb, variance)


def images_of(frame: Frame) -> dict[str, Image]:
    """Inputs and combinations by name."""
    key, y = jax.random.key(0), frame.estimates["oidn"].image
    combined = {
        name: methods.combine(key, frame, method=name, biased="oidn").image
        for name in UNTRAINED
    }
    found = methods.choose(key, frame, biased="oidn", methods=["denoised", "whitened"])
    chosen = combined["whitened"] if found.method == "whitened" else y
    inputs = {"path tracing": frame.color, "oidn": y}
    return inputs | combined | {"auto": chosen, "dual": _dual(frame)}


def run(config: Config) -> dict[tuple[str, int], dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        relative L2 by method, by name of the frame and sample count.

    Raises:
        ValueError: if the folder holds no archive.
    """
    found = {}
    for path, samples in frames.cases(config.folder, quick=config.quick):
        frame = frames.load(path, samples).normalised()
        assert frame.reference is not None
        r, noise = frame.reference
        images = images_of(frame)
        found[path.stem, samples] = {
            name: float(rel_l2(images[name], r, half_difference=noise))
            for name in (*INPUTS, *UNTRAINED, "auto", "dual")
        }
    return found


def main() -> None:
    """Print the table."""
    found = run(tyro.cli(Config, description=__doc__))
    names = list(next(iter(found.values())))
    print(f"{'frame':<12}{'spp':>6}" + "".join(f"{name:>17}" for name in names))
    for (frame, samples), errors in found.items():
        row = "".join(f"{errors[name]:>17.5f}" for name in names)
        print(f"{frame:<12}{samples:>6}{row}")
    print("\ngeometric mean of the ratio to the better input (worst)")
    for samples in sorted({samples for _, samples in found}):
        row = ""
        for name in names:
            ratios = [
                errors[name] / min(errors[name] for name in INPUTS)
                for (_, count), errors in found.items()
                if count == samples
            ]
            mean = np.exp(np.mean(np.log(ratios)))
            row += f"{f'{mean:.2f} ({max(ratios):.2f})':>17}"
        print(f"{'':<12}{samples:>6}{row}")


if __name__ == "__main__":
    main()
