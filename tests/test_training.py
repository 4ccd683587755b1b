"""A whole run of training: frames, validation, resuming, the card, the command."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import cli, exr, james_stein, metrics
from jscomb.cli import _training
from jscomb.learning import examples, recipes, training
from jscomb.learning.recipes import RECIPES

RUN = cli.Run("kernels", "light", steps=4, batch=2, crop=16, piece=32, validate=1)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Return a folder of three pieces of a bundled frame, as of three scenes."""
    folder = tmp_path_factory.mktemp("frames")
    frame = exr.read_frame(exr.bundled()["cornell-glass-64"])
    for k in range(3):
        rows, columns = slice(32, 64 + 8 * k), slice(32 * k, 32 * k + 40)
        cut = lambda a: a[..., rows, columns, :] if a.ndim > 2 else a  # noqa: B023
        exr.write_frame(folder / f"piece{k}-64.exr", jax.tree.map(cut, frame))
    return folder


def train(frames, out, run=RUN):
    """Train, and return the card."""
    return cli.train_files(run, RECIPES[run.method], frames, out)


@pytest.mark.slow
def test_the_best_step_is_kept(frames, tmp_path):
    """And is what the card says: settings, data, and the error on other scenes."""
    card = train(frames, tmp_path)
    assert card == json.loads((tmp_path / "network.json").read_text())
    errors = card["losses"]["validation"]
    assert card["losses"]["step"] == [0, 1, 2, 3, 4]
    assert card["best_step"] == int(np.argmin(errors))
    assert card["validation"]["best"]["all"] == min(errors)
    assert card["validation"]["untrained"]["all"] == errors[0]
    assert card["network"] == {"size": "light"}
    assert card["train"] == {"frames": 2, "scenes": ["piece1", "piece2"]}
    assert card["validate"] == {"frames": 1, "scenes": ["piece0"]}
    network = recipes.load_network(RECIPES["kernels"], tmp_path / "network.safetensors")
    (file,) = (f for f in frames.glob("piece0*"))
    frame = exr.read_frame(file).normalised()
    recipe = RECIPES["kernels"]
    inputs = recipe.inputs(jax.random.key(0), frame, frame.estimates["oidn"])
    cut = {name: image[:32, :32] for name, image in inputs.items()}
    r, noise = (i[:32, :32] for i in frame.reference)
    error = metrics.rel_l2(recipe.combine(network, cut), r, half_difference=noise)
    r, noise = frame.reference  # the better input is judged on the whole frame
    better = metrics.rel_l2(frame.color, r, half_difference=noise)
    np.testing.assert_allclose(min(errors), float(error / better), rtol=1e-4)


