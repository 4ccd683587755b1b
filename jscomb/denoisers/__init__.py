"""Makers of biased images."""

from jscomb.denoisers import oidn as oidn
