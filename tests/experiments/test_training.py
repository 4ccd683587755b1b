"""The experiments in `training` run, and say what they measured."""

import dataclasses
import json
import os
import pathlib
import subprocess
import sys

import jax
import numpy as np
import pytest

from experiments.training import cost, learned, ship, train
from jscomb import exr, metrics
from jscomb.denoisers import oidn
from jscomb.learning import networks, recipes

ROOT = pathlib.Path(train.__file__).parents[2]


@pytest.mark.slow
@pytest.mark.skipif(not oidn.available(), reason="needs Open Image Denoise")
def test_networks_are_measured_beside_the_rest(folder, glass_frame):
    found = learned.run(learned.Config(folder, quick=True))
    errors = found.rows["glass 64"]
    assert {"path tracing", "oidn", "whitened", "njs", "dsc", "pd"} <= errors.keys()
    frame, recipe = glass_frame.normalised(), recipes.RECIPES["dsc"]
    inputs = recipe.inputs(jax.random.key(0), frame, frame.estimates["oidn"])
    image, (r, noise) = recipe.combine(recipes.shipped("dsc"), inputs), frame.reference
    expected = metrics.rel_l2(image, r, half_difference=noise)
    np.testing.assert_allclose(errors["dsc"], expected, rtol=1e-3)
    ratio = errors["dsc"] / errors["oidn"]
    said = learned.summary(found.rows, "dsc")
    np.testing.assert_allclose([said["64"], said["worst"]], ratio, rtol=1e-6)
    answer = learned.report(found).answer
    assert f"dsc {ratio:.2f} (worst {ratio:.2f}), untrained" in answer


def test_the_cost_of_networks_is_their_convolutions():
    costs = cost.run(cost.Config(quick=True))
    assert all(each.seconds > 0 for each in costs.values())
    assert f"{costs['pd light'].share:#.3g}" in cost.report(costs).body
    assert 0 < costs["njs light"].memory < 2000
    # 5x5 of 18 to 48, four 3x3 of 48, 3x3 of 48 to 9: twice a multiplication.
    network = networks.MixingNetwork(jax.random.key(0))
    full = 2 * (25 * 18 * 48 + 4 * 9 * 48 * 48 + 9 * 48 * 9)
    assert cost.operations(network) == full
    assert costs["pd light"].operations < full / 3


@pytest.fixture(scope="module")
def crops(tmp_path_factory):
    """Return a folder of four pieces of each bundled frame; the first is held out."""
    folder = tmp_path_factory.mktemp("crops")
    for file in exr.bundled().values():
        frame, spp = exr.read_frame(file), file.stem.rpartition("-")[2]
        for k, (row, column) in enumerate(np.ndindex(2, 2)):
            rows, columns = (slice(64 * n, 64 * n + 64) for n in (row, column))
            cut = lambda a: a[..., rows, columns, :] if a.ndim > 2 else a  # noqa: B023
            exr.write_frame(folder / f"piece-{k}-{spp}.exr", jax.tree.map(cut, frame))
    return folder


def untrained(method):
    """What a quick run begins with."""
    return train.ALL[method].network(jax.random.key(train.QUICK.seed), size="light")


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pd", "kernels-njs"])
def test_quick_training_lowers_the_validation_loss(method, crops, tmp_path):
    """On a held-out piece, as the command does it; a finished run stays unchanged.

    For the two that start far from their optimum: njs and dsc start as the estimators
    without a network, which a minute of training does not certainly improve.
    """
    if method == "pd" and not oidn.available():
        pytest.skip("needs Open Image Denoise")
    config = train.Config(method, crops, tmp_path / "run", quick=True)
    command = [sys.executable, "-m", train.__name__, method, f"{crops}"]
    # Programs that are not optimised would take minutes.
    optimised = os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=3"}
    options = ["--out", f"{config.out}", "--quick"]
    subprocess.run([*command, *options], env=optimised, cwd=ROOT, check=True)
    card = json.loads((config.out / "network.json").read_text())
    first, *_, last = card["losses"]["validation"]
    assert last < 0.6 * first
    _, held = (train.prepare(method, frames) for frames in train.split(crops))
    beginning = train.relative_l2(method, untrained(method), held)
    assert card["relative_l2"] < 0.7 * beginning
    assert card["frames"] == [6, 2]
    assert (tmp_path / "run" / "losses.png").stat().st_size > 1000
    before = (tmp_path / "run" / "network.safetensors").read_bytes()
    with pytest.raises(ValueError, match="holds another run"):
        train.run(dataclasses.replace(config, size="full"))
    assert (tmp_path / "run" / "network.safetensors").read_bytes() == before


def test_split_is_by_scene(tmp_path):
    names = [f"random-{k:05d}-{spp}.exr" for k in range(20) for spp in (4, 64)]
    for name in names:
        (tmp_path / name).touch()
    learned, held = train.split(tmp_path)
    assert len(learned) == 36
    assert len(held) == 4
    scenes = lambda files: {train.scene_of(f) for f in files}
    assert not scenes(learned) & scenes(held)
    with pytest.raises(ValueError, match="wanted two"):
        train.split(tmp_path / "empty")


def test_frames_without_a_reference_are_refused(tmp_path, glass_frame):
    bare = glass_frame._replace(reference=None)
    exr.write_frame(tmp_path / "bare-4.exr", bare)
    with pytest.raises(ValueError, match=r"bare-4\.exr has no reference"):
        train.prepare("dsc", [tmp_path / "bare-4.exr"])


def test_only_a_run_of_the_method_is_shipped(tmp_path):
    card = {"method": "pd-smape", "size": "light", "steps": 3, "schedule": {}}
    run = tmp_path / "run"
    run.mkdir()
    (run / "network.json").write_text(json.dumps(card))
    config = ship.Config("pd", run, tmp_path, out=tmp_path / "weights")
    with pytest.raises(ValueError, match="is a run of pd-smape"):
        ship.run(config)
    assert not config.out.exists()
