"""Put a trained network into the package, with its card.

The card holds the network's training data, schedule and losses, and its errors, as
`training.learned` measures them, on the frames of FOLDER, unseen in training.
"""

import dataclasses
import json
import pathlib
import shutil

import tyro

from experiments.common.command import tool
from experiments.training import learned
from jscomb.learning.recipes import WEIGHTS


@dataclasses.dataclass(frozen=True)
class Config:
    """What to ship.

    Attributes:
        method: njs, dsc or pd.
        network: folder of a finished run, in a folder of runs.
        folder: of NumPy archives to measure on.
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
        ValueError: if the run is not finished or of another method.
    """
    card = json.loads((config.network / "network.json").read_text())
    name = config.network.name
    if card["method"] != config.method:
        raise ValueError(f"{config.network} is a run of {card['method']}")
    measured = learned.Config(
        config.folder, runs=config.network.parent, results=config.results
    )
    rows, _ = learned.run(measured)
    if name not in next(iter(rows.values())):
        raise ValueError(f"{config.network} is not finished")
    card["error"] = {
        "what": "relative L2 divided by the better of path tracing and oidn: geometric"
        " mean over frames of scenes that were not trained on, by samples, and worst",
        "oidn": learned.summary(rows, "oidn"),
        config.method: learned.summary(rows, name),
    }
    config.out.mkdir(exist_ok=True)
    target = config.out / f"{config.method}.safetensors"
    shutil.copyfile(config.network / "network.safetensors", target)
    target.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")
    return card


if __name__ == "__main__":
    tool(Config, run)
