"""The API pages: what the docstrings say of every public name, and the guide, by pdoc.

    python -m experiments.common.pages FOLDER

Public is what stands in the `__all__` of a module without underscore. A warning of pdoc
or a link that leads nowhere ends it: then a docstring, an import or a page is broken.
"""

import html.parser
import inspect
import os
import pathlib
import re
import sys
import urllib.parse
import warnings

import pdoc
from markupsafe import Markup
from pdoc.render_helpers import format_signature

import jscomb
from tests.battery.public import CLOSED, modules, slug

_BESIDE = re.compile(r'<a href="(?:\.\./){2}[^"]*">(.*?)</a>', re.DOTALL)
_PRIVATE = re.compile(r'<a href="#_[^"]*">(.*?)</a>', re.DOTALL)
_PAGE = re.compile(r'<a href="(\w+)\.md(?:#([^"]*))?">')
_INCLUDED = re.compile(r"^\.\. include:: (\w+)\.md$", re.MULTILINE)
_GUIDE = pathlib.Path(jscomb.__path__[0], "guide")


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


def _join_guide(page: pathlib.Path) -> None:
    """Let the guide's links lead within its one page, and drop those out of it."""
    text = page.read_text()
    missing = {p.stem for p in _GUIDE.glob("*.md")}
    missing -= set(_INCLUDED.findall((_GUIDE / "__init__.py").read_text()))
    if missing:
        raise ValueError(f"the guide does not include {', '.join(sorted(missing))}")

    def within(found: re.Match[str]) -> str:
        name, anchor = found.groups()
        title = (_GUIDE / f"{name}.md").read_text().partition("\n")[0]
        return f'<a href="#{anchor or slug(title)}">'

    # What is beside the package in the repository is no part of the pages.
    page.write_text(_PAGE.sub(within, _BESIDE.sub(r"\1", text)))


class _Links(html.parser.HTMLParser):
    """The anchors of a page, and where its links lead."""

    def __init__(self) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what the tag is called and links to."""
        found = dict(attrs)
        self.anchors |= {found[k] for k in ("id", "name") if found.get(k)}
        self.links += [found[k] for k in ("href", "src") if found.get(k)]


def broken_links(folder: pathlib.Path) -> list[str]:
    """Find the links of HTML pages to files and anchors that are not there.

    Args:
        folder: of the pages; addresses elsewhere are not followed.

    Returns:
        the page and the link, of each.
    """
    pages = {}
    for path in folder.rglob("*.html"):
        pages[path.resolve()] = found = _Links()
        found.feed(path.read_text())
    broken = []
    for path, page in pages.items():
        for link in page.links:
            where = urllib.parse.urlparse(link)
            if where.scheme or where.netloc:
                continue
            target = path.parent / where.path if where.path else path
            target = pathlib.Path(os.path.normpath(target))
            anchors = pages[target].anchors if target in pages else ()
            anchor = urllib.parse.unquote(where.fragment)
            if not target.exists() or (anchor and anchor not in anchors):
                broken.append(f"{path.relative_to(folder.resolve())}: {link}")
    return broken


def main(folder: str) -> None:
    """Write the pages.

    Args:
        folder: where to; made if it is not there.

    Raises:
        ValueError: if a page of the guide is missing, or a link broken.
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
    warnings.filterwarnings("ignore", ".*has already been added")  # by its package
    hidden = [f"!{re.escape(name)}" for name in CLOSED]
    pages = pathlib.Path(folder)
    for name in jscomb.__all__:  # imported when asked for, which pdoc does not
        getattr(jscomb, name)
    pdoc.pdoc(*modules(), *hidden, output_directory=pages)
    for path in pages.rglob("*.html"):  # pdoc links to private bases, too
        path.write_text(_PRIVATE.sub(r"\1", path.read_text()))
    _join_guide(pages / "jscomb" / "guide.html")
    if broken := broken_links(pages):
        raise ValueError("these links lead nowhere: " + "; ".join(sorted(set(broken))))


if __name__ == "__main__":
    main(*sys.argv[1:])
