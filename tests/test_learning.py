"""Training, checkpoints, and the recipes of the networks."""

import dataclasses
import pathlib
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jscomb.denoisers import kernel_predicting
from jscomb.learning import checkpoints, losses, networks, recipes, training
from jscomb.learning.recipes import RECIPES
from jscomb.metrics import rel_l2, smape
from tests.statistics import assert_mean

DATA = pathlib.Path(__file__).parent / "data"
SCHEDULE = training.Schedule(steps=6, batch=2, crop=8)
SHIPPED = ["dsc", "dsc-photons", "njs", "pd"]


@pytest.fixture
def examples(rng):
    """Three frames of noise; inputs are the reference, and in a variant its half."""
    reference = jnp.asarray(rng.random((3, 12, 14, 3)), jnp.float32)
    both = jnp.stack([reference, reference / 2], axis=1)
    halves = jnp.stack([reference, 3 * reference], axis=1)
    weight = jnp.array([[1.0, 8.0], [2.0, 16.0], [4.0, 32.0]], jnp.float32)
    return training.Examples({"full": both, "one": both[..., :1]}, halves, weight)


def test_draw_keeps_images_together(examples):
    """Inputs and halves are cut, flipped and coloured alike; the unit differs."""
    variants, weights = set(), set()
    for key in jax.random.split(jax.random.key(0), 20):
        crop = training.draw(key, examples, SCHEDULE)
        reference, other = crop.halves
        assert reference.shape == (8, 8, 3)
        np.testing.assert_array_equal(other, 3 * reference)
        share = float(crop.inputs["full"][0, 0, 0] / reference[0, 0, 0])
        np.testing.assert_allclose(crop.inputs["full"], share * reference, rtol=1e-6)
        assert crop.inputs["one"].shape == (8, 8, 1)
        assert 0.5 <= float(crop.unit) <= 2
        variants.add(share)
        # Its pixels are those of the frame whose weight it has, up to their channels.
        weight = float(crop.weight) / (1 if share == 1 else 8)
        weights.add(weight)
        frame = examples.halves[int(np.log2(weight)), 0]
        pixels = np.sort(np.asarray(frame).reshape(-1, 3), axis=-1)
        found = np.sort(np.asarray(reference).reshape(-1, 3), axis=-1)
        assert {tuple(p) for p in found} <= {tuple(p) for p in pixels}
    assert variants == {0.5, 1.0}
    assert weights == {1.0, 2.0, 4.0}


def test_every_pixel_is_drawn_equally_often(examples):
    """The mean over draws is the mean over all possible crops."""
    keys = jax.random.split(jax.random.key(1), 4000)
    whole = dataclasses.replace(SCHEDULE, crop=12)
    mean = lambda key: training.draw(key, examples, whole).halves[0].mean()
    crops = [examples.halves[:, 0, :, c : c + 12] for c in range(3)]
    assert_mean(jax.vmap(mean)(keys), float(jnp.stack(crops).mean()))


def test_a_frames_loss_has_its_weight(examples):
    """The first step's loss is the mean over crops of weight times loss."""
    objective = lambda network, inputs, halves, unit: (
        network * jnp.mean(halves[0]) / unit
    )
    state = training.start(jnp.float32(1.5), SCHEDULE)
    _, value = next(training.run(objective, state, examples, SCHEDULE))
    keys = jax.random.split(jax.random.fold_in(jax.random.key(0), 0), SCHEDULE.batch)
    drawn = [training.draw(key, examples, SCHEDULE) for key in keys]
    wanted = [1.5 * c.weight * c.halves[0].mean() / c.unit for c in drawn]
    np.testing.assert_allclose(value, np.mean(wanted), rtol=1e-5)


def fit(examples, steps):
    """Return an objective, its network, and a run that learns a factor."""

    def objective(network, inputs, halves, unit):
        return jnp.mean(jnp.square(network["scale"] * inputs["full"] - halves[0]))

    network = {"scale": jnp.ones((), jnp.float32)}
    state = training.start(network, SCHEDULE)
    return objective, network, training.run(objective, state, examples, SCHEDULE)


