"""Reports of experiments, in the RESULTS.md of their folder.

A section is a question with its answer, the command that measured it, when and with
what, its tables and plots. Programs write it, never a hand.
"""

import datetime
import importlib.metadata
import importlib.util
import os
import pathlib
import platform
import re
import subprocess
from collections.abc import Mapping
from typing import NamedTuple

from matplotlib.figure import Figure

NAME = "RESULTS.md"
_HEAD = "# Results\n\nWritten by the commands below; every section says when.\n"
_PACKAGES = "jax", "numpy", "pyoidn", "mitsuba"
_CPUS = pathlib.Path("/proc/cpuinfo")


class Report(NamedTuple):
    """What an experiment found.

    Attributes:
        answer: to its question, with figures, in one paragraph.
        body: tables in Markdown, with the sentences that they need.
        figures: plots by caption.
    """

    answer: str
    body: str
    figures: Mapping[str, Figure] = {}


class Section(NamedTuple):
    """A report in a RESULTS.md.

    Attributes:
        module: that wrote it.
        question: it answers.
        answer: in one paragraph.
        command: that wrote it.
        date: of that, YYYY-MM-DD.
        text: the whole section.
    """

    module: str
    question: str
    answer: str
    command: str
    date: str
    text: str


def write(
    folder: pathlib.Path, module: str, docstring: str, command: str, report: Report
) -> None:
    """Put a report into a folder's RESULTS.md, in place of an earlier one.

    Args:
        folder: of the experiment; made if it is missing.
        module: name of the experiment.
        docstring: of the module; its first paragraph is the question.
        command: that measured it.
        report: what it found.
    """
    folder.mkdir(parents=True, exist_ok=True)
    question = " ".join(docstring.partition("\n\n")[0].split())
    stem = module.rpartition(".")[2]
    body = [report.body]
    for caption, figure in report.figures.items():
        plot = "-".join([stem, *re.findall(r"\w+", caption.lower())][:4]) + ".png"
        (folder / "figures").mkdir(exist_ok=True)
        figure.savefig(folder / "figures" / plot, dpi=100, bbox_inches="tight")
        body.append(f"![{caption}](figures/{plot})")
    parts = [
        f"## {question}",
        f"<!-- {module} -->",
        report.answer,
        f"    {command}",
        circumstances(),
        *body,
    ]
    sections = {each.module: each.text for each in read(folder)}
    sections[module] = "\n\n".join(parts).rstrip() + "\n"
    text = "\n".join([_HEAD, *(sections[name] for name in sorted(sections))])
    (folder / NAME).write_text(text)


def circumstances() -> str:
    """Say when, of which code, with what packages, on which machine.

    Returns:
        one sentence that begins with the date.
    """
    names = [n for n in _PACKAGES if importlib.util.find_spec(n)]
    versions = [f"{name} {importlib.metadata.version(name)}" for name in names]
    python = f"Python {platform.python_version()}"
    cores = f"{os.cpu_count()} cores, {_processor()}"
    date = f"{datetime.date.today():%Y-%m-%d}"
    return f"{date}, commit {_commit()}; {', '.join([python, *versions])}; {cores}."


def _commit() -> str:
    """The commit, and whether programs have changed since."""
    git = lambda *words: subprocess.run(
        ["git", *words], capture_output=True, text=True, check=False
    ).stdout.strip()
    changed = " changed" if git("status", "--porcelain", "--", "*.py") else ""
    return (git("rev-parse", "--short", "HEAD") or "unknown") + changed


def _processor() -> str:
    """Its name where Linux tells, else its kind."""
    text = _CPUS.read_text() if _CPUS.exists() else ""
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found.group(1) if found else platform.machine()


def read(folder: pathlib.Path) -> list[Section]:
    """Read all sections of a folder's RESULTS.md.

    Args:
        folder: of experiments.

    Returns:
        the sections; none if there is no such file.
    """
    path = folder / NAME
    texts = re.split(r"^(?=## )", path.read_text() if path.exists() else "", flags=re.M)
    return [_section(text.rstrip() + "\n") for text in texts[1:]]


def _section(text: str) -> Section:
    """The parts of a section that `write` wrote."""
    question, module, answer, command, date = text.split("\n\n")[:5]
    return Section(
        module.removeprefix("<!-- ").removesuffix(" -->"),
        question.removeprefix("## "),
        answer,
        command.strip(),
        date.partition(",")[0],
        text,
    )
