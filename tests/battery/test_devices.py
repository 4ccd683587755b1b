"""The device decides how much is computed at a time, and changes no result."""

import jax
import pytest

from jscomb import exr
from tests.battery import catalogue
from tests.battery.promises import assert_close, cut
from tests.battery.rendering import rendering_of

ENTRIES = catalogue.combiners() | catalogue.denoisers() | catalogue.solvers()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "simplex.hull",
        "simplex.quadratic",
        "uncorrelated.combine",
        "regression.local_linear",
        "bilateral.denoise",
    ],
)
def test_sizes_for_accelerators_change_no_result(name, monkeypatch):
    frame = exr.read_frame(exr.bundled()["cornell-glass-64"])
    small = cut(rendering_of(frame), 67, 71)
    function, rounding = ENTRIES[name].function, ENTRIES[name].rounding
    expected = jax.jit(lambda r: function(r))(small)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    jax.clear_caches()  # of parts that were traced with the other sizes
    found = jax.jit(lambda r: function(r))(small)
    assert_close(found, expected, rounding)