def test_a_resumed_run_equals_one_without_interruption(examples, tmp_path):
    objective, network, run = fit(examples, 6)
    states = [state for state, _ in run]
    assert [int(s.step) for s in states] == [1, 2, 3, 4, 5, 6]
    path = checkpoints.save(tmp_path / "state.safetensors", states[2])
    middle = checkpoints.load(path, training.start(network, SCHEDULE))
    *_, (last, _) = training.run(objective, middle, examples, SCHEDULE)
    for a, b in zip(jax.tree.leaves(last), jax.tree.leaves(states[-1]), strict=True):
        np.testing.assert_array_equal(a, b)
    done = training.run(objective, last, examples, SCHEDULE)
    assert list(done) == []


def test_crops_must_fit(examples):
    schedule = dataclasses.replace(SCHEDULE, crop=13)
    state = training.start({"scale": jnp.ones(())}, schedule)
    with pytest.raises(ValueError, match=r"crops of 13 do not fit frames of \(12, 14"):
        next(training.run(lambda *_: 0.0, state, examples, schedule))


def test_evaluate_takes_the_first_variant(examples):
    objective = lambda network, inputs, halves, unit: jnp.mean(
        jnp.square(network * inputs["full"] - halves[0]) * unit
    )
    found = training.evaluate(objective, jnp.float32(2), examples)
    wanted = np.square(np.asarray(examples.halves[:, 0])).mean((1, 2, 3))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_log_l2_matches_its_equation(rng):
    """NJS eq. 14: the squared mean of the channels, not the mean of their squares."""
    image, reference = rng.random((2, 5, 6, 3)) * 3 - 0.5
    tau = lambda v: np.sign(v) * np.log(1 + abs(v))
    wanted = 0
    for i, j in np.ndindex(5, 6):
        a, r = tau(image[i, j]), tau(reference[i, j])
        wanted += ((a - r) ** 2).mean() / (r.mean() ** 2 + 0.01) / 30
    found = losses.log_l2(jnp.asarray(image), jnp.asarray(reference))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_relative_l2_matches_its_equation(rng):
    """Each half is the target, with the weight of the other."""
    image, a, b = rng.random((3, 5, 6, 3)) * 3 - 0.5
    wanted = 0
    for i, j in np.ndindex(5, 6):
        for target, other in ((a, b), (b, a)):
            weight = 1 / (other[i, j].mean() ** 2 + 0.01)
            wanted += ((image[i, j] - target[i, j]) ** 2).mean() * weight / 60
    halves = jnp.asarray(np.stack([a, b]))
    found = losses.relative_l2(jnp.asarray(image), halves)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


LOSSES = {
    "relative L2 of halves": (losses.relative_l2, True),
    "relative L2 of their mean": (recipes.of_mean(rel_l2), False),
    "log-L2": (recipes.of_mean(losses.log_l2), False),
    "SMAPE": (recipes.of_mean(smape), False),
}


