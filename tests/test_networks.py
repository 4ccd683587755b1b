"""Networks: convolutions, sizes, reach, and the combiners that use them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.test_util import check_grads

from jscomb import double_shrinkage, ensemble, james_stein, progressive
from jscomb.denoisers import kernel_predicting
from jscomb.frame import Estimate
from jscomb.learning import networks
from jscomb.numerics.convolution import convolve, convolve_doubled, doubled
from jscomb.numerics.kernels import Kernels
from jscomb.numerics.luminance import median_luminance
from jscomb.numerics.sure import monte_carlo_sure


def key():
    """Return the same key, as if unused."""
    return jax.random.key(1)


def parameters_of(network) -> int:
    """Count the numbers of a network."""
    return sum(p.size for p in jax.tree.leaves(network))


def random_convolution(rng, size=3, inputs=2, outputs=3):
    """Return a convolution with a bias, in float64."""
    convolution = networks.Convolution(key(), inputs, outputs, size=size)
    draw = lambda leaf: jnp.asarray(rng.normal(size=leaf.shape))
    return jax.tree.map(draw, convolution)


@pytest.mark.parametrize("size", [1, 3, 5])
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (17, 4)])
def test_convolution_matches_loops(size, shape, rng):
    convolution, r = random_convolution(rng, size), size // 2
    image = rng.normal(size=(*shape, 2))
    kernel, bias = (np.asarray(p[...]) for p in (convolution.kernel, convolution.bias))
    padded = np.pad(image, ((r, r), (r, r), (0, 0)))
    wanted = np.zeros((*shape, 3))
    for i, j in np.ndindex(*shape):
        near = padded[i : i + size, j : j + size]
        wanted[i, j] = np.einsum("ijc,ijcd->d", near, kernel) + bias
    run = jax.jit(
        lambda image, inner: convolution(image, inner=inner), static_argnums=1
    )
    np.testing.assert_allclose(run(image, False), wanted, rtol=1e-12, atol=1e-12)
    if shape[0] > 2 * r:
        np.testing.assert_allclose(
            run(image, True), wanted[r : shape[0] - r], atol=1e-12
        )


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (7, 4)])
def test_convolving_a_doubled_image(shape, rng):
    """Is convolving the repeated pixels; also its derivatives, in both modes."""
    draw = lambda *sizes: jnp.asarray(rng.normal(size=sizes))
    image, kernel = draw(*shape, 2), draw(3, 3, 2, 3)
    plain = lambda image, kernel: convolve(doubled(image), kernel, rows=1)
    repeated = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)
    np.testing.assert_array_equal(doubled(image), repeated)
    made, pull = jax.vjp(convolve_doubled, image, kernel)
    wanted, wanted_pull = jax.vjp(plain, image, kernel)
    np.testing.assert_allclose(made, wanted, rtol=1e-12, atol=1e-12)
    back = draw(*made.shape)
    for one, other in zip(pull(back), wanted_pull(back), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)
    check_grads(jax.jit(convolve_doubled), (image, kernel), 2)


@pytest.mark.parametrize("size", [1, 3, 5])
def test_convolution_derivatives(size, rng):
    """Our derivative in the kernel equals XLA's, under vmap and in both modes."""
    convolution = random_convolution(rng, size)
    images = jnp.asarray(rng.normal(size=(4, 19, 6, 2)))

    def ours(convolution, images):
        return jnp.sum(jnp.sin(jax.vmap(convolution)(images)))

    def xla(convolution, images):
        kernel, bias = convolution.kernel[...], convolution.bias[...]
        numbers = ("NHWC", "HWIO", "NHWC")
        out = lax.conv_general_dilated(
            images, kernel, (1, 1), "SAME", dimension_numbers=numbers
        )
        return jnp.sum(jnp.sin(out + bias.reshape(1, 1, 1, -1)))

    at = convolution, images
    for found, wanted in zip(
        jax.tree.leaves(jax.jit(jax.grad(ours, (0, 1)))(*at)),
        jax.tree.leaves(jax.jit(jax.grad(xla, (0, 1)))(*at)),
        strict=True,
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-12)
    check_grads(jax.jit(ours), (convolution, images[:1, :9]), order=2)


