"""Which estimates should an ensemble be made of?

Estimates join one by one: each time the one that lowers the error most for what it
costs, starting with the noisy image and `oidn`. Errors are relative L2 over the better
of path tracing and Open Image Denoise; costs are in denoisings, measured on a frame
mirrored to 512x512, with the halves, and with `oidn` for what is made of it.

A choice says nothing of the scenes that it was made on. So it is made once for every
scene without that scene, whose frames then judge it: those are the numbers of "left
out". The list of candidates and the least gain were set with all scenes in sight.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments.benchmarks.tiers import bare, denoising, seconds
from experiments.common import errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.data import development
from jscomb import ensemble, exr
from jscomb.frame import Estimate, Frame
from jscomb.methods import METHODS
from jscomb.methods._inputs import inputs, with_input, with_inputs

START = "path-tracing", "oidn"
CANDIDATES = (
    *("oidn-color", "oidn-albedo", "oidn-demodulated"),
    *("oidn-clean", "bilateral", "rdfc", "nfor"),
    *("nonlocal-means", "multi-scale", "whitened", "double-shrinkage"),
    *("pd", "njs", "dsc"),
)
LEAST = 0.01  # of the error, that a member must lower it by
_FREE = 0.05  # denoisings; what costs less is as good as free
_SIZE = 512  # pixels along the side of the frame whose costs are measured

Members = tuple[str, ...]
Cases = Sequence[str]
Error = Callable[[Members, str], float]


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of development frames.
        estimates: folder that estimates are kept in, 20 MB a frame.
        results: file that errors are kept in; None to keep none.
        budgets: costs in denoisings, of the choices to report.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    estimates: pathlib.Path
    results: pathlib.Path | None = None
    budgets: tuple[float, ...] = (10.0, 60.0)


class Path(NamedTuple):
    """Ensembles, each with one member more than the one before.

    Attributes:
        members: of the largest, in the order in which they join.
        costs: of each ensemble, in denoisings.
    """

    members: Members
    costs: tuple[float, ...]

    def within(self, budget: float) -> Members:
        """The largest ensemble that costs no more."""
        count = sum(cost <= budget for cost in self.costs)
        return self.members[: len(START) + max(count, 1) - 1]


def cost_of(members: Members, costs: dict[str, float]) -> float:
    """Of an ensemble: what its members share is paid once."""
    made_of_oidn = any(METHODS[m].takes == "one estimate" for m in members)
    names = {*members, "oidn"} if made_of_oidn else {*members}
    return sum(costs[name] for name in names)


def joined(
    cases: Cases, candidates: Members, costs: dict[str, float], error: Error
) -> Path:
    """Let members join as long as one lowers the mean error of the cases."""
    of = lambda some: float(np.mean([np.log(error(some, case)) for case in cases]))
    members, left = START, [c for c in candidates if c not in START]
    now, spent = of(members), [cost_of(members, costs)]
    while left:
        gain = {c: now - of((*members, c)) for c in left}
        price = {c: cost_of((*members, c), costs) - spent[-1] for c in left}
        left = [c for c in left if gain[c] > LEAST]
        if not left:
            break
        chosen = max(left, key=lambda c: gain[c] / max(price[c], _FREE))
        members, now = (*members, chosen), now - gain[chosen]
        left.remove(chosen)
        spent.append(cost_of(members, costs))
    return Path(members, tuple(spent))


def estimates_of(frame: Frame, names: Sequence[str], path: pathlib.Path) -> Frame:
    """The frame with estimates, from a file or made and kept there."""
    if not path.exists():
        full = with_inputs(jax.random.key(0), frame, names)
        made = {name: full.estimates[name] for name in names}
        arrays = {
            f"{n} {k}": i for n, e in made.items() for k, i in e._asdict().items()
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez(part, **{n: np.asarray(i) for n, i in arrays.items()})
        part.rename(path)
    with np.load(path) as data:
        get = lambda name, kind: jnp.asarray(data[f"{name} {kind}"])
        for name in names:
            held = Estimate(get(name, "image"), get(name, "halves"))
            frame = frame.with_estimate(name, held)
    return frame


def measured_costs(
    path: pathlib.Path, names: Sequence[str], size: int
) -> dict[str, float]:
    """Seconds of estimates with their halves, in denoisings."""
    frame, key = bare(path, size), jax.random.key(0)
    one = denoising(frame)
    full = with_input(key, frame, "oidn")
    found = {"path-tracing": 0.0}
    for name in names:
        if name in found:
            continue
        start = frame if name == "oidn" else full
        make = lambda s=start, n=name: with_input(key, s, n).estimates[n].image
        found[name] = min(seconds(make) for _ in range(2)) / one
    return found


def run(config: Config) -> dict:
    """Let members join, on all scenes and without each.

    Args:
        config: what to measure.

    Returns:
        costs by name, the path of all scenes with its errors, and for each budget the
        errors left out.
    """
    every = list(development.frames(config.folder))[: 1 if config.quick else None]
    candidates = ("multi-scale",) if config.quick else CANDIDATES
    kept = Results(config.results)
    size = 256 if config.quick else _SIZE
    names = [*START, *candidates]
    costs = kept.get("costs", lambda: measured_costs(every[0][2], names, size))
    frames: dict[str, tuple[Frame, float]] = {}
    for scene, samples, path in tqdm(every, unit="frame", desc="estimates"):
        frame = exr.read_frame(path).normalised()
        names, _ = inputs(frame, biased=[*START, *candidates])
        frame = estimates_of(frame, names, config.estimates / f"{path.stem}.npz")
        inputs_of = [frame.color, frame.estimates["oidn"].image]
        better = min(errors.relative_l2(image, frame) for image in inputs_of)
        frames[f"{scene} {samples}"] = frame, better

    def measure(members: Members, case: str) -> float:
        frame, better = frames[case]
        estimates = {name: frame.estimates[name] for name in members}
        weights = ensemble.weigh_frame(frame, estimates)
        image = ensemble.average(ensemble.stack_estimates(estimates).biased, weights)
        return errors.relative_l2(image, frame) / better

    def error(members: Members, case: str) -> float:
        key = f"{case}: {' '.join(sorted(members))}"
        return kept.get(key, lambda: measure(members, case))

    choose = functools.partial(joined, candidates=candidates, costs=costs, error=error)
    path = choose([*frames])
    scenes = sorted({case.split()[0] for case in frames})
    left_out: dict[str, Path] = {}
    for scene in tqdm(scenes, unit="scene"):
        others = [case for case in frames if case.split()[0] != scene]
        left_out[scene] = choose(others or [*frames])
    return {
        "costs": costs,
        "path": [
            (path.members[len(START) - 1 + k], cost, [error(some, c) for c in frames])
            for k, cost in enumerate(path.costs)
            for some in [path.members[: len(START) + k]]
        ],
        "left out": {
            budget: {
                case: error(left_out[case.split()[0]].within(budget), case)
                for case in frames
            }
            for budget in config.budgets
        },
        "chosen": {
            budget: [way.within(budget) for way in left_out.values()]
            for budget in config.budgets
        },
    }


def report(found: dict) -> Report:
    """Say which estimates pay.

    Args:
        found: by `run`.

    Returns:
        the path of all scenes, and what choices made without a scene do on it.
    """
    left_out = found["left out"]
    rows = {
        case: {f"within {budget:g}": of[case] for budget, of in left_out.items()}
        for case in next(iter(left_out.values()))
    }
    said = [
        f"{errors.geometric_mean(of.values()):.3f} (worst {max(of.values()):.2f}) "
        f"within {budget:g}"
        for budget, of in left_out.items()
    ]
    answer = (
        "Error over the better of path tracing and OIDN, of members chosen without the "
        f"scene, by cost in denoisings: {', '.join(said)}."
    )
    path = table(
        ["joins", "its cost", "cost of all", "error", "worst"],
        [
            [name, found["costs"][name], cost, errors.geometric_mean(e), max(e)]
            for name, cost, e in found["path"]
        ],
    )
    counts = [
        [
            name,
            *(sum(name in way for way in found["chosen"][b]) for b in found["chosen"]),
        ]
        for name in found["costs"]
    ]
    one = lambda row: 1.0
    budgets = [f"within {budget:g}" for budget in found["chosen"]]
    body = [
        "All scenes, weights not in the cost:",
        path,
        "Left out:",
        errors.means(rows, budgets, one, title="budget"),
        f"In how many of {len(next(iter(found['chosen'].values())))} choices:",
        table(["estimate", *budgets], counts),
    ]
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
