"""Accounts of papers: each equation, figure and table, where it is, what was measured.

A paper's folder has a module `account` with a tuple of claims. What a claim names in
the code is imported, and a result that it names is looked up: neither can be missing.
"""

import importlib
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from experiments.common import report
from experiments.common.report import Report
from experiments.common.tables import table

EXPERIMENTS = pathlib.Path(__file__).parents[1]


class Claim(NamedTuple):
    """An equation, figure, table or statement of a paper.

    Attributes:
        item: as the paper numbers it: "eq. 9", "fig. 14", "table 2", "section 4.1".
        says: what it defines, or reports, with its figures.
        where: what has it here: names such as "james_stein.risk_bound" in `jscomb`, or
            modules of `experiments`.
        measured: modules of experiments whose sections of a RESULTS.md are about it.
        note: how ours differs from it, or why it is not here or not measured.
    """

    item: str
    says: str
    where: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    note: str = ""


def resolve(name: str) -> Any:
    """Return what a name stands for.

    Args:
        name: of a module of `experiments`, or of something in `jscomb`.

    Returns:
        the module, function or class.

    Raises:
        ImportError: if there is nothing of this name.
    """
    if name.startswith("experiments."):
        return importlib.import_module(name)
    parts = name.split(".")
    found, rest = importlib.import_module("jscomb"), parts
    while rest:
        path = ".".join(["jscomb", *parts[: len(parts) - len(rest) + 1]])
        try:
            found = importlib.import_module(path)
        except ModuleNotFoundError:
            break
        rest = rest[1:]
    for part in rest:
        if not hasattr(found, part):
            raise ImportError(f"no {name} in jscomb")
        found = getattr(found, part)
    return found


def sections() -> dict[str, report.Section]:
    """Return all sections of all results, by module.

    Returns:
        the sections, "experiments." before each name.
    """
    folders = sorted(path.parent for path in EXPERIMENTS.glob(f"*/{report.NAME}"))
    return {each.module: each for folder in folders for each in report.read(folder)}


def check(claims: Sequence[Claim]) -> None:
    """Raise unless an account is complete in itself.

    Args:
        claims: of a paper.

    Raises:
        ImportError: if a name is of nothing.
        ValueError: if a result is not there, or nothing is said of what is missing.
    """
    known = sections()
    for claim in claims:
        for name in (*claim.where, *claim.measured):
            resolve(name)
        if missing := [name for name in claim.measured if name not in known]:
            raise ValueError(f"{claim.item}: no result of {missing[0]}")
        if not (claim.where or claim.measured or claim.note):
            raise ValueError(f"{claim.item}: neither here nor a reason why not")


def account(claims: Sequence[Claim]) -> Report:
    """Say what of a paper is here.

    Args:
        claims: of the paper.

    Returns:
        how many are here and measured, and a row for each.

    Raises:
        ImportError: as `check`.
        ValueError: as `check`.
    """
    check(claims)
    here = sum(bool(claim.where) for claim in claims)
    measured = sum(bool(claim.measured) for claim in claims)
    answer = (
        f"Of {len(claims)} equations, figures, tables and statements {here} are in the "
        f"code, {measured} were measured."
    )
    known = sections()
    rows = [
        [
            claim.item,
            claim.says,
            ", ".join(f"`{name}`" for name in claim.where),
            ", ".join(_link(known[name]) for name in claim.measured),
            claim.note,
        ]
        for claim in claims
    ]
    header = ["in the paper", "what", "here", "measured", "how it differs, or why not"]
    return Report(answer, table(header, rows))


def _link(section: report.Section) -> str:
    """To the RESULTS.md of a section."""
    folder, _, name = section.module.removeprefix("experiments.").rpartition(".")
    return f"[{name}](../{folder}/{report.NAME})"
