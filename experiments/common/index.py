"""Write the index of all results into experiments/README.md.

    python -m experiments.common.index

A line a question: the command's module, its answer, and the date, from each folder's
RESULTS.md. A test fails where the index is not what this writes.
"""

import pathlib

from experiments.common import report
from experiments.common.tables import table

EXPERIMENTS = pathlib.Path(__file__).parents[1]
README = EXPERIMENTS / "README.md"
BEGIN = "<!-- what follows is written by experiments.common.index -->"


def index() -> str:
    """Tabulate all sections.

    Returns:
        Markdown: one table, a row a section.
    """
    rows = [
        (
            s.question,
            f"[{s.module.partition('.')[2]}]({path.parent.name}/{report.NAME})",
            s.answer,
            s.date,
        )
        for path in sorted(EXPERIMENTS.glob(f"*/{report.NAME}"))
        for s in report.read(path.parent)
    ]
    return table(("question", "module, its results", "answer", "date"), rows)


def indexed(text: str) -> str:
    """Replace the index in the text of the README.

    Args:
        text: with the line that the index follows.

    Returns:
        the text with the index of today.
    """
    return "\n\n".join([text.partition(BEGIN)[0] + BEGIN, index()]).rstrip() + "\n"


if __name__ == "__main__":
    README.write_text(indexed(README.read_text()))
