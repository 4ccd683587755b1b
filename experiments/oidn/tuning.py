"""Does it pay to tune the denoiser on the frame itself?

Frames of `experiments.data.development`. Relative L2, less the reference's noise,
of `oidn.tune_frame` over that of `oidn`, for the frame and for its halves, each tuned
on its own two sub-buffers; and of the tiers' ensembles with the tuned estimate over
those without. The rate and the number of steps were set on five of these scenes.
"""

import dataclasses
import pathlib
import time

import numpy as np
import tyro
from tqdm import tqdm

from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.comparison.members import estimates_of
from experiments.data import development
from jscomb import ensemble, exr
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.methods import TIERS
from jscomb.methods._inputs import inputs

TUNED = "tuned"


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of development frames.
        estimates: folder that the tiers' estimates are kept in, 20 MB a frame.
        results: file that the frames' results are kept in; None to keep none.
        samples: sample counts to measure; all by default.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    estimates: pathlib.Path
    results: pathlib.Path | None = None
    samples: tuple[int, ...] = ()


def measure(frame: Frame, *, quick: bool) -> dict[str, float]:
    """Ratios of one normalised frame that has the estimates of the tiers."""
    start = time.perf_counter()
    tuned = oidn.tune_frame(frame, steps=2) if quick else oidn.tune_frame(frame)
    row = {"s": time.perf_counter() - start}
    full = frame.with_estimate(TUNED, tuned)
    error = lambda image: errors.relative_l2(image, frame)
    plain = frame.estimates["oidn"]
    of_halves = lambda e: float(np.mean([error(half) for half in e.halves]))
    row |= {
        "frame": error(tuned.image) / error(plain.image),
        "halves": of_halves(tuned) / of_halves(plain),
    }

    def combined(names: list[str]) -> float:
        estimates = {name: full.estimates[name] for name in names}
        weights = ensemble.weigh_frame(full, estimates)
        bases = ensemble.stack_estimates(estimates)
        return error(ensemble.average(bases.biased, weights))

    for tier in ("balanced", "best"):
        names = [name for name in TIERS[tier].bases if name in frame.estimates]
        row[tier] = combined([*names, TUNED]) / combined(names)
    return row


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure all frames.

    Args:
        config: what to measure.

    Returns:
        ratios by "scene samples".
    """
    kept, found = Results(config.results), {}
    every = list(development.frames(config.folder))
    if config.samples:
        every = [each for each in every if each[1] in config.samples]
    tier = TIERS["balanced" if config.quick else "best"]
    for scene, samples, path in tqdm(every[: 1 if config.quick else None]):

        def one(path: pathlib.Path = path) -> dict[str, float]:
            frame = exr.read_frame(path).normalised()
            names, _ = inputs(frame, biased=[*tier.bases])
            held = estimates_of(frame, names, config.estimates / f"{path.stem}.npz")
            return measure(held, quick=config.quick)

        found[f"{scene} {samples}"] = kept.get(f"{scene} {samples}", one)
    return found


def report(found: dict[str, dict[str, float]]) -> Report:
    """Say what tuning brings.

    Args:
        found: by `run`.

    Returns:
        its ratios by samples.
    """
    shown = "frame", "halves", "balanced", "best"
    mean = lambda name: errors.geometric_mean(row[name] for row in found.values())
    worst = lambda name: max(row[name] for row in found.values())
    seconds = float(np.median([row["s"] for row in found.values()]))
    answer = (
        f"The tuned denoiser has {mean('frame'):.2f} times the error of `oidn` (worst "
        f"{worst('frame'):.2f}); as one more estimate it changes the error of "
        f"`balanced` by {mean('balanced'):.3f} (worst {worst('balanced'):.2f}), of "
        f"`best` by {mean('best'):.3f} (worst {worst('best'):.2f}), in {seconds:.0f} s "
        "a frame with both halves. So it is in no tier."
    )
    body = errors.means(found, shown, lambda row: 1.0, title="with / without")
    return Report(answer, body)


if __name__ == "__main__":
    main(Config, run, report)
