"""Train one of the networks, or a method with something left out, on a dataset.

As `jscomb train`, with more methods: those of `ablations`. FOLDER is of
`experiments.data.dataset`, whose test split takes no part. The same command resumes an
interrupted run.
"""

import dataclasses
import pathlib
from typing import Any

import tyro

from experiments.common.command import tool
from experiments.training.ablations import ABLATIONS
from jscomb import cli
from jscomb.learning.recipes import RECIPES

ALL = RECIPES | ABLATIONS
QUICK = {"size": "light", "steps": 60, "batch": 4, "crop": 48, "piece": 64}


@dataclasses.dataclass(frozen=True)
class Config:
    """A run.

    Attributes:
        run: what is trained: a method of `jscomb train`, or one of `ablations`.
        data: folder of frames.
        out: folder of the run.
        quick: a short schedule of small crops of small frames.
    """

    run: tyro.conf.OmitArgPrefixes[cli.Run]
    data: tyro.conf.Positional[pathlib.Path]
    out: pathlib.Path
    quick: bool = False

    def __post_init__(self) -> None:
        """Raise for an unknown method."""
        if self.run.method not in ALL:
            known = ", ".join(ALL)
            raise ValueError(f"no method {self.run.method!r}; there are {known}")


def run(config: Config) -> dict[str, Any]:
    """Train, or resume training.

    Args:
        config: the run.

    Returns:
        its card.

    Raises:
        ValueError: if the folder holds another run, or there are no frames.
    """
    each = config.run
    if config.quick:
        each = dataclasses.replace(each, **QUICK, validate=10)
    return cli.train_files(each, ALL[each.method], config.data, config.out)


if __name__ == "__main__":
    tool(Config, run)
