"""What every combiner promises."""

from tests.battery import catalogue
from tests.battery.promises import *  # noqa: F403 (the tests)
from tests.battery.promises import assert_close, cut

ENTRIES = catalogue.combiners()


def test_eager_is_compiled(function, plain):
    """On an image smaller than the windows.

    Denoisers and solvers are loops, and those are compiled either way.
    """
    small = cut(plain, 4, 5)
    eager, jitted = function.entry.function(small), function.result(small)
    assert_close(eager, jitted, 10 * function.entry.rounding)
