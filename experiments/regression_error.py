"""Where does cross-regression lower the error, and do the half buffers know?

    python -m experiments.regression_error FOLDER --results FILE.json

Every archive in the folder (see `frames`), at every sample count and with two biased
images y: Open Image Denoise, and non-local means, a weak one. Relative L2, less the
reference's noise, of normalised frames, of y and y*; what `worth_regressing` says of
the change, and the reference; and NFOR. Results are kept in the file as they come, and
what is in it is not measured again.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import numpy as np
import tyro

from experiments import frames
from jscomb import james_stein
from jscomb.denoisers import nfor, nonlocal_means
from jscomb.features import select, stack
from jscomb.frame import Estimate, Frame
from jscomb.metrics import rel_l2
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that results are kept in; None to keep none.
        stride: pixels between the centres of windows.
        window: width of the windows in pixels.
        quick: only the first archive, at its least sample count.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    stride: int = 1
    window: int = 51
    quick: bool = False


Row = dict[str, float]
BASES = ("oidn", "non-local means")

cross = jax.jit(james_stein.cross_regression, static_argnames=("window", "stride"))
worth = jax.jit(james_stein.worth_regressing, static_argnames=("window", "stride"))


def inputs_of(frame: Frame, base: Estimate) -> tuple[Image, ...]:
    """What `cross_regression` takes: both halves' images, and features that tell.

    Args:
        frame: normalised, with halves.
        base: a biased image of it with halves.

    Returns:
        x_a, x_b, y_a, y_b, f_a and f_b.

    Raises:
        ValueError: if the frame or the image has no halves.
    """
    if base.halves is None:
        raise ValueError("the biased image has no halves")
    a, b = frame.halves()
    needed = select([stack(a), stack(b)])
    others = (needed.of(stack(half)) for half in (a, b))
    return (a.color, b.color, *base.halves, *others)


def base_of(frame: Frame, name: str) -> Estimate:
    """A biased image of the frame and of its halves, by name."""
    if name != "non-local means":
        return frame.estimates[name]
    return nonlocal_means.denoise_frame(frame)


def measure(frame: Frame, name: str, config: Config) -> Row:
    """Errors of one biased image, and of what regression makes of it."""
    assert frame.reference is not None
    r, noise = frame.reference
    error = lambda image, epsilon=0.01: float(
        rel_l2(image, r, half_difference=noise, epsilon=epsilon)
    )
    base = base_of(frame, name)
    inputs = inputs_of(frame, base)
    y = base.image
    options = {"window": config.window, "stride": config.stride}
    star = sum(cross(*inputs, **options)) / 2
    noise_of = james_stein.guide_noise(*inputs[2:4], robust=False)
    paper = sum(cross(*inputs, kappa=noise_of, **options)) / 2
    variances = (half.variance for half in frame.halves())
    change = worth(jax.random.key(0), *inputs, *variances, window=config.window)
    return {
        "path tracing": error(frame.color),
        "y": error(y),
        "y*": error(star),
        "y*, the paper's kappa": error(paper),
        # In the weighting of the estimate, where black pixels do not decide.
        "change": error(star, 1.0) - error(y, 1.0),
        "estimate": float(change.mean),
        "standard error": float(change.standard_error),
        "features": inputs[4].shape[-1],
    }


def run(config: Config) -> dict[str, Row]:
    """Measure every frame with every base.

    Args:
        config: what to measure.

    Returns:
        results by "frame samples base"; the base "NFOR" has its error alone.

    Raises:
        ValueError: if the folder holds no archive.
    """
    measures: dict[str, Callable[[Frame], Row]] = {
        base: functools.partial(measure, name=base, config=config) for base in BASES
    }
    return frames.measured(
        config.folder,
        measures | {"NFOR": measure_nfor},
        results=config.results,
        quick=config.quick,
    )


def measure_nfor(frame: Frame) -> Row:
    """Relative L2 of NFOR."""
    assert frame.reference is not None
    r, noise = frame.reference
    image = nfor.denoise_frame(frame).image
    return {"y": float(rel_l2(image, r, half_difference=noise))}


def main() -> None:
    """Print the table."""
    found = run(tyro.cli(Config, description=__doc__))
    columns = ("path tracing", "y", "y*", "y*, the paper's kappa")
    print(f"{'':<36}" + "".join(f"{name:>23}" for name in columns), end="")
    print("  change: estimate, reference")
    for name, row in found.items():
        if name.endswith("NFOR"):
            print(f"{name:<36}{'':>23}{row['y']:>23.5f}")
            continue
        print(f"{name:<36}" + "".join(f"{row[c]:>23.5f}" for c in columns), end="")
        chosen = row["estimate"] + row["standard error"] < 0
        print(f"  {row['estimate']:+.5f}+-{row['standard error']:.5f}", end="")
        print(f" {row['change']:+.5f} {'regress' if chosen else 'keep'}")
    for base in BASES:
        rows = [row for name, row in found.items() if name.endswith(base)]
        ratios = [np.log(row["y*"] / row["y"]) for row in rows]
        print(f"{base}: y* / y {np.exp(np.mean(ratios)):.3f} (geometric mean)", end="")
        chosen = [row["estimate"] + row["standard error"] < 0 for row in rows]
        for epsilon, helped in {
            "1": [row["change"] < 0 for row in rows],
            "0.01": [row["y*"] < row["y"] for row in rows],
        }.items():
            right = sum(a == b for a, b in zip(helped, chosen, strict=True))
            harm = sum(b and not a for a, b in zip(helped, chosen, strict=True))
            print(f"; by epsilon {epsilon} right {right} of {len(rows)}", end="")
            print(f", to its harm {harm}", end="")
        print()


if __name__ == "__main__":
    main()
