"""The rules of the house, checked on the source and on the public functions."""

import ast
import importlib
import inspect
import pathlib
import pkgutil
import re
import tomllib

import pytest

import jscomb
from tests.battery.public import modules

# Each room may use those before it, never one after it.
ROOMS = [
    "typing",
    "cache",
    "numerics",
    "frame",
    "features",
    "metrics",
    "james_stein",
    "ensemble",
    "double_shrinkage",
    "progressive",
    "uncorrelated",
    "denoisers",
    "learning",
    "rendering",
    "methods",
    "exr",
    "plots",
    "viewer",
    "rendering",
    "cli",
    "__main__",
    "guide",
    "jscomb",
]
COMBINERS = {
    "james_stein",
    "ensemble",
    "progressive",
    "uncorrelated",
    "double_shrinkage",
}
ROOT = pathlib.Path(__file__).parents[1]
MODULES = [
    importlib.import_module(m.name)
    for m in pkgutil.walk_packages(jscomb.__path__, "jscomb.")
]
PAGES = modules()

# Every name in some `__all__`, once each.
PUBLIC = {
    f"{each.__module__}.{each.__qualname__}": each
    for module in PAGES.values()
    for each in (getattr(module, name) for name in getattr(module, "__all__", ()))
    if getattr(each, "__module__", "").startswith("jscomb.")
    and hasattr(each, "__qualname__")
}
FUNCTIONS = [
    pytest.param(each, id=name)
    for name, each in PUBLIC.items()
    if inspect.isfunction(each)
]


def room(module: str) -> int:
    """The position in `ROOMS` of a dotted module name of the package."""
    return ROOMS.index([*module.split("."), "jscomb"][1])


def imports_of(path: pathlib.Path) -> set[str]:
    """Dotted names of everything of ours that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == "jscomb":
            names |= {f"jscomb.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {name for name in names if name.split(".")[0] == "jscomb"}


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.__name__)
def test_imports_flow_one_way(module):
    ours = imports_of(pathlib.Path(module.__file__))
    below = {name for name in ours if room(name) > room(module.__name__)}
    if module.__name__.startswith("jscomb.cli"):
        below -= {"jscomb"}  # for the version
    assert not below
    name = module.__name__.split(".")[1]
    if name in COMBINERS:
        others = {n.split(".")[1] for n in ours if "." in n}
        assert not others & (COMBINERS - {name}), "no combiner imports another"


@pytest.mark.parametrize("name", PAGES)
def test_public_names_are_listed(name):
    """All that a public module defines, or a package imports to export, sorted."""
    module = PAGES[name]
    if name == "jscomb.typing":
        return
    listed = module.__all__
    assert listed == sorted(listed, key=lambda n: (not n.isupper(), n))
    assert not [n for n in listed if n.startswith("_")]
    defined = {
        n
        for n, each in vars(module).items()
        if inspect.isfunction(each) and each.__module__ == name and n[0] != "_"
    }
    assert defined <= set(listed)


@pytest.mark.parametrize("paper", sorted(COMBINERS))
def test_papers_share_one_floor_plan(paper):
    """The estimator, what it needs to know, and the paper on a frame."""
    files = {path.stem for path in (ROOT / "jscomb" / paper).glob("*.py")}
    assert {"__init__", "_combine", "_estimate", "_frame"} <= files
    package = importlib.import_module(f"jscomb.{paper}")
    assert ("_neural" in files) == hasattr(package, "neural_combine")
    assert {"combine", "combine_frame", "NEEDS"} <= set(package.__all__)
    annotations = inspect.get_annotations(package.combine_frame, eval_str=True)
    assert annotations["return"] is jscomb.Estimate
    for name in ("combine_frame", "neural_combine_frame"):
        if function := getattr(package, name, None):
            order = [p for p in inspect.signature(function).parameters]
            ranks = [n for n in ("key", "denoise", "network", "frame") if n in order]
            assert order[: len(ranks)] == ranks or paper == "uncorrelated"


def test_only_the_networks_need_flax():
    for path in (ROOT / "jscomb").rglob("*.py"):
        if path.name not in ("networks.py", "unet.py", "layers.py", "_network.py"):
            assert not re.search(r"^\s*(import|from) flax", path.read_text(), re.M)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_signature(function):
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters]
    assert all(p.kind is p.KEYWORD_ONLY for p in parameters if p.default is not p.empty)
    assert "key" not in names[1:], "the random key comes first"


@pytest.mark.parametrize("function", FUNCTIONS)
def test_docstring_names_every_argument(function):
    doc = inspect.getdoc(function)
    assert "Returns:" in doc or "Yields:" in doc
    for name in inspect.signature(function).parameters:
        assert f"\n    {name}: " in doc, f"{name} is not described"


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_documented(name):
    each, doc = PUBLIC[name], inspect.getdoc(PUBLIC[name])
    if inspect.isclass(each):
        assert "\nAttributes:\n" in doc
    if inspect.isfunction(each) or name.startswith("jscomb.learning.networks."):
        assert "\nExample:\n    >>> " in doc
    if inspect.isfunction(each) and re.search(
        r"^ +raise ", inspect.getsource(each), re.M
    ):
        assert "\nRaises:\n" in doc


@pytest.mark.parametrize(
    "path", [*ROOT.glob("jscomb/**/*.py"), *ROOT.glob("experiments/**/*.py")], ids=str
)
def test_a_file_stays_readable(path):
    assert len(path.read_text().splitlines()) <= 420


def test_the_package_never_needs_what_is_beside_the_project():
    for path in [*ROOT.glob("jscomb/**/*.py"), *ROOT.glob("tests/**/*.py")]:
        assert "/".join(("..", "shared")) not in path.read_text(), path


def test_version_is_said_once_more_only_in_the_metadata():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == jscomb.__version__
    assert re.search(rf"^## {re.escape(jscomb.__version__)}\b", _changelog(), re.M)


def _changelog() -> str:
    """The change log's text."""
    return (ROOT / "CHANGELOG.md").read_text()