@pytest.mark.slow
def test_a_resumed_run_equals_one_without_interruption(frames, tmp_path, monkeypatch):
    monkeypatch.setattr(_training, "_SAVE_EVERY", 0.0)
    whole = train(frames, tmp_path / "whole")
    steps = training.run

    def interrupted(*given):
        """Ctrl-C after two steps."""
        for number, each in enumerate(steps(*given), 1):
            yield each
            if number == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(training, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(frames, tmp_path / "parts")
    assert json.loads((tmp_path / "parts" / "network.json").read_text())
    monkeypatch.setattr(training, "run", steps)
    assert train(frames, tmp_path / "parts") == whole
    one, other = (
        (tmp_path / name / "network.safetensors").read_bytes()
        for name in ("whole", "parts")
    )
    assert one == other


def test_wrong_folders_are_refused_before_the_work(frames, tmp_path):
    with pytest.raises(ValueError, match="to train on"):
        train(tmp_path, tmp_path / "run")
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(next(frames.glob("*.exr")), one)
    with pytest.raises(ValueError, match="one scene only"):
        train(one, tmp_path / "run")
    bare = exr.read_frame(next(one.iterdir()))._replace(reference=None)
    exr.write_frame(one / "bare-64.exr", bare)
    with pytest.raises(ValueError, match=r"bare-64\.exr: training needs a reference"):
        train(one, tmp_path / "run")
    with pytest.raises(ValueError, match="no frame of 512x512 pixels or more"):
        train(frames, tmp_path / "run", cli.Run("njs", "light", piece=512))
    with pytest.raises(ValueError, match="no estimate 'photons'"):
        train(frames, tmp_path / "photons", cli.Run("dsc-photons", "light", piece=32))
    assert not (tmp_path / "run" / "network.safetensors").exists()


def test_without_references_half_of_the_samples_are_the_target(
    frames, tmp_path, glass_frame
):
    """Of frames with four sub-buffers; training sees the other half only."""
    bare = glass_frame._replace(reference=None)
    found = examples.with_target(bare)
    first, second = bare.halves()
    np.testing.assert_array_equal(found.color, first.color)
    np.testing.assert_allclose(found.reference.image, second.color, rtol=1e-6)
    one = second.halves()[0].color
    target, difference = found.reference
    np.testing.assert_allclose(target + difference / 2, one, rtol=1e-5, atol=1e-6)
    assert found.samples == glass_frame.samples / 2
    assert examples.with_target(glass_frame) is glass_frame
    holed = bare.buffers.color.at[2, 5, 5].set(jnp.nan)
    holed = examples.with_target(
        bare._replace(buffers=bare.buffers._replace(color=holed))
    )
    assert all(jnp.isfinite(each).all() for each in holed.reference)
    folder = tmp_path / "own"
    folder.mkdir()
    for name in ("a", "b"):
        exr.write_frame(folder / f"{name}-64.exr", bare)
    card = train(folder, tmp_path / "run")
    assert np.isfinite(card["validation"]["best"]["all"])
    assert (tmp_path / "run" / "network.safetensors").exists()


@pytest.mark.slow
def test_validation_is_the_error_over_the_better_input(frames, tmp_path):
    """The inputs themselves have ratios of at least one, the better one of one."""
    held = sorted(frames.glob("*.exr"))
    recipe = RECIPES["njs"]._replace(combine=lambda name, inputs: inputs[name])
    found = cli.prepare(recipe, held, tmp_path, piece=32, variants=False)
    assert len(found.samples) == len(found.better) == len(found.examples.halves)
    assert {*found.samples.tolist()} == {64}
    np.testing.assert_allclose(found.examples.weight[:, 0], 1 / found.better)
    frame = exr.read_frame(held[0]).normalised()
    r, noise = frame.reference
    images = frame.color, frame.estimates["oidn"].image
    errors = [metrics.rel_l2(i, r, half_difference=noise) for i in images]
    np.testing.assert_allclose(found.better[0], min(errors), rtol=1e-4)


def test_black_frames_are_left_out(frames, tmp_path):
    frame = exr.read_frame(next(frames.glob("*.exr")))
    black = frame._replace(reference=jax.tree.map(jnp.zeros_like, frame.reference))
    exr.write_frame(tmp_path / "black-64.exr", black)
    with pytest.raises(ValueError, match="no frame of 32 x 32 pixels"):
        cli.prepare(
            RECIPES["kernels"], [tmp_path / "black-64.exr"], tmp_path / "in", piece=32
        )


def test_a_network_is_used_by_the_rule_it_was_trained_for(rng):
    """By the array function without a word, which is what its card says."""
    x, y, v = (jnp.asarray(rng.random((16, 17, 3)), jnp.float32) for _ in range(3))
    network = recipes.shipped("njs")
    card = recipes.read_card(recipes.WEIGHTS / "njs.safetensors")
    rule = james_stein.Rule(**card["network"]["rule"])
    run = jax.jit(james_stein.neural_combine, static_argnames="rule")
    found = run(network, x, y, y, v / 10)
    np.testing.assert_array_equal(found, run(network, x, y, y, v / 10, rule=rule))
    other = james_stein.Rule(window=15, whiten=not rule.whiten)
    assert np.abs(found - run(network, x, y, y, v / 10, rule=other)).max() > 0.01
