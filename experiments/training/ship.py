"""Put a trained network into the package, with its card.

The card holds what `jscomb train` wrote (data, schedule, losses, validation), and the
errors that `training.learned` measures on the test split of FOLDER, which took no part.
"""

import dataclasses
import json
import pathlib
import shutil

import tyro

from experiments.common.command import tool
from experiments.training import learned
from jscomb.learning.recipes import WEIGHTS, read_card


@dataclasses.dataclass(frozen=True)
class Config:
    """What to ship.

    Attributes:
        method: njs, dsc, dsc-photons or pd.
        network: folder of a run, in a folder of runs.
        folder: of `experiments.data.dataset`.
        results: file that stores results as they come.
        out: folder of the package's networks.
    """

    method: tyro.conf.Positional[str]
    network: tyro.conf.Positional[pathlib.Path]
    folder: tyro.conf.Positional[pathlib.Path]
    results: pathlib.Path | None = None
    out: pathlib.Path = WEIGHTS


def run(config: Config) -> dict:
    """Measure, copy, and write the card.

    Args:
        config: what to ship.

    Returns:
        the card.

    Raises:
        ValueError: if the run is of another method.
    """
    file, name = config.network / "network.safetensors", config.network.name
    card = read_card(file)
    if card["method"] != config.method:
        raise ValueError(f"{config.network} is a run of {card['method']}")
    runs, results = config.network.parent, config.results
    found = learned.run(learned.Config(config.folder, runs=runs, results=results))
    card["test"] = {
        "what": card["validation"]["what"],
        "frames": len(found.rows),
        **{k: learned.summary(found, name, k) for k in learned.kinds(found, name)},
        "promises": learned.verdict(found, name),
    }
    config.out.mkdir(exist_ok=True)
    target = config.out / f"{config.method}.safetensors"
    shutil.copyfile(file, target)
    target.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")
    return card


if __name__ == "__main__":
    tool(Config, run)
