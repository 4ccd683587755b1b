"""Does the method that half buffers choose have the least error?

    python -m experiments.choice FOLDER --results FILE.json

Every archive in the folder (see `frames`), at every sample count: what
`jscomb.methods.choose` takes, and the error (relative L2, less the reference's noise)
of every method. The regret is the chosen method's error divided by the least of all.
"""

import dataclasses
import pathlib

import jax
import numpy as np
import tyro

from experiments import frames
from jscomb.frame import Frame
from jscomb.methods import CANDIDATES, choose, combine
from jscomb.metrics import rel_l2


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        results: file that results are kept in as they come.
        quick: only the first archive, at its least sample count, cheap methods only.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    quick: bool = False


def measure(frame: Frame, *, methods: tuple[str, ...]) -> dict[str, float]:
    """Errors of all methods, which of them was chosen, and what it cost to choose.

    Args:
        frame: normalised, with halves, `oidn` and a reference.
        methods: to choose from.

    Returns:
        relative L2 by method; "chosen", its place in `methods`; and for those that
        were judged the seconds that one half took, as "METHOD s".
    """
    assert frame.reference is not None
    r, noise = frame.reference
    key = jax.random.key(0)
    found = choose(key, frame, biased="oidn", methods=methods)
    errors = {}
    for method in methods:
        made = combine(key, frame, method=method, biased="oidn")
        errors[method] = float(rel_l2(made.image, r, half_difference=noise))
    errors |= {f"{t.method} s": t.seconds for t in found.trials if t.change}
    return errors | {"chosen": float(methods.index(found.method))}


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

    return frames.measured(
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
    errors = np.array([[row[m] for m in methods] for row in rows.values()])
    chosen = np.array([int(row["chosen"]) for row in rows.values()])
    least = errors.min(axis=1)
    table = dict(zip(methods, (errors / least[:, None]).T, strict=True))
    return table | {
        "chosen": np.take_along_axis(errors, chosen[:, None], 1)[:, 0] / least
    }


def main() -> None:
    """Print the tables."""
    rows = run(tyro.cli(Config, description=__doc__))
    table = ratios(rows)
    methods = list(table)[:-1]
    for method, each in table.items():
        mean = np.exp(np.log(each).mean())
        print(f"| {method} | {mean:.3f} | {each.max():.3f} |")
    for (name, row), regret in zip(rows.items(), table["chosen"], strict=True):
        errors = " | ".join(f"{row[m]:.5f}" for m in methods)
        print(f"| {name} | {errors} | {methods[int(row['chosen'])]} | {regret:.3f} |")


if __name__ == "__main__":
    main()