@pytest.mark.parametrize("shape", [(1, 1), (4, 8), (5, 7), (9, 1)])
def test_unet_of_any_size(shape, rng):
    """An image that is not whole blocks is padded with zeros."""
    network = networks.UNet(key(), 2, size="light")
    net = jax.jit(lambda image: network(image))
    image = rng.random((*shape, 2))
    out = net(image)
    assert out.shape == (*shape, 16)
    pad = [(0, -n % 4) for n in shape]
    padded = net(np.pad(image, [*pad, (0, 0)]))
    np.testing.assert_allclose(out, padded[: shape[0], : shape[1]], rtol=1e-12)


def transparent(rng, network):
    """The network in float64 with positive weights, so that no ReLU blocks a signal."""
    draw = lambda p: jnp.asarray(
        rng.uniform(0.5, 1.5, p.shape) / max(p[..., 0].size, 1)
    )
    weights = lambda p: draw(p) if p.ndim == 4 else jnp.zeros(p.shape)
    return jax.tree.map(weights, network)


def outputs(kernels):
    """Weights of every pixel's window."""
    pad = [(kernels.reach, kernels.reach), (0, 0), (0, 0)]
    return kernels.head(jnp.pad(kernels.features, pad))


def njs_outputs(network, image):
    """Weights and alpha."""
    kernels, share = network(image, image, image, image)
    return jnp.concatenate([outputs(kernels), share], axis=-1)


def dsc_outputs(network, image):
    """Weights, and the error of the prior."""
    kernels, prior_mse = network(*3 * [image], *2 * [image[..., :1]])
    return jnp.concatenate([outputs(kernels), prior_mse], axis=-1)


def ensemble_of(image):
    """An image as what an ensemble's network sees of two bases."""
    grey, two = image[..., :1], jnp.stack([image, 2 * image])
    one = jnp.ones_like(two[..., :1])
    guides = image, grey, jnp.zeros((*grey.shape[:2], 7)), 0 * image, 1 + 0 * grey
    return ensemble.Candidates(*guides, two, two, one / 2, two[..., :2], one > 0)


REACHES = {
    "body": (lambda: networks.UNet(key(), 3, size="light"), lambda n, i: n(i)),
    "njs": (
        lambda: networks.JamesSteinNetwork(key(), window=3, size="light"),
        njs_outputs,
    ),
    "dsc": (
        lambda: networks.ShrinkageNetwork(key(), window=3, size="light"),
        dsc_outputs,
    ),
    "pd": (
        lambda: networks.MixingNetwork(key(), size="light"),
        lambda n, i: n(i, 0 * i, i, i).reshape(*i.shape[:2], 9),
    ),
    "ensemble": (
        lambda: waking(networks.EnsembleNetwork(key(), size="light")),
        lambda n, i: n(ensemble_of(i)).sum(axis=0),
    ),
    "kernels": (
        lambda: networks.KernelPredictor(key(), features=3, window=3, size="light"),
        lambda n, i: outputs(n(i, i, i)),
    ),
}


