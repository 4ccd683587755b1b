"""The experiments in `progressive` run, and say what they measured."""

import dataclasses

import numpy as np
import pytest

from experiments.progressive import consistency, progressive, sure
from jscomb.denoisers import oidn


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_a_progressive_rendering_knows_its_error(tmp_path):
    """Stages of doubling samples; errors fall; it stops where it was asked to."""
    config = progressive.Config("cornell-box", tmp_path, quick=True)
    found = progressive.run(config)
    assert list(found) == [8, 16, 32]
    for row in found.values():
        assert np.isfinite(list(row.values())).all()
        true, estimated = row["samples"]
        assert 0.3 * true < estimated < 3 * true
    assert found[32]["samples"][0] < found[8]["samples"][0]
    said = progressive.report(found)
    assert said.answer.startswith("From 8 to 32 samples")
    assert f"| 32 | {found[32]['samples'][0]:#.3g} |" in said.body
    sooner = dataclasses.replace(config, target=1e9)
    assert list(progressive.run(sooner)) == [32]  # all that was there already
    with pytest.raises(ValueError, match="first must be from 2 to spp = 32: 1"):
        dataclasses.replace(config, spp=32, first=1)


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_sure_is_compared_with_the_truth(folder):
    """One derivative has more digits than differences of any step."""
    found = sure.run(sure.Config(folder, quick=True))
    digits = found["digits"]
    assert digits["jvp"] < min(error for name, error in digits.items() if name != "jvp")
    (row,) = found["frames"].values()
    said = sure.report(found)
    ratio = row["james-stein, whitened 7x7, corrected"] / row["oidn"]
    assert f"{ratio:.2f} of the denoiser's error" in said.answer
    assert f"| glass 64 | {row['path tracing']:#.3g} |" in said.body


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_the_mix_is_measured_from_few_samples_to_many(tmp_path):
    config = consistency.Config("cornell-box", tmp_path, quick=True)
    found = consistency.run(config)
    assert list(found) == [4, 16, 64]
    assert all(np.isfinite(list(row.values())).all() for row in found.values())
    assert found[64]["path tracing"] < found[4]["path tracing"]
    # Bounded, the mix moves less, towards path tracing.
    assert found[64]["mix"] != found[64]["mix, no bound"]
    said = consistency.report(found)
    last = found[64]["mix"] / found[64]["path tracing"]
    assert f"to {last:.3f}, at most" in said.answer.rpartition("; mix ")[2]
