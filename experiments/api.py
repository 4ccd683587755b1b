"""The API pages: what the docstrings say of every public name, put together by pdoc.

    python -m experiments.api FOLDER

Public is what stands in the `__all__` of a module without underscore. A warning of pdoc
ends it: then a docstring or an import is broken.
"""

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

# The command has its own help; `exr` exports what reads and writes native files.
_CLOSED = ("jscomb.cli", "jscomb.__main__", "jscomb.exr.native")


def modules() -> dict[str, types.ModuleType]:
    """The public modules and packages by their names."""
    found = pkgutil.walk_packages(jscomb.__path__, "jscomb.")
    names = ["jscomb", *(m.name for m in found)]
    public = [n for n in names if "._" not in n and not n.startswith(_CLOSED)]
    return {name: importlib.import_module(name) for name in public}


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
    for module in modules().values():
        for each in getattr(module, "__all__", ()):
            if inspect.isclass(found := getattr(module, each)):
                _only_own_words(found)
    pdoc.render.configure(
        docformat="google",
        show_source=False,
        footer_text=f"jscomb {jscomb.__version__}",
    )
    pdoc.render.env.filters["format_signature"] = _signature
    warnings.simplefilter("error")
    # optax's type of a state names itself.
    warnings.filterwarnings("ignore", "Error parsing type annotation .*ArrayTree")
    hidden = [f"!{re.escape(name)}" for name in _CLOSED]
    pdoc.pdoc("jscomb", *hidden, output_directory=pathlib.Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