@pytest.mark.parametrize("name", REACHES)
def test_reach_is_exact(name, rng):
    """A pixel changes outputs as far as the reach, and none beyond.

    Wherever it is in a block; it is the only one that is not black, so that it is the
    maximum wherever it is pooled.
    """
    make, of = REACHES[name]
    network = transparent(rng, make())
    multiple, reach = network.multiple, network.reach
    start = multiple * (reach // multiple + 1)
    black = jnp.zeros((2 * start + multiple, 2 * start + multiple, 3))
    apply = jax.jit(of)
    before, farthest = apply(network, black), []
    for row in range(start, start + multiple):
        column = 2 * start + multiple - 1 - row
        after = apply(network, black.at[row, column].set(1e3))
        changed = np.argwhere(np.any(np.asarray(after != before), axis=-1))
        distances = np.abs(changed - [row, column]).max(axis=0)
        farthest.append(distances)
    np.testing.assert_array_equal(np.max(farthest, axis=0), [reach, reach])


def test_sizes_are_the_papers():
    counted = parameters_of(networks.JamesSteinNetwork(key()))
    assert 0.53e6 < counted < 0.55e6  # NJS: about 0.54 million
    shapes = jax.tree.map(np.shape, networks.MixingNetwork(key()))
    assert shapes.first.kernel.get_value() == (5, 5, 18, 48)
    assert shapes.last.kernel.get_value() == (3, 3, 48, 9)
    shrinkage = networks.ShrinkageNetwork(key())
    outputs = [c.kernel.shape[-1] for c in (shrinkage.kernels, shrinkage.prior_mse)]
    assert sum(outputs) == 339  # DSC: 2 13^2 + 1
    for kind in (networks.JamesSteinNetwork, networks.MixingNetwork):
        light, full = (parameters_of(kind(key(), size=s)) for s in ("light", "full"))
        assert full / 4 < light < full / 3


def waking(network):
    """Return an ensemble's network whose logits are not zero, as they begin."""
    width = network.exchange.kernel.shape[-1]
    network.logit = networks.Convolution(key(), width, 1, size=1)
    return network


def bases_of(rng, count, size=(12, 8)):
    """Return an ensemble's inputs of a number of bases."""
    draw = lambda c: jnp.asarray(rng.random((*size, c)) + 0.5)
    found = {"unbiased": draw(3), "variance": draw(3) / 10, "depth": draw(1)}
    for k in range(count):
        found |= {f"base{k}": draw(3), f"difference{k}": draw(3) / 10}
        found |= {f"weight{k}": draw(1) / count, f"error{k}": draw(2) / 10}
    return found


def test_an_ensembles_order_does_not_matter(rng):
    network = waking(networks.EnsembleNetwork(key(), size="light"))
    inputs = bases_of(rng, 3)
    turned = dict(inputs)
    for name, image in inputs.items():
        if name[-1].isdigit():
            turned[f"{name[:-1]}{(int(name[-1]) + 1) % 3}"] = image
    apply = jax.jit(ensemble.neural_weights)
    weights = apply(network, inputs)
    assert np.std(weights, axis=(0, 1)).min() > 1e-3  # the network does something
    np.testing.assert_allclose(weights.sum(-1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(
        apply(network, turned), jnp.roll(weights, 1, axis=-1), rtol=1e-10
    )


@pytest.mark.slow
def test_an_unknown_base_is_as_if_it_were_not_there(rng):
    network = waking(networks.EnsembleNetwork(key(), size="light"))
    inputs = bases_of(rng, 2)
    more = inputs | {
        f"{name[:-1]}2": jnp.full_like(image, jnp.nan)
        for name, image in inputs.items()
        if name.endswith("0")
    }
    wanted = ensemble.combine_inputs(network, inputs)
    found = ensemble.combine_inputs(network, more)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_an_untrained_ensemble_is_the_multi_scale_one(glass_frame):
    """But for the floor of its weights, which moves little."""
    frame = glass_frame.normalised()
    y = frame.estimates["oidn"]
    own = Estimate(frame.color, jnp.stack([h.color for h in frame.halves()]))
    given = {"oidn": y, "path-tracing": own}
    network = networks.EnsembleNetwork(key(), size="light")
    found = ensemble.neural_combine_frame(network, frame, given)
    wanted = ensemble.combine_frame(frame, given)
    scale = jnp.square(wanted.image) + 0.01
    moved = jnp.mean(jnp.square(found.image - wanted.image) / scale)
    between = jnp.mean(jnp.square(y.image - frame.color) / scale)
    assert moved < 1e-3 * between


def stub_kernels(weights, window):
    """Return a network with the same weights at every pixel."""
    shape = lambda f: (*f.shape[:2], len(weights))
    head = lambda f: jnp.broadcast_to(jnp.asarray(weights, f.dtype), shape(f))
    return lambda image: Kernels(image, head, 0, window)


@pytest.fixture
def images(glass_frame):
    """Return x, y, y_a, y_b and variance, float64."""
    y = glass_frame.estimates["oidn"]
    given = glass_frame.color, y.image, *y.halves, glass_frame.variance
    return [i.astype(jnp.float64) for i in given]


def test_equal_weights_are_the_estimator_without_a_network(images):
    x, _, a, b, v = images
    equal = stub_kernels(np.ones(225), 15)

    def network(x, v, a, b):
        return james_stein.Parameters(equal(x), jnp.full_like(x[..., :1], 0.25))

    @jax.jit
    def both(x, a, b, v):
        pooled = james_stein.smooth_variance(v, window=15)
        wanted = james_stein.combine(x, 0.25 * a + 0.75 * b, pooled)
        return james_stein.neural_combine(network, x, a, b, v), wanted

    found, wanted = both(x, a, b, v)
    np.testing.assert_allclose(found, wanted, rtol=1e-10)


@pytest.mark.parametrize("form", ["quotient", "direct"])
def test_training_begins_with_a_gradient_at_every_pixel(form, images):
    """Without its limits alpha has one, in both forms."""
    x, y, _, _, v = images
    unit = median_luminance(x)
    x, y, v = x / unit, y / unit, v / unit**2
    network = networks.MixingNetwork(key(), size="light", form=form)
    outputs = network(x, y, v, v)
    activate = progressive.FORMS[form]

    @jax.jit
    def share(limit_outputs):
        slopes = jax.grad(lambda o: activate(o, limit=False).sum())(limit_outputs)
        return jnp.mean(jnp.any(slopes != 0, axis=2))

    assert share(outputs) == 1.0
    if form == "quotient":  # begins with denominators about one
        assert jnp.mean(outputs[:, :, 2] > 1e-3) > 0.5


def test_the_dual_form_blends_the_crossed_halves_by_the_networks_share(images):
    x, _, a, b, v = images
    x_b = 1.1 * x[::-1]
    equal = stub_kernels(np.ones(225), 15)
    network = lambda x, v, a, b: james_stein.Parameters(
        equal(x), jnp.full_like(x[..., :1], 0.25)
    )

    @jax.jit
    def both(x_a, x_b, a, b, v):
        pooled = james_stein.smooth_variance(v, window=15)
        wanted = james_stein.combine_dual(x_a, x_b, a, b, pooled, share=0.25)
        dual = james_stein.neural_combine_dual
        return dual(network, x_a, x_b, a, b, v), wanted

    found, wanted = both(x, x_b, a, b, v)
    np.testing.assert_allclose(found, wanted, rtol=1e-10)


def test_unit_kernels_are_double_shrinkage_of_single_pixels(images):
    x, y, p, _, v = images
    one, eta = v.mean(-1, keepdims=True), jnp.full_like(v[..., :1], 0.3)
    delta = np.zeros(169)
    delta[84] = 1
    both = stub_kernels(np.concatenate([delta, delta]), 13)

    def network(p, u, b, v, m):
        return double_shrinkage.Filters(both(u), eta)

    found = double_shrinkage.neural_combine(network, p, x, y, one, one / 3)
    # The network's error of the prior is that of normalised images.
    square = jnp.square(median_luminance(x))
    wanted = double_shrinkage.combine(p, x, y, one, one / 3, square * eta)
    np.testing.assert_allclose(found, wanted, rtol=1e-10)


def test_mixing_is_what_the_network_says(images):
    x, y, _, _, v = images
    outputs = jnp.stack([jnp.full_like(x, f) for f in (0.8, 0.2, 2.0)], axis=2)
    found = progressive.neural_combine(
        lambda x, y, v, s: outputs, x, y, v, v, bound=False
    )
    np.testing.assert_allclose(found, 0.7 * x + 0.3 * y, rtol=1e-12)


NETWORKS = {
    "njs": (
        networks.JamesSteinNetwork,
        lambda n, x, y, v: james_stein.neural_combine(n, x, y, 0.9 * y, v),
    ),
    "dsc": (
        networks.ShrinkageNetwork,
        lambda n, x, y, v: double_shrinkage.neural_combine(
            n, (x + y) / 2, x, y, v[..., :1], v[..., :1] / 2
        ),
    ),
    "pd": (
        networks.MixingNetwork,
        lambda n, x, y, v: progressive.neural_combine(n, x, y, v, v / 2),
    ),
    "pd, direct": (
        functools.partial(networks.MixingNetwork, form="direct"),
        lambda n, x, y, v: progressive.neural_combine(n, x, y, v, v / 2, bound=False),
    ),
    "ensemble": (
        lambda key, size: waking(networks.EnsembleNetwork(key, size=size)),
        lambda n, x, y, v: ensemble.neural_combine(
            n, *3 * [jnp.stack([x, y, 0.9 * y])], 1.1 * x, 0.9 * x, v
        ),
    ),
    "kernels": (
        networks.KernelPredictor,
        lambda n, x, y, v: kernel_predicting.denoise(
            n, x, v, jnp.full((*x.shape[:2], 7), 0.3, x.dtype)
        ),
    ),
}


@pytest.fixture(scope="module", params=NETWORKS)
def neural(request):
    """Return a light network and its combiner, compiled once, with its gradient."""
    kind, combine = NETWORKS[request.param]
    network = kind(key(), size="light")
    both = lambda n, *images: jnp.sum(combine(n, *images))
    gradient = jax.jit(jax.value_and_grad(both, argnums=(0, 1, 2, 3)))
    return network, jax.jit(combine), gradient


def hard_cases():
    """Return x, y and variance that break careless programs."""
    rng = np.random.default_rng(3)
    x, y, v = rng.random((3, 12, 13, 3)).astype(np.float32)
    firefly = x.copy()
    firefly[4, 5] = 1e6
    certain = np.zeros_like(v)
    square = np.where(firefly > 1, 1e12, v).astype(np.float32)
    bad, bad_v = x.copy(), v.copy()
    bad[3, 4, 1], bad_v[6, 6, 0] = np.nan, np.inf
    small = np.float32(1e-8)
    return {
        "firefly": (firefly, y, square),
        "dark": (small * x, small * y, small**2 * v),
        "bright": (1 / small * x, 1 / small * y, 1 / small**2 * v),
        "certain": (x, y, certain),
        "same": (x, x, v),
        "invalid": (bad, y, bad_v),
        "black": (0 * x, 0 * y, 0 * v),
    }


@pytest.mark.parametrize("case", hard_cases())
def test_finite_at_hard_cases(neural, case):
    """The image, and the gradients in it and in every parameter."""
    network, combine, gradient = neural
    images = [jnp.asarray(i) for i in hard_cases()[case]]
    assert np.isfinite(combine(network, *images)).all()
    value, gradients = gradient(network, *images)
    assert np.isfinite(value)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))


@pytest.mark.parametrize("size", [(1, 1), (1, 6), (9, 2)])
def test_any_size(neural, size, rng):
    network, combine, _ = neural
    images = [jnp.asarray(rng.random((*size, 3)), jnp.float32) for _ in range(3)]
    out = combine(network, *images)
    assert out.shape == (*size, 3)
    assert np.isfinite(out).all()


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_equivariant(neural, scale, glass_frame):
    network, combine, _ = neural
    x, y, v = (
        i[20:44, 20:44].astype(jnp.float64)
        for i in (
            glass_frame.color,
            glass_frame.estimates["oidn"].image,
            glass_frame.variance,
        )
    )
    found = combine(network, scale * x, scale * y, scale**2 * v)
    np.testing.assert_allclose(found, scale * combine(network, x, y, v), rtol=1e-8)


def test_gradients_reach_every_parameter(neural, glass_frame):
    network, _, gradient = neural
    # Of the size of the hard cases, so that it is their program.
    images = [
        i[26:38, 20:33]
        for i in (
            glass_frame.color,
            glass_frame.estimates["oidn"].image,
            glass_frame.variance,
        )
    ]
    _, (of_network, *_) = gradient(network, *images)
    for leaf in jax.tree.leaves(of_network):
        assert np.any(np.asarray(leaf) != 0)


def test_sure_of_a_network(glass_frame):
    """Forward derivatives go through the kernels' strips and the convolutions."""
    network = networks.KernelPredictor(key(), size="light")
    cut = lambda i: i[:12, :12].astype(jnp.float64)
    x, v = cut(glass_frame.color), cut(glass_frame.variance)
    features = cut(
        jnp.concatenate(
            [glass_frame.albedo, glass_frame.normal, glass_frame.depth], axis=-1
        )
    )
    denoise = jax.jit(
        lambda x: kernel_predicting.denoise_normalised(network, x, v, features)
    )
    found = jax.jit(lambda x, v: monte_carlo_sure(key(), denoise, x, v))(x, v)
    deviation = jnp.sqrt(v) * jax.random.rademacher(
        jax.random.split(key())[0], x.shape, x.dtype
    )
    step = 1e-6
    moved = (denoise(x + step * deviation) - denoise(x - step * deviation)) / (2 * step)
    np.testing.assert_allclose(
        found.divergence, deviation * moved, rtol=1e-4, atol=1e-8
    )
