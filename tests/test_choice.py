"""The method that half buffers choose: references and made-up frames are the judges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import choice, choose, metrics
from jscomb.denoisers import oidn
from jscomb.frame import Estimate, make_frame

CHEAP = [choice.KEEP, "whitened"]
key = lambda: jax.random.key(0)


def error(image, frame):
    """Relative L2 of an image of a frame with a reference."""
    r, noise = frame.reference
    return float(metrics.rel_l2(image, r, half_difference=noise))


def test_the_choice_is_near_the_best(real_frame):
    """On a rendered frame: about the denoised image's error at most, near the least."""
    if not oidn.available():
        pytest.skip("needs Open Image Denoise")
    found = choose(real_frame)
    assert [t.method for t in found.trials] == list(choice.CANDIDATES[1:])
    errors = {
        m: error(choice.combine(key(), real_frame, "oidn", method=m), real_frame)
        for m in choice.CANDIDATES
    }
    assert errors[found.method] < 1.02 * errors[choice.KEEP]
    assert errors[found.method] < 1.1 * min(errors.values())
    assert all(t.seconds > 0 for t in found.trials)


@pytest.mark.parametrize("truth_is", ["biased", "unbiased"])
def test_a_perfect_image_is_kept_and_a_wrong_one_is_not(truth_is):
    noise = jax.random.normal(key(), (2, 48, 48, 3))
    one = jnp.ones((48, 48, 3))
    y = one if truth_is == "biased" else 3 * one
    frame = make_frame(
        1 + 0.1 * noise,
        variance=one * 0.01 / 2,
        estimates={"y": Estimate(y, jnp.stack([y, y]))},
    )
    found = choose(frame, methods=CHEAP)
    assert found.method == (choice.KEEP if truth_is == "biased" else "whitened")
    scaled = choose(frame.scaled(1e-5), methods=CHEAP)
    assert scaled.method == found.method
    np.testing.assert_allclose(
        scaled.trials[0].change.mean, found.trials[0].change.mean, rtol=1e-4
    )


def test_a_budget_leaves_the_slow_out(glass_frame):
    none = choose(glass_frame, budget=0.0, methods=CHEAP)
    assert none.method == choice.KEEP
    assert "s of 0" in none.trials[0].reason
    assert choose(glass_frame, budget=1e9, methods=CHEAP).method == "whitened"


def test_what_needs_halves_is_judged_by_quarters(glass_frame):
    """Four sub-buffers and a denoiser: its halves have halves of their own."""
    if not oidn.available():
        pytest.skip("needs Open Image Denoise")
    assert glass_frame.sub_buffers == 4
    assert (
        choose(glass_frame, methods=[choice.KEEP, "dsc"]).trials[0].change is not None
    )
    (trial,) = choose(glass_frame.merged(2), methods=[choice.KEEP, "dsc"]).trials
    assert trial.change is None
    assert "no biased image 'oidn' with halves" in trial.reason


def test_without_halves_nothing_is_known(glass_frame):
    assert choose(glass_frame.merged(1)) == choice.Choice("whitened", ())
    y = glass_frame.estimates["oidn"].image
    alone = glass_frame._replace(estimates={}).with_estimate("y", y)
    assert choose(alone) == choice.Choice("whitened", ())


def test_invalid_pixels_do_not_decide(glass_frame):
    bad = glass_frame.buffers.color.at[0, 3, 4].set(jnp.nan).at[1, 5, 6].set(jnp.inf)
    frame = glass_frame._replace(buffers=glass_frame.buffers._replace(color=bad))
    (found,) = choose(frame, methods=CHEAP).trials
    (clean,) = choose(glass_frame, methods=CHEAP).trials
    np.testing.assert_allclose(found.change.mean, clean.change.mean, rtol=0.05)


def test_bad_input(glass_frame):
    with pytest.raises(ValueError, match=r"no biased image 'x'; there are \['oidn'\]"):
        choose(glass_frame, name="x")
    two = glass_frame.with_estimate("other", glass_frame.estimates["oidn"])
    with pytest.raises(ValueError, match="of which biased image"):
        choose(two)
    for methods in ([], ["kept", "x"]):
        with pytest.raises(ValueError, match=r"methods \[.*: there are kept, james"):
            choose(glass_frame, methods=methods)
    with pytest.raises(ValueError, match="no method 'x'; there are kept"):
        choice.combine(key(), glass_frame, "oidn", method="x")
    with pytest.raises(ValueError, match="no biased image 'x'"):
        choice.combine(key(), glass_frame, "x", method="whitened")
