"""The API pages: what the docstrings say of every public name, put together by pdoc.

    python -m experiments.api FOLDER

Public is what a user reaches by the front doors: the names that a package exports, and
in a module that is imported by itself every name without underscore. A warning of pdoc
ends it: then a docstring or an import is broken.
"""

import ast
import importlib
import inspect
import pathlib
import pkgutil
import re
import sys
import types
import warnings

import pdoc
from markupsafe import Markup
from pdoc.render_helpers import format_signature

import jscomb

# Packages whose modules are imported by themselves. All others are front doors: what
# lies behind them is public only if they export it.
_OPEN = {"jscomb", "jscomb.denoisers", "jscomb.learning", "jscomb.numerics"}
# The command has its own help; `of_parts` is exported by `denoisers`.
_CLOSED = {"jscomb.cli", "jscomb.__main__", "jscomb.denoisers.parts"}


def modules() -> dict[str, types.ModuleType]:
    """The public modules and packages by their names."""
    found = pkgutil.walk_packages(jscomb.__path__, "jscomb.")
    names = [m.name for m in found if m.name.rpartition(".")[0] in _OPEN]
    public = ["jscomb", *(name for name in names if name not in _CLOSED)]
    return {name: importlib.import_module(name) for name in public}


def names(module: types.ModuleType) -> list[str]:
    """The public functions and classes of a module, and all that a package exports.

    Args:
        module: one of `modules`.

    Returns:
        the names in the order of the source.
    """
    found = []
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.append(node.name)
        elif isinstance(node, ast.ImportFrom):
            found += [alias.name for alias in node.names if alias.name == alias.asname]
    return [name for name in found if not name.startswith("_")]


class _Written(str):
    """An annotation as it is to be read."""

    __repr__ = str.__str__


def _signature(signature: inspect.Signature, colon: bool) -> Markup:
    """As pdoc has it, but `Float[Array, 'h w c']` without the modules in between."""

    def written(annotation: object) -> object:
        if annotation is inspect.Signature.empty:
            return annotation
        text = inspect.formatannotation(annotation)
        return _Written(re.sub(r"~|\b(jaxtyping|jaxlib\._jax|jax|typing)\.", "", text))

    parameters = [
        p.replace(annotation=written(p.annotation))
        for p in signature.parameters.values()
    ]
    return format_signature(
        signature.replace(
            parameters=parameters,
            return_annotation=written(signature.return_annotation),
        ),
        colon,
    )


def _only_own_words(kind: type) -> None:
    """Take off what Python says of a named tuple; its docstring has the attributes."""
    for field in getattr(kind, "_fields", ()):
        getattr(kind, field).__doc__ = "@private"
    if hasattr(kind, "_fields"):
        kind.__new__.__doc__ = None


def main(folder: str) -> None:
    """Write the pages.

    Args:
        folder: where to; made if it is not there.
    """
    public = modules()
    for name, module in public.items():
        for each in names(module):
            if inspect.isclass(found := getattr(module, each)):
                _only_own_words(found)
        if hasattr(module, "__path__"):
            inside = [m.rpartition(".") for m in public]
            inside = [last for package, _, last in inside if package == name]
            module.__all__ = [*dict.fromkeys(names(module) + inside)]
    every = pkgutil.walk_packages(jscomb.__path__, "jscomb.")
    hidden = [f"!{re.escape(m.name)}$" for m in every if m.name not in public]
    pdoc.render.configure(
        docformat="google",
        show_source=False,
        footer_text=f"jscomb {jscomb.__version__}",
    )
    pdoc.render.env.filters["format_signature"] = _signature
    warnings.simplefilter("error")
    # optax's type of a state names itself.
    warnings.filterwarnings("ignore", "Error parsing type annotation .*ArrayTree")
    pdoc.pdoc("jscomb", *hidden, output_directory=pathlib.Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
