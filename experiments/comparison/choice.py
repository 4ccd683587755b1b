"""Does the method that half buffers choose have the least error?

Every archive in the folder (`archives`), at every sample count: what
`jscomb.methods.choose` takes, and the error (relative L2, less the reference's noise)
of every method. The regret is the chosen method's error divided by the least of all.
"""

import dataclasses
import pathlib

import jax
import numpy as np
import tyro

from experiments.common import archives, errors
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb.frame import Frame
from jscomb.methods import CANDIDATES, choose, combine


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that results are kept in as they come.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None


def measure(frame: Frame, *, methods: tuple[str, ...]) -> dict[str, float]:
    """Errors of all methods, which of them was chosen, and what it cost to choose.

    Args:
        frame: normalised, with halves, `oidn` and a reference.
        methods: to choose from.

    Returns:
        relative L2 by method; "chosen", its place in `methods`; and for those that
        were judged the seconds that one half took, as "METHOD s".
    """
    key = jax.random.key(0)
    found = choose(key, frame, biased="oidn", methods=methods)
    row = {"path tracing": errors.relative_l2(frame.color, frame)}
    for method in methods:
        made = combine(key, frame, method=method, biased="oidn")
        row[method] = errors.relative_l2(made.image, frame)
    row |= {f"{t.method} s": t.seconds for t in found.trials if t.change}
    return row | {"chosen": float(methods.index(found.method))}


def run(config: Config) -> dict[str, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to measure.

    Returns:
        numbers of `measure` by "frame samples".

    Raises:
        ValueError: if the folder holds no archive.
    """
    methods = CANDIDATES[: 2 if config.quick else None]

    def all_of(frame: Frame) -> dict[str, float]:
        return measure(frame, methods=methods)

    return archives.measured(
        config.folder, {"": all_of}, results=config.results, quick=config.quick
    )


def ratios(rows: dict[str, dict[str, float]]) -> dict[str, np.ndarray]:
    """Of each method's errors to the least, and of those of the chosen.

    Args:
        rows: by `run`.

    Returns:
        ratios frame by frame, by method; "chosen" last.
    """
    methods = [m for m in CANDIDATES if m in next(iter(rows.values()))]
    every = np.array([[row[m] for m in methods] for row in rows.values()])
    chosen = np.array([int(row["chosen"]) for row in rows.values()])
    least = every.min(axis=1)
    table = dict(zip(methods, (every / least[:, None]).T, strict=True))
    return table | {
        "chosen": np.take_along_axis(every, chosen[:, None], 1)[:, 0] / least
    }


def report(rows: dict[str, dict[str, float]]) -> Report:
    """Say how good the choices are.

    Args:
        rows: by `run`.

    Returns:
        the regret of each method and of the choice, and every frame.
    """
    regrets = ratios(rows)
    methods = list(regrets)[:-1]
    means = [
        [name, errors.geometric_mean(each), float(each.max())]
        for name, each in regrets.items()
    ]
    chosen = [methods[int(row["chosen"])] for row in rows.values()]
    frames = [
        [name, *(row[m] for m in methods), choice, float(regret)]
        for (name, row), choice, regret in zip(
            rows.items(), chosen, regrets["chosen"], strict=True
        )
    ]
    share = [
        row[choice] / row["denoised"]
        for row, choice in zip(rows.values(), chosen, strict=True)
    ]
    of_choice, of_denoiser = regrets["chosen"], regrets["denoised"]
    best = min(methods, key=lambda name: errors.geometric_mean(regrets[name]))
    answer = (
        f"On average of {len(rows)} frames the chosen method has "
        f"{errors.geometric_mean(of_choice):.2f} times the least error, "
        f"{of_choice.max():.2f} at worst; the denoised image unchanged "
        f"{errors.geometric_mean(of_denoiser):.2f} ({of_denoiser.max():.2f}), the best "
        f"single method ({best}) {errors.geometric_mean(regrets[best]):.2f} "
        f"({regrets[best].max():.2f}). The choice has "
        f"{errors.geometric_mean(share):.2f} of the denoiser's error, at worst "
        f"{max(share):.2f}. These frames set its constants."
    )
    body = [
        table(["method", "error / least", "worst"], means),
        table(["frame", *methods, "chosen", "error / least"], frames),
    ]
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