@pytest.mark.parametrize("name", LOSSES)
def test_what_a_noisy_reference_does_to_a_loss(name, rng):
    """Where the gradient vanishes with clean references, does it with noisy ones?

    The image is a multiple of the truth, and the loss that of the multiple: its minimum
    is at one. The weights of a noisy reference's own radiance, logarithms and absolute
    values move it; halves that weight each other do not.
    """
    loss, unbiased = LOSSES[name]
    truth = jnp.asarray(rng.random((6, 6, 3)))
    of_scale = lambda scale, halves: loss(scale * truth, halves)
    noise = jax.random.exponential(jax.random.key(0), (4000, 2, 6, 6, 3)) - 1
    noisy = lambda e: truth[None] + 0.7 * e
    slope = jax.jit(jax.vmap(lambda e: jax.grad(of_scale)(1.0, noisy(e))))
    if unbiased:
        assert_mean(slope(noise), 0.0)
        # Elsewhere it points to the minimum.
        assert jax.grad(of_scale)(1.5, noisy(noise[0])) > 0
    else:
        with pytest.raises(AssertionError):
            assert_mean(slope(noise), 0.0)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A light mixing network as its file and card."""
    path = tmp_path_factory.mktemp("network") / "pd.safetensors"
    checkpoints.save(path, networks.MixingNetwork(jax.random.key(0), size="light"))
    path.with_suffix(".json").write_text('{"network": {"size": "light"}}')
    return path


def test_a_network_comes_back(saved, rng):
    network = recipes.load_network(RECIPES["pd"], saved)
    drawn = networks.MixingNetwork(jax.random.key(0), size="light")
    for a, b in zip(jax.tree.leaves(network), jax.tree.leaves(drawn), strict=True):
        np.testing.assert_array_equal(a, b)
    images = jnp.asarray(rng.random((4, 5, 5, 3)), jnp.float32)
    np.testing.assert_array_equal(network(*images), drawn(*images))


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ("remove", "no such file of parameters"),
        ("truncate", "not a safetensors file"),
        ("card", "not the card of a network"),
        ("no card", "no such card"),
        ("size", r"blocks/0/0/bias/value is float32\[24\], expected float32\[48\]"),
        ("other", r"does not fit the network: .* is float32\[24\], expected nothing"),
    ],
)
def test_files_that_do_not_fit_are_rejected(saved, tmp_path, harm, message):
    path = pathlib.Path(shutil.copy(saved, tmp_path))
    card = pathlib.Path(shutil.copy(saved.with_suffix(".json"), tmp_path))
    if harm == "remove":
        path.unlink()
    elif harm == "truncate":
        path.write_bytes(path.read_bytes()[:1000])
    elif harm == "card":
        card.write_text('{"steps": 3')
    elif harm == "no card":
        card.unlink()
    elif harm == "size":
        card.write_text('{"network": {"size": "full"}}')
    with pytest.raises(ValueError, match=message) as error:
        recipes.load_network(RECIPES["njs" if harm == "other" else "pd"], path)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_network():
    with pytest.raises(
        ValueError, match="network 'gan'; there are dsc, dsc-photons, neural-ensemble"
    ):
        recipes.shipped("gan")
    with pytest.raises(
        ValueError,
        match="network 'kernels'; there are dsc, dsc-photons, neural-ensemble",
    ):
        recipes.shipped("kernels")


def test_a_kernel_predictor_needs_features(glass_frame):
    with pytest.raises(ValueError, match="needs a normalised frame"):
        kernel_predicting.neural_inputs(glass_frame)
    bare = glass_frame.normalised()
    bare = bare._replace(buffers=bare.buffers._replace(depth=None))
    with pytest.raises(ValueError, match="a kernel predictor needs depth"):
        kernel_predicting.neural_inputs(bare)


# Inputs by name: their channels, and the power of the unit that they are measured in.
INPUTS = {
    "njs": {"unbiased": (3, 1), "biased_a": (3, 1), "biased_b": (3, 1)}
    | {"variance": (3, 2)},
    "dsc": {"prior": (3, 1), "unbiased": (3, 1), "biased": (3, 1)}
    | {"variance": (1, 2), "mse": (1, 2)},
    "pd": {"unbiased": (3, 1), "biased": (3, 1), "variance": (3, 2), "sure": (3, 2)},
    "kernels": {"noisy": (3, 1), "variance": (3, 2)}
    | {"albedo": (3, 0), "normal": (3, 0), "depth": (1, 0)},
}


@pytest.mark.parametrize("name", INPUTS)
def test_a_unit_undoes_the_brightness_of_a_scene(name, rng):
    recipe, unit = RECIPES[name], jnp.asarray(3.0)
    network = recipe.make(jax.random.key(0), size="light")
    inputs, bright = {}, {}
    for key, (channels, power) in INPUTS[name].items():
        inputs[key] = jnp.asarray(rng.random((9, 10, channels)))
        bright[key] = 3.0**power * inputs[key]
    combine = jax.jit(recipe.combine)
    found = combine(network, recipes.in_unit(bright, unit))
    np.testing.assert_allclose(found, combine(network, inputs), rtol=1e-9)


def test_shipped_files_are_small_and_described():
    weights = list(recipes.WEIGHTS.glob("*.safetensors"))
    assert {w.stem for w in weights} == {*SHIPPED, "neural-ensemble"}
    assert sum(w.stat().st_size for w in weights) < 10e6
    for file in weights:
        card = recipes.read_card(file)
        assert card["method"] == file.stem
        assert recipes.options_of(card).keys() >= RECIPES[file.stem].options.keys()
        losses = card["losses"]
        assert card["best_step"] in losses["step"]
        best = losses["validation"][losses["step"].index(card["best_step"])]
        assert best == min(losses["validation"])
        assert best < losses["validation"][0]
