"""Results that are kept as they come, so that a second run goes on from there."""

import json
import pathlib
from collections.abc import Callable
from typing import Any


class Results:
    """Values by key, in a file of JSON lines."""

    def __init__(self, path: pathlib.Path | None) -> None:
        """Read what is there.

        Args:
            path: the file, which need not exist; None to keep nothing. A line that an
                interruption cut short is skipped.
        """
        self.path = path
        self.values: dict[str, Any] = {}
        lines = path.read_text().splitlines() if path and path.exists() else []
        for line in lines:
            try:
                self.values |= json.loads(line)
            except json.JSONDecodeError:
                continue  # empty, or cut short

    def get(self, key: str, measure: Callable[[], Any]) -> Any:
        """Return a value, measured if it is not there.

        Args:
            key: of all that the value depends on.
            measure: the value, such as JSON can hold.

        Returns:
            the value.
        """
        if key not in self.values:
            self.values[key] = measure()
            if self.path is not None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with self.path.open("a") as file:
                    # The line break first: it ends a line that was cut short.
                    file.write("\n" + json.dumps({key: self.values[key]}))
        return self.values[key]
