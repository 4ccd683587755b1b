"""The experiments in `training` run, and say what they measured."""

import jax
import numpy as np
import pytest

from experiments.training import learned, learned_speed
from jscomb import metrics
from jscomb.denoisers import oidn
from jscomb.learning import networks, recipes


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_networks_are_measured_beside_the_rest(folder, glass_frame):
    rows = learned.run(learned.Config(folder, quick=True))
    errors = rows["glass", 64]
    assert {"path tracing", "oidn", "whitened", "njs", "dsc", "pd"} <= errors.keys()
    frame, recipe = glass_frame.normalised(), recipes.RECIPES["dsc"]
    inputs = recipe.inputs(jax.random.key(0), frame, frame.estimates["oidn"])
    image, (r, noise) = recipe.combine(recipes.shipped("dsc"), inputs), frame.reference
    expected = metrics.rel_l2(image, r, half_difference=noise)
    np.testing.assert_allclose(errors["dsc"], expected, rtol=1e-3)
    table = learned.summary(rows)
    np.testing.assert_allclose(
        table["njs"]["64"], errors["njs"] / errors["oidn"], rtol=1e-6
    )
    assert table["oidn"] == {"64": 1.0, "worst": 1.0}


def test_the_cost_of_networks_is_their_convolutions():
    costs = learned_speed.run(learned_speed.Config(quick=True))
    assert all(cost.seconds > 0 for cost in costs.values())
    assert 0 < costs["njs light"].memory < 2000
    # 5x5 of 18 to 48, four 3x3 of 48, 3x3 of 48 to 9: twice a multiplication.
    network = networks.MixingNetwork(jax.random.key(0))
    full = 2 * (25 * 18 * 48 + 4 * 9 * 48 * 48 + 9 * 48 * 9)
    assert learned_speed.operations(network) == full
    assert costs["pd light"].operations < full / 3
