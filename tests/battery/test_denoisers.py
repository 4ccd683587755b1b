"""What every denoiser promises."""

from tests.battery import catalogue
from tests.battery.promises import *  # noqa: F403 (the tests)

ENTRIES = catalogue.denoisers(window=7)
