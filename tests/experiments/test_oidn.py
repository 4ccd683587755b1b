"""The experiments in `oidn` run, and say what they measured."""

import pytest

from experiments.oidn import network, sure, tuning, variants
from jscomb import exr
from jscomb.denoisers import oidn
from jscomb.denoisers.oidn._models import MODELS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise"),
]


def test_variants_and_ensembles(folder):
    found = variants.run(variants.Config(folder, quick=True))
    (row,) = found.values()
    said = variants.report(found)
    assert f"| oidn-color | {row['oidn-color'] / row['oidn']:#.3g} |" in said.body
    best = min(row["features"], row[list(variants.ENSEMBLES)[-1]]) / row["oidn"]
    assert f"has {best:.2f} of the error of `oidn`" in said.answer
    assert best < 1  # an ensemble of variants is better than the first of them
    assert row["turns"] > 0.3  # and the turns show where it is wrong


def test_sure_against_truth(folder):
    """By the derivative it is the truth; by the wide difference it is not."""
    found = sure.run(sure.Config(folder, quick=True))
    assert list(found) == list(sure.NOISES)
    (ways,) = found[0.05].values()
    mean = lambda way: sum(ways[way]) / sum(ways["true"])
    assert abs(mean("derivative") - 1) < abs(mean("difference 0.03") - 1)
    assert f"{mean('derivative'):.2f}" in sure.report(found).answer


def test_network_against_filter(folder):
    found = network.run(network.Config(folder, quick=True))
    assert len(found["parity"]) == len(MODELS)
    assert max(row["difference"] for row in found["parity"].values()) < 1e-4
    assert 0.9 < found["fall"] < 1.1
    said = network.report(found)
    assert f"All {len(MODELS)} networks make the filter's image" in said.answer
    assert "| 48² | large |" in said.body


def test_tuning_in_ensembles(glass_frame, tmp_path):
    exr.write_frame(tmp_path / "glass-64.exr", glass_frame._replace(estimates={}))
    config = tuning.Config(tmp_path, tmp_path / "estimates", quick=True)
    (row,) = tuning.run(config).values()
    assert 0.3 < row["frame"] < 3
    assert 0.5 < row["balanced"] < 1.5
    assert f"{row['best']:.3f}" in tuning.report({"glass 64": row}).answer
