"""The functions of a module's `ENTRIES`, each for all its tests in a row."""

import jax
import pytest

from tests.battery.promises import SIZE, compiled, cut
from tests.battery.rendering import rendering_of


def pytest_generate_tests(metafunc):
    """A test of `function` is one for each entry of the module that imports it."""
    if "function" in metafunc.fixturenames:
        names = metafunc.module.ENTRIES
        metafunc.parametrize("function", names, indirect=True, scope="module")


@pytest.fixture(scope="module")
def function(request):
    """One of the entries; its programs are given up after its tests."""
    yield compiled(request.module.ENTRIES[request.param])
    jax.clear_caches()


@pytest.fixture(scope="session")
def whole(glass_frame):
    """A real frame with fireflies, 64x64, float32."""
    return rendering_of(glass_frame)


@pytest.fixture(scope="session")
def plain(whole):
    """A crop of it: promises do not depend on the number of pixels, the time does."""
    return cut(whole, SIZE, SIZE)
