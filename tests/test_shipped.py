"""Shipped networks earn their place on small frames of scenes unseen in training.

In relative L2 over the better input, geometric means: against the same network with the
parameters that training may begin with, and against the estimator without a network.
The thresholds are such that parameters drawn at random miss them, which is tested too.
"""

import functools
import pathlib

import jax
import numpy as np
import pytest

from jscomb import exr
from jscomb.denoisers import oidn
from jscomb.learning import recipes
from jscomb.learning.recipes import RECIPES
from jscomb.metrics import rel_l2

FRAMES = sorted(pathlib.Path(__file__).parent.glob("data/*.exr"))
EARNED = ["pd"]  # what the default method runs; the others' cards say what they miss
SEEDS = (0, 1, 2)

pytestmark = pytest.mark.skipif(not oidn.available(), reason="needs a denoiser")


@functools.cache
def given(name):
    """Inputs, reference and the better input's error of every frame."""
    recipe, found = RECIPES[name], []
    for file in FRAMES:
        frame = exr.read_frame(file).normalised()
        if recipe.estimate not in frame.estimates:
            continue
        estimate = frame.estimates[recipe.estimate]
        inputs = recipe.inputs(jax.random.key(0), frame, estimate)
        better = min(error(i, frame) for i in (frame.color, estimate.image))
        found.append((frame, inputs, better))
    return found


def error(image, frame):
    """Relative L2, less the reference's noise."""
    r, noise = frame.reference
    return float(rel_l2(image, r, half_difference=noise))


def ratios(name, combine):
    """Errors of what a function of the inputs makes, over the better input's."""
    return np.array([error(combine(i), frame) / b for frame, i, b in given(name)])


@functools.cache
def of_network(name, seed=None):
    """Ratios of the shipped network, or of the same with random parameters."""
    network, recipe = recipes.shipped(name), RECIPES[name]
    if seed is not None:
        card = recipes.read_card(recipes.WEIGHTS / f"{name}.safetensors")
        network = recipe.make(jax.random.key(seed), **recipes.options_of(card))
    return ratios(name, functools.partial(jax.jit(recipe.combine), network))


@functools.cache
def without(name):
    """Ratios of the estimator without a network, on the same inputs."""
    return ratios(name, jax.jit(RECIPES[name].without))


def mean(values):
    """Geometric mean."""
    return np.exp(np.mean(np.log(values)))


def earns(values, untrained, plain):
    """Which of the promises hold for these ratios."""
    return {
        "10 % below untrained": all(mean(values) <= 0.9 * mean(u) for u in untrained),
        "5 % below without a network": mean(values) <= 0.95 * mean(plain),
        "worst at most 1.05": values.max() <= 1.05,
    }


def test_the_frames_are_of_several_scenes_and_counts():
    scenes = {file.stem.rpartition("-")[0] for file in FRAMES}
    samples = {file.stem.rpartition("-")[2] for file in FRAMES}
    assert len(scenes) >= 4
    assert len(samples) >= 3
    cards = [recipes.read_card(f) for f in recipes.WEIGHTS.glob("*.safetensors")]
    trained = {scene for c in cards for scene in c.get("train", {}).get("scenes", [])}
    assert not {scene.removeprefix("unseen-") for scene in scenes} & trained


@pytest.mark.parametrize("name", EARNED)
def test_a_shipped_network_keeps_every_promise(name):
    untrained = [of_network(name, seed) for seed in SEEDS]
    held = earns(of_network(name), untrained, without(name))
    assert all(held.values()), held
    for samples in (16, 64, 256, 1024):
        at = [file.stem.endswith(f"-{samples}") for file in FRAMES]
        for each in untrained:
            assert mean(of_network(name)[at]) < mean(each[at])


@pytest.mark.parametrize("name", EARNED)
@pytest.mark.parametrize("seed", SEEDS)
def test_random_parameters_keep_none(name, seed):
    """In place of the trained ones, beside others drawn at random."""
    others = [of_network(name, other) for other in SEEDS if other != seed]
    held = earns(of_network(name, seed), others, without(name))
    assert not any(held.values()), held
