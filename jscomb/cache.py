"""The user's folder of what can be computed again."""

import os
import pathlib

__all__ = ["folder"]


def folder() -> pathlib.Path:
    """Return jscomb's folder in the user's cache; it may not exist yet.

    Returns:
        `$XDG_CACHE_HOME/jscomb`, or `~/.cache/jscomb`.

    Example:
        >>> print(folder().name)
        jscomb
    """
    root = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return pathlib.Path(root, "jscomb")
