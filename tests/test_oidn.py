"""Open Image Denoise behind its guard: real filter, real frames, ugly pixels."""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jscomb import exr, metrics
from jscomb.denoisers import oidn
from jscomb.denoisers.oidn import (
    _denoise,
    _filter,
    _frame,
    _host,
    _network,
    _tuning,
    _weights,
)
from jscomb.denoisers.oidn._models import MODELS, Model
from jscomb.frame import Package, make_frame
from jscomb.metrics import rel_l2
from jscomb.numerics import sure
from tests.conftest import DATA


@pytest.fixture(scope="module")
def frame(glass_frame):
    """The crop, normalised."""
    return glass_frame.normalised()


@pytest.fixture(scope="module")
def denoised(frame):
    return oidn.denoise_frame(frame)


def test_the_stored_image_of_a_crop_was_denoised_whole():
    """It differs from one made of the crop at the border alone (tests/data/README)."""
    crop = exr.read_frame(DATA / "cornell-box-64.exr").normalised()
    reference, difference = crop.reference
    ratios = []
    for border in (0, 4):
        inner = slice(border, 64 - border)
        at = lambda image, inner=inner: image[inner, inner]
        stored, anew = (
            rel_l2(at(made.image), at(reference), half_difference=at(difference))
            for made in (crop.estimates["oidn"], oidn.denoise_frame(crop))
        )
        ratios.append(float(stored / anew))
    assert ratios[0] < 0.5
    assert 0.9 < ratios[1] < 1.15


def test_lowers_the_error_of_frame_and_halves(glass_frame, frame, denoised):
    reference, error = glass_frame.reference.image, metrics.rel_l2
    made = denoised.scaled(frame.unit)
    assert error(made.image, reference) < 0.3 * error(glass_frame.color, reference)
    for half, image in zip(glass_frame.halves(), made.halves, strict=True):
        assert error(image, reference) < 0.3 * error(half.color, reference)


def test_features_are_used(frame, denoised):
    """Each changes the result; that it gets better is not promised."""
    without = oidn.denoise_frame(frame, variant=oidn.VARIANTS["oidn-color"]).image
    only_albedo = oidn.denoise(frame.color, albedo=frame.albedo)
    assert jnp.abs(only_albedo - without).max() > 1e-3
    assert jnp.abs(denoised.image - only_albedo).max() > 1e-3


def test_frame_without_sub_buffers(frame):
    plain = make_frame(frame.color).normalised()
    assert oidn.denoise_frame(plain).halves is None


