"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def table(header: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """Write a table.

    Args:
        header: of the columns.
        rows: their cells; floats get three significant digits, None stays empty.

    Returns:
        lines of Markdown.
    """
    lines = [[str(cell) for cell in header], ["---"] * len(header)]
    lines += [[_cell(value) for value in row] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    """A cell's text."""
    if isinstance(value, float):
        return f"{value:#.3g}" if 1e-3 <= abs(value) < 1e3 else f"{value:.3g}"
    return "" if value is None else str(value)
