"""Strict arithmetic for every test: no silent broadcast, promotion or key reuse."""

import gc
import itertools
import os
import pathlib
import shutil
import sys

import jax
import jaxtyping
import matplotlib as mpl
import numpy as np
import pytest

from jscomb import cli, exr, rendering
from jscomb.frame import CHANNELS

# Tests mostly wait for programs of small images to be compiled, so LLVM compiles them
# without optimising, unless one asks for something else. JAX reads this when it first
# compiles; processes inherit it.
_FLAGS = [
    "--xla_backend_optimization_level=0",
    "--xla_cpu_parallel_codegen_split_count=1",
]
if jax.__version_info__ < (0, 11):  # later ones end the process over this flag
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_debug_key_reuse", True)
mpl.use("agg")

pytest.register_assert_rewrite("tests.battery.promises")

# Traces are many small objects: to look through them after every few hundred takes a
# sixth of the suite.
gc.set_threshold(200_000, 50, 100)

DATA = pathlib.Path(__file__).parent / "data"
MAPPINGS = pathlib.Path("/proc/self/maps")
_TESTS = itertools.count()


def pytest_collection_modifyitems(items):
    """Notebooks are slow, and so are docstrings' examples: hundreds of programs."""
    for item in items:
        if item.path.suffix == ".ipynb" or isinstance(item, pytest.DoctestItem):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def rng():
    """A generator of its own for every test, so that none depends on others."""
    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def few_programs():
    """Give compiled programs up before the process may map no more memory.

    A program takes up to hundreds of the 65530 mappings that Linux allows.
    """
    yield
    seldom = next(_TESTS) % 20 == 0  # to count takes a while
    if seldom and MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > 45_000:
        jax.clear_caches()


@pytest.fixture
def unchecked():
    """As users run it: without jaxtyping's checks, which would answer first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def jscomb(monkeypatch, capsys):
    """Run the command in this process; returns status, output and error."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["jscomb", *map(os.fspath, arguments)])
        monkeypatch.setattr(cli, "_use_compilation_cache", lambda: None)
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def browser():
    """Headless Chromium, whose graphics are drawn by the processor."""
    paths = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in paths:
        pytest.skip("needs Debian's chromium and chromium-driver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    drawing = "--use-angle=swiftshader", "--enable-unsafe-swiftshader"
    for flag in ("--headless=new", "--no-sandbox", "--window-size=1200,900", *drawing):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=paths[1])
    driver = webdriver.Chrome(options=options, service=service)
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def vectorised():
    """Mitsuba's LLVM variant, whatever other tests have set."""
    mi = rendering.mitsuba()
    if not os.environ.get("DRJIT_LIBLLVM_PATH"):
        pytest.skip("needs LLVM 17 or newer")
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    yield mi
    mi.set_variant(before)


@pytest.fixture(scope="session", params=["cornell-glass-64", "cornell-box-64"])
def real_frame(request):
    """A 64x64 crop of a real path-traced frame with four sub-buffers, float32."""
    return exr.read_frame(DATA / f"{request.param}.exr")


@pytest.fixture(scope="session")
def glass_frame():
    """The crop around the caustic, 64 samples a pixel."""
    return exr.read_frame(DATA / "cornell-glass-64.exr")


@pytest.fixture
def folder(glass_frame, tmp_path):
    """An archive of one sample count, made of the crop."""
    arrays = {
        "reference": glass_frame.reference.image,
        "reference_half_difference": glass_frame.reference.half_difference,
        "full_oidn_32": glass_frame.estimates["oidn"].image,
    }
    for name, half in zip("ab", glass_frame.halves(), strict=True):
        arrays[f"{name}_color_32"] = half.color
        arrays[f"{name}_variance_32"] = half.variance
        arrays[f"{name}_oidn_32"] = half.estimates["oidn"].image
        for feature, channels in CHANNELS.items():
            image = getattr(half, feature)
            arrays[f"{name}_{feature}"] = image[..., 0] if channels == 1 else image
    np.savez(tmp_path / "glass.npz", **arrays)
    return tmp_path
