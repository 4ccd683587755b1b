"""What every solver and estimator promises."""

from tests.battery import catalogue
from tests.battery.promises import *  # noqa: F403 (the tests)

ENTRIES = catalogue.solvers(window=7)
