"""Assertions about expectations, calibrated by their own standard error."""

import numpy as np


def _mean_and_error(samples) -> tuple[float, float]:
    """Mean of independent samples and its standard error."""
    samples = np.asarray(samples, np.float64)
    return samples.mean(), samples.std(ddof=1) / np.sqrt(samples.size)


def assert_mean(samples, expected, *, sigmas: float = 5.0) -> None:
    """Pass if the mean of independent `samples` is within `sigmas` of `expected`."""
    mean, error = _mean_and_error(samples)
    z = (mean - expected) / error
    assert abs(z) < sigmas, f"mean {mean:.6g} is {z:+.1f} sigma from {expected:.6g}"


def assert_mean_below(samples, bound, *, sigmas: float = 5.0) -> None:
    """Pass if the mean of independent `samples` is below `bound` by `sigmas`."""
    mean, error = _mean_and_error(samples)
    assert mean + sigmas * error < bound, f"{mean:.6g} +- {error:.2g} against {bound}"
