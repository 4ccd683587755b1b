"""The public modules of the package, which its pages and its promises are about."""

import importlib
import pkgutil
import re
import types

import jscomb

# The command has its own help; `exr` exports what reads and writes native files.
CLOSED = ("jscomb.cli", "jscomb.__main__", "jscomb.exr.native")


def modules() -> dict[str, types.ModuleType]:
    """The modules and packages without underscore, by their names."""
    found = pkgutil.walk_packages(jscomb.__path__, "jscomb.")
    names = ["jscomb", *(m.name for m in found)]
    public = [n for n in names if "._" not in n and not n.startswith(CLOSED)]
    return {name: importlib.import_module(name) for name in public}


def slug(heading: str) -> str:
    """The anchor that Markdown gives a heading."""
    words = re.sub(r"[^\w\- ]", "", heading).strip().lower()
    return words.replace(" ", "-")