def test_another_colour_of_a_frame(frame, denoised):
    """It is denoised with the frame's features, in the frame's unit."""
    made = oidn.denoise_color(frame.color, frame)
    assert relative(made, denoised.image) < 1e-5
    without = oidn.denoise_color(
        frame.color, frame, variant=oidn.VARIANTS["oidn-color"]
    )
    np.testing.assert_array_equal(without, oidn.denoise_normalised(frame.color))
    # The unit is the frame's: a brighter colour comes out brighter.
    np.testing.assert_allclose(
        oidn.denoise_color(2 * frame.color, frame).mean(), 2 * made.mean(), rtol=0.01
    )


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1e6])
def test_scale_equivariant(frame, denoised, scale):
    """The bare filter is not, at radiance 1e-8."""
    scaled = frame.scaled(jnp.float32(scale)).normalised()
    image = oidn.denoise_frame(scaled).scaled(scaled.unit).image
    np.testing.assert_allclose(image, scale * denoised.image, rtol=1e-3)
    features = {"albedo": frame.albedo, "normal": frame.normal}
    image = oidn.denoise(jnp.float32(scale) * frame.color, **features)
    np.testing.assert_allclose(image, scale * denoised.image, rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_pixel_stays_local(frame, denoised, bad):
    """The bare filter spreads an infinite pixel over a third of the image."""
    color = frame.color.at[30, 30, 0].set(bad)
    image = oidn.denoise_color(color, frame)
    assert np.isfinite(image).all()
    far = np.ones((64, 64), bool)
    far[20:41, 20:41] = False
    np.testing.assert_allclose(image[far], denoised.image[far], rtol=0.1, atol=1e-3)


def test_nothing_finite_and_nothing_lit(glass_frame):
    black = jnp.zeros_like(glass_frame.color)
    for image in (black, black * jnp.nan):
        np.testing.assert_allclose(oidn.denoise(image), 0, atol=1e-4)


def test_holes_are_filled_from_near_to_far():
    image = jnp.ones((9, 9, 3)).at[:, 5:].set(3.0).at[2:7, 2:7].set(jnp.nan)
    filled = _denoise._fill(image)
    assert ((filled >= 1) & (filled <= 3)).all()
    np.testing.assert_allclose(filled[3, 2], 1)
    np.testing.assert_allclose(filled[3, 6], 3)


def test_rejects_bad_input(glass_frame, monkeypatch):
    color = glass_frame.color
    with pytest.raises(ValueError, match=r"color must have shape \[H,W,3\]"):
        oidn.denoise(color[..., :1])
    with pytest.raises(ValueError, match="albedo has shape"):
        oidn.denoise(color, albedo=color[1:])
    with pytest.raises(ValueError, match="takes an albedo, or an albedo and a normal"):
        oidn.denoise(color, normal=color)
    with pytest.raises(ValueError, match="clean needs albedo and normal"):
        oidn.denoise(color, albedo=color, clean=True)
    with pytest.raises(ValueError, match="name must be 'albedo' or 'normal'"):
        oidn.denoise_feature(color, "depth")
    with pytest.raises(ValueError, match=r"normal must have shape \[H,W,3\]"):
        oidn.denoise_feature(color[..., :1], "normal")
    with pytest.raises(ValueError, match="oidn needs a normalised frame"):
        oidn.denoise_frame(glass_frame)
    grey = make_frame(color[..., :1]).normalised()
    with pytest.raises(ValueError, match="oidn needs 3 channels of colour, not 1"):
        oidn.denoise_frame(grey)
    missing = oidn.NEEDS._replace(package=Package("not_installed", "oidn"))
    for module in (_denoise, _frame):
        monkeypatch.setattr(module, "NEEDS", missing)
    monkeypatch.setattr(_frame.Variant, "needs", property(lambda self: missing))
    assert not oidn.available()
    for denoise in (
        lambda: oidn.denoise(color),
        lambda: oidn.denoise_frame(glass_frame.normalised()),
        oidn.pretrained,
    ):
        with pytest.raises(ImportError, match=r'pip install "jscomb\[oidn\]"'):
            denoise()


def test_it_is_a_jax_function(frame, denoised):
    """Compiled, mapped, with both derivatives."""
    run = lambda x: oidn.denoise_color(x, frame)
    x = frame.color
    both = jax.jit(jax.vmap(run))(jnp.stack([x, x[::-1]]))
    y, moved = jax.jit(lambda x, t: jax.jvp(run, (x,), (t,)))(x, x)
    for made in (jax.jit(run)(x), both[0], y):  # by the filter or the network
        assert relative(made, denoised.image) < 1e-5
    # Scaling the image scales the result, but for the network's own nonlinearity.
    assert rel_l2(moved, y) < 0.05
    pull = jax.jit(lambda x, t: jax.vjp(run, x)[1](t)[0])
    probe = jax.random.normal(jax.random.key(0), x.shape, jnp.float32)
    np.testing.assert_allclose(
        jnp.vdot(probe, moved), jnp.vdot(pull(x, probe), x), rtol=1e-3
    )


# The network: the same function as the filter.


def images_of(model: Model, frame) -> dict[str, np.ndarray]:
    """A rendering of 37 x 50 pixels in the range of a model."""
    color = frame.color[:37, :50]
    if model.signed:
        color = 2 * color / color.max() - 1
    elif model.bounded:
        color = jnp.minimum(color, 1.0)
    images = {"color": color, "albedo": frame.albedo, "normal": frame.normal}
    return {
        name: np.asarray(images[name][:37, :50], np.float32) for name in model.inputs
    }


def relative(image, wanted) -> float:
    """Relative root mean square difference."""
    return float(np.linalg.norm(image - wanted) / np.linalg.norm(wanted))


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_network_is_the_filter(model, frame):
    """Also where the image is not whole blocks of 16 pixels."""
    images = images_of(model, frame)
    wanted = _host.run(model, images, 0.3)
    made = _filter.apply(_weights.network(model), model, images, 0.3)
    assert relative(made, wanted) < 1e-4


def test_each_network_is_one_model():
    """No two models of the table share one, and none is left out."""
    numbers = [_weights.identify(model).number for model in MODELS]
    assert sorted(numbers) == list(range(len(_weights.trained_networks())))


@pytest.mark.slow
@pytest.mark.parametrize("inputs", [3, 9])
@pytest.mark.parametrize("size", ["small", "large"])
def test_reach_is_exact(inputs, size):
    """Nothing beyond it matters, and something at it does, in the worst place."""
    network = _network.Network(jax.random.key(0), inputs, size=size)
    width = 2 * (network.reach // 16 + 2) * 16
    middle = width // 2
    x = jax.random.uniform(jax.random.key(1), (1, width, inputs))

    def seen(pixel: int):
        one = lambda x: network(x)[0, pixel].sum()
        slope = jax.grad(one)(x)
        return np.flatnonzero(abs(slope[0]).max(-1)) - pixel

    found = [abs(seen(middle + p)).max() for p in (1, 14)]
    assert max(found) == network.reach


@pytest.fixture(scope="module")
def small_network():
    """The fast network of the colour alone, in float64."""
    network = oidn.pretrained(features=(), quality="fast")
    return jax.tree.map(lambda a: a.astype(jnp.float64), network)


@pytest.mark.slow
def test_by_crops_it_is_the_whole(small_network, monkeypatch):
    model = Model()
    x = jax.random.exponential(jax.random.key(1), (300, 230, 3), jnp.float64)
    whole = _filter._apply(small_network, {"color": x}, model=model, exposure=0.18)
    monkeypatch.setattr(_filter, "_WHOLE", 100)
    monkeypatch.setattr(_filter, "_TILE", 32)
    crops = _filter._apply(small_network, {"color": x}, model=model, exposure=0.18)
    np.testing.assert_allclose(crops, whole, rtol=1e-10)


def test_derivatives_in_image_and_weights(small_network):
    x = jax.random.exponential(jax.random.key(1), (5, 18, 3), jnp.float64)
    run = jax.jit(
        lambda network, x: _filter._apply(
            network, {"color": x}, model=Model(), exposure=0.18
        )
    )
    check_grads(lambda x: run(small_network, x), (x,), 1, eps=1e-7)
    check_grads(lambda network: run(network, x), (small_network,), 1, eps=1e-7)


def test_a_network_that_makes_too_much_stays_finite(small_network):
    """As one may on the way of its tuning; also its derivative."""
    strong = jax.tree.map(lambda a: (3 * a).astype(jnp.float32), small_network)
    x = jax.random.exponential(jax.random.key(1), (8, 9, 3), jnp.float32)
    run = lambda x: oidn.denoise_normalised(x, network=strong, quality="fast")
    made, pull = jax.vjp(run, x)
    assert made.max() > 1e6
    assert np.isfinite(made).all()
    assert np.isfinite(pull(jnp.ones_like(made))[0]).all()


@pytest.mark.parametrize("name", _network.CURVES)
def test_curves(name):
    """The inverse is one, both grow, and the slopes are finite from 0 to the top."""
    curve = _network.CURVES[name]
    top = 1.0 if name in ("srgb", "linear") else 65504.0
    y = jnp.concatenate([jnp.zeros(1), jnp.geomspace(1e-9, top, 500)])
    x = curve.forward(y)
    np.testing.assert_allclose(curve.inverse(x), y, rtol=2e-5, atol=1e-12)
    np.testing.assert_allclose(x[-1], 1.0, rtol=1e-5)
    assert (jnp.diff(x) > 0).all()
    for function, at in ((curve.forward, y), (curve.inverse, x)):
        slopes = jax.vmap(jax.grad(function))(at)
        assert (slopes > 0).all()
        assert np.isfinite(slopes).all()


def test_error_of_a_frame_falls_along_its_gradient_in_the_weights(frame):
    """What tuning on a frame needs: a derivative in all 919811 weights."""
    network, r = oidn.pretrained(), frame.reference.image
    guides = {"albedo": frame.albedo, "normal": frame.normal}

    def error(network):
        made = oidn.denoise_normalised(frame.color, **guides, network=network)
        return rel_l2(made.astype(r.dtype), r)

    value, slope = jax.jit(jax.value_and_grad(error))(network)
    square = sum(jnp.sum(s**2) for s in jax.tree.leaves(slope))
    step = 0.01 * value / square
    moved = jax.tree.map(lambda w, s: (w - step * s).astype(w.dtype), network, slope)
    fall = (error(network) - error(moved)) / (0.01 * value)
    assert 0.9 < fall < 1.1


# Derivatives, and what stands on them.


@pytest.mark.parametrize("noise", [0.01, 0.05, 0.2])
def test_sure_is_the_true_error(frame, noise):
    """Of known truth with Gaussian noise, within five standard errors."""
    mu = jnp.maximum(frame.reference.image, 0.0).astype(jnp.float32)
    variance = (noise * (mu + 0.1)) ** 2
    run = jax.jit(
        lambda x: oidn.denoise_normalised(x, albedo=frame.albedo, normal=frame.normal)
    )
    weight = 1 / (mu + 0.1) ** 2

    @jax.jit
    def difference(key):
        draw, probe = jax.random.split(key)
        x = mu + jnp.sqrt(variance) * jax.random.normal(draw, mu.shape, mu.dtype)
        risk = sure.monte_carlo_sure(probe, run, x, variance)
        truth = jnp.square(risk.denoised - mu)
        mean = lambda square: jnp.mean(weight * square)
        return mean(risk.squared_error - truth), mean(truth)

    keys = jax.random.split(jax.random.key(3), 12)
    off, truth = np.array([difference(key) for key in keys]).T
    assert abs(off.mean()) < 5 * off.std(ddof=1) / len(off) ** 0.5
    assert off.std(ddof=1) / len(off) ** 0.5 < 0.2 * truth.mean()  # it says something


def test_sure_of_it_is_that_of_the_frame(frame):
    """The mean estimate is the mean error, to a few percent, without a reference."""
    r, noise = frame.reference
    run = lambda x: oidn.denoise_color(x, frame)
    risk = sure.monte_carlo_sure(
        jax.random.key(0), run, frame.color, frame.variance, probes=2
    )
    weight = 1 / (jnp.mean(r, axis=-1, keepdims=True) ** 2 + 1)
    mean = lambda square: float(jnp.mean(weight * square))
    truth = mean((risk.denoised - r) ** 2 - noise**2 / 4)
    assert 0.9 * truth < mean(risk.squared_error) < 1.1 * truth


# Versions that cannot be read, and damaged stores.


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """Nothing found yet, and an empty cache of the user."""
    caches = _weights._identified, _weights.trained_networks, _weights._warn_once
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for cached in caches:
        cached.cache_clear()
    yield tmp_path / "jscomb" / "oidn.json"
    for cached in caches:
        cached.cache_clear()


def test_what_was_found_is_kept(fresh):
    model = Model(quality="fast")
    found = _weights.identify(model)
    ((kept,),) = (store.values() for store in json.loads(fresh.read_text()).values())
    assert tuple(kept) == found
    _weights._identified.cache_clear()
    fresh.write_text(fresh.read_text().replace(str(found.error), "0.5"))
    assert _weights.identify(model).error == 0.5  # read, not compared again
    (version,) = json.loads(fresh.read_text())
    for damaged in ("", "[]", "{", f'{{"{version}": [1]}}', f'{{"{version}": 2}}'):
        _weights._identified.cache_clear()
        fresh.write_text(damaged)
        assert _weights.identify(model).number == found.number


def test_a_version_that_cannot_be_read(fresh, frame, denoised, monkeypatch):
    """The filter on the host does it, says so once; its derivative is a difference."""
    run = lambda x: oidn.denoise_color(x, frame)
    probe = jax.random.normal(jax.random.key(0), frame.color.shape, jnp.float32)
    tangent = 0.1 * frame.color * probe
    _, wanted = jax.jvp(run, (frame.color,), (tangent,))
    for cached in (_weights._identified, _weights.trained_networks):
        cached.cache_clear()
    fresh.unlink()
    monkeypatch.setattr(_weights, "_libraries", list)
    with pytest.warns(UserWarning, match="cannot be read: Open Image Denoise runs on"):
        image = run(frame.color)
    assert relative(image, denoised.image) < 1e-5
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, moved = jax.jvp(run, (frame.color,), (tangent,))
    assert relative(moved, wanted) < 0.05
    for scale in (1e-4, 1e4):
        _, other = jax.jvp(run, (frame.color,), (scale * tangent,))
        np.testing.assert_allclose(other / scale, moved, rtol=0.02, atol=2e-3)
    with pytest.raises(RuntimeError, match="no weights that can be read"):
        oidn.pretrained()


def test_what_is_no_container_is_skipped():
    data = _weights._libraries()[0].read_bytes()
    start = data.find(b"\xd7\x41\x02\x00")
    whole = data[start : start + 2_000_000]
    assert len(_weights.read_containers(b"ab" + whole)) == 1
    for bad in (
        b"",
        b"\xd7\x41\x02",
        whole[:1000],  # its table lies behind the end
        whole[:4] + b"\xff" * 8 + whole[12:],  # and here far behind
        b"\xd7\x41\x02\x00" + b"\x0c" + bytes(7) + bytes(4),  # no arrays
        whole.replace(b"oihw", b"ohwi"),
    ):
        assert _weights.read_containers(bad) == []
    assert _network.from_arrays({"a.weight": np.ones((3, 3, 3, 3))}) is None
    assert _network.from_arrays({"a.weight": np.ones(3), "a.bias": np.ones(3)}) is None


# Features alone.


def test_a_feature_is_denoised(frame):
    """Closer to the clean one; holes are filled, and it stays in its range."""
    noise = 0.1 * jax.random.normal(jax.random.key(0), frame.albedo.shape, jnp.float32)
    for name, image, low in (("albedo", frame.albedo, 0), ("normal", frame.normal, -1)):
        noisy = (image + noise).astype(jnp.float32)
        made = oidn.denoise_feature(noisy.at[5:8, 5:8].set(jnp.nan), name)
        assert relative(made, image) < 0.7 * relative(noisy, image)
        assert ((made >= low) & (made <= 1)).all()


# Variants.


@pytest.fixture(scope="module")
def family(frame):
    """All variants of the crop, by name."""
    made = oidn.denoise_variants(frame, list(oidn.VARIANTS.values()))
    return dict(zip(oidn.VARIANTS, made, strict=True))


def test_every_variant_lowers_the_error_and_differs(frame, family):
    r = frame.reference.image
    for name, made in family.items():
        assert rel_l2(made.image, r) < 0.4 * rel_l2(frame.color, r), name
        for half, image in zip(frame.halves(), made.halves, strict=True):
            assert rel_l2(image, r) < 0.4 * rel_l2(half.color, r), name
        others = [other.image for key, other in family.items() if key != name]
        assert min(relative(made.image, other) for other in others) > 1e-3, name


def test_together_they_are_what_each_is_alone(frame, family):
    for name in ("oidn", "oidn-demodulated", "oidn-clean-turned"):
        alone = oidn.denoise_frame(frame, variant=oidn.VARIANTS[name])
        assert relative(family[name].image, alone.image) < 1e-5
        half = frame.halves()[1]
        made = oidn.denoise_color(half.color, half, variant=oidn.VARIANTS[name])
        assert relative(family[name].halves[1], made) < 1e-5


def test_a_half_uses_its_own_features(frame, family):
    """Changes of the other half's samples leave it as it is."""
    change = lambda b: b.at[len(b) // 2 :].multiply(0.7) if len(b) > 1 else b
    buffers = frame.buffers._replace(
        **{
            name: change(jnp.stack([b, b]) if b.ndim == 3 else b)
            for name in ("color", "albedo", "normal")
            if (b := getattr(frame.buffers, name)) is not None
        }
    )
    names = "oidn", "oidn-demodulated", "oidn-clean-balanced"
    variants = [oidn.VARIANTS[name] for name in names]
    made = oidn.denoise_variants(frame._replace(buffers=buffers), variants)
    for name, estimate in zip(names, made, strict=True):
        assert relative(estimate.halves[0], family[name].halves[0]) < 1e-6
        assert relative(estimate.halves[1], family[name].halves[1]) > 1e-3


def test_turned_is_the_mean_of_the_turns(frame, family):
    turns = oidn.denoise_turns(frame)
    assert relative(turns.mean(0), family["oidn-turned"].image) < 1e-5
    assert relative(turns[0], family["oidn"].image) < 1e-5
    image = jnp.arange(2 * 3 * 3.0).reshape(2, 3, 3)
    each = [_frame._turn(image, number) for number in range(8)]
    assert (
        len({(turned.shape, turned.tobytes()) for turned in map(np.array, each)}) == 8
    )
    for number, turned in enumerate(each):
        np.testing.assert_array_equal(_frame._turn_back(turned, number), image)


@pytest.mark.parametrize("albedo", [0.0, 1e-6, 1.0, np.nan])
def test_demodulation_of_black_of_emitters_and_of_holes(frame, albedo):
    """Where the albedo says nothing, the result is that of the colour, not far off."""
    stripe = np.s_[:, :, 20:40]
    buffers = frame.buffers
    color = buffers.color.at[stripe].add(5.0)
    changed = buffers._replace(
        color=color, albedo=buffers.albedo.at[stripe].set(albedo)
    )
    bright = frame._replace(buffers=changed)
    made = oidn.denoise_color(
        bright.color, bright, variant=oidn.VARIANTS["oidn-demodulated"]
    )
    plain = oidn.denoise_color(bright.color, bright, variant=oidn.Variant("none"))
    assert np.isfinite(made).all()
    assert relative(made, plain) < 0.2


def test_what_a_variant_lacks_is_said(frame):
    plain = frame._replace(buffers=frame.buffers._replace(albedo=None, normal=None))
    with pytest.raises(ValueError, match="oidn needs albedo, normal: render with"):
        oidn.denoise_frame(plain, variant=oidn.VARIANTS["oidn-clean"])
    with pytest.raises(ValueError, match="oidn needs albedo: render with"):
        oidn.denoise_color(plain.color, plain, variant=oidn.Variant("albedo"))
    # A normal without an albedo is of no use to the filter.
    normal = frame._replace(buffers=frame.buffers._replace(albedo=None))
    without = oidn.denoise_color(plain.color, plain)
    np.testing.assert_array_equal(oidn.denoise_color(plain.color, normal), without)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (5, 40)])
def test_small_images(shape):
    color = jax.random.exponential(jax.random.key(0), (*shape, 3), jnp.float32)
    albedo = jnp.full_like(color, 0.5)
    tiny = make_frame(color, albedo=albedo, normal=0 * albedo).normalised()
    for made in oidn.denoise_variants(tiny, list(oidn.VARIANTS.values())):
        assert made.image.shape == color.shape
        assert np.isfinite(made.image).all()
    slope = jax.grad(lambda x: oidn.denoise_color(x, tiny).sum())(tiny.color)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("value", [0.0, 1e-8, 1e6, np.inf, np.nan])
def test_derivatives_at_ugly_pixels(frame, value):
    """Of both kinds, at black, at a firefly and at what is no number."""
    x = frame.color.at[10:13, 10:13].set(value).at[40].set(0.0)
    run = lambda x: oidn.denoise_color(x, frame)
    y, moved = jax.jvp(run, (x,), (jnp.ones_like(x),))
    slope = jax.grad(lambda x: run(x).sum())(x)
    for image in (y, moved, slope):
        assert np.isfinite(image).all()


def textured(rng, *, buffers, size=48):
    """A frame of a fine texture, which the denoiser takes for noise, and the truth."""
    truth = np.broadcast_to(
        1 + 0.5 * rng.uniform(-1, 1, (size, size, 1)), (size,) * 2 + (3,)
    )
    noise = 0.2 * (rng.exponential(size=(buffers, *truth.shape)) - 1)
    frame = make_frame(truth + buffers**0.5 * noise).normalised(1.0)
    return frame, jnp.asarray(truth)


def test_tuning_lowers_an_error_that_it_does_not_see(rng):
    """It is given the halves, and judged by the truth."""
    frame, truth = textured(rng, buffers=2)
    error = lambda image: rel_l2(jnp.asarray(image, truth.dtype), truth)
    before = error(oidn.denoise_frame(frame).image)
    after = error(oidn.tune_frame(frame).image)
    assert after < 0.8 * before


def test_a_tuned_half_sees_its_own_samples_alone(rng):
    """Or it would say nothing that is independent of the other half."""
    frame, _ = textured(rng, buffers=4, size=16)
    changed = frame.buffers.color.at[2:].multiply(1.5)
    other = frame._replace(buffers=frame.buffers._replace(color=changed))
    one, two = (oidn.tune_frame(each, steps=2) for each in (frame, other))
    np.testing.assert_array_equal(one.halves[0], two.halves[0])
    for a, b in ((one.image, two.image), (one.halves[1], two.halves[1])):
        assert relative(a, b) > 1e-3
    assert oidn.tune_frame(frame.merged(2), steps=1).halves is None
    with pytest.raises(ValueError, match=r"oidn.tune needs half buffers"):
        oidn.tune(frame.merged(1))


@pytest.mark.parametrize("value", [1e6, np.nan, np.inf])
def test_the_weight_of_tuning_does_not_see_the_target(rng, value):
    """So the loss is unbiased; and one bad pixel of a target leaves all finite."""
    frame, _ = textured(rng, buffers=2, size=16)
    a, b = frame.halves()
    bad = b._replace(
        buffers=b.buffers._replace(color=b.buffers.color.at[0, 3, 4].set(value))
    )
    weights = [_tuning._pair(a, each).weight for each in (b, bad)]
    np.testing.assert_array_equal(*weights)
    color = frame.buffers.color.at[1, 3, 4].set(value)
    ugly = frame._replace(buffers=frame.buffers._replace(color=color))
    network = oidn.tune(ugly, steps=2)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(network))
