"""What is double shrinkage of path tracing and photon mapping worth, at equal time?

    python -m experiments.double_shrinkage.double_shrinkage OUT

Every scene is rendered twice: path tracing and photon mapping for a given time each, to
be used alone, and both for half of it each, to be combined. Three tables:

    error      relative L2, less the reference's noise, with the seconds of sampling
               and of combining
    ablations  double shrinkage with another prior (y*, James-Stein's cross-regressed
               image), or James-Stein in its place
    mse        the photon-mapped image's mean squared error as halves and as radii tell
               it, and the true one: mean over the frame, and over its darkest and
               brightest quarter, by the reference

and OUT/SCENE.png, pictures with maps of k1 and k2.
"""

import dataclasses
import functools
import json
import pathlib
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from tqdm import tqdm

from jscomb import double_shrinkage, ensemble, exr, james_stein, rendering
from jscomb.cli import render_file
from jscomb.denoisers import oidn
from jscomb.features import stack
from jscomb.frame import Frame, Reference
from jscomb.metrics import rel_l2, tone_map
from jscomb.rendering import PHOTONS, Launcher, Pass, Settings
from jscomb.typing import Image

SEED = 10**6  # of the frames at half the time
WHITENED = {"window": 7, "whiten": True}


@dataclasses.dataclass(frozen=True)
class Config:
    """What to render and to measure.

    Attributes:
        out: folder for frames, results and pictures.
        scenes: names of own scenes, or XML files.
        seconds: of sampling, for each method.
        size: width and height in pixels.
        reference_spp: samples a pixel of the reference.
        photons: in each photon pass.
        radius: of the first photon passes; 0 for the default.
        quick: one scene, small and short.
    """

    out: tyro.conf.Positional[pathlib.Path]
    scenes: tuple[str, ...] = ("cornell-caustic", "cornell-glass", "cornell-box")
    seconds: float = 16.0
    size: int = 128
    reference_spp: int = 16384
    photons: int = 200_000
    radius: float = 0.0
    quick: bool = False


def rates(config: Config, scene: str) -> tuple[float, float]:
    """Seconds of one path-traced sample a pixel, and of one photon pass."""
    settings = _settings(config, 4, 8)
    launch = Launcher(scene, settings)
    every = rendering.plan_passes(settings)
    photons = [p for p in every if p.integrator == PHOTONS]
    traced = [Pass("", 1, k, "path") for k in range(9)]
    seconds = []
    for todo in (traced, photons):
        launch(todo[0])
        start = time.perf_counter()
        for one in todo[1:]:
            launch(one)
        seconds.append((time.perf_counter() - start) / (len(todo) - 1))
    return seconds[0], seconds[1]


def _settings(config: Config, spp: int, passes: int, **changes) -> Settings:
    """The settings of one frame."""
    return Settings(
        spp=spp,
        passes=passes,
        size=config.size,
        photons=config.photons,
        radius=config.radius,
        **changes,
    )


def frames(config: Config, scene: str, kept: dict) -> tuple[Frame, Frame, Image]:
    """Frames of the whole and of half the time, and the latter's weighted photons."""
    if "rates" not in kept:
        kept["rates"] = rates(config, scene)
    # The half has two buffers of two samples at least.
    counts = [max(8, 4 * round(config.seconds / s / 4)) for s in kept["rates"]]
    name = pathlib.Path(scene).parent.name if scene.endswith(".xml") else scene
    whole, half = (config.out / f"{name}-{which}.exr" for which in ("whole", "half"))
    if not whole.exists():
        settings = _settings(config, *counts, reference_spp=config.reference_spp)
        render_file(scene, whole, settings)
    weighted = half.with_suffix(".npz")
    if not weighted.exists():
        settings = _settings(config, *(n // 2 for n in counts), seed=SEED)
        partial = half.with_suffix(".partial.npz")
        *_, (_, moments) = rendering.render_steps(scene, settings, partial=partial)
        each = [moments[f"{PHOTONS}{k}"].mean[..., 3:] for k in range(2)]
        frame = rendering.assemble(settings, moments)
        reference = exr.read_frame(whole).reference
        about = rendering.provenance(scene, settings) | {"reference_from": whole.name}
        exr.write_frame(half, frame._replace(reference=reference), provenance=about)
        np.savez(weighted, mean=np.mean(each, axis=0), passes=settings.passes)
        partial.unlink()
    with np.load(weighted) as data:
        mean, number = jnp.asarray(data["mean"], jnp.float32), int(data["passes"])
    kept |= {"spp": counts[0], "passes": counts[1]}
    every = rendering.plan_passes(_settings(config, 4, number))
    radii = [p.radius for p in every if p.integrator == PHOTONS]
    radii = jnp.asarray(radii, mean.dtype)
    photons = exr.read_frame(half).estimates[PHOTONS].image
    bias = double_shrinkage.radius_bias(photons, mean, radii)
    return exr.read_frame(whole), exr.read_frame(half), bias


def methods(whole: Frame, half: Frame) -> dict[str, Callable[[], Image]]:
    """All images by name; those of half the time unless they say alone."""
    u, b = half.color, half.estimates[PHOTONS]
    v = james_stein.robust_variance(half.variance)
    x_a, x_b = (part.color for part in half.halves())
    inputs = lambda: double_shrinkage.make_inputs(half, b)

    def blend() -> Image:
        found = inputs()
        nothing = jnp.zeros_like(found.mse)
        shares = double_shrinkage.factors(found.variance, found.mse, nothing)
        return shares.blend(u, b.image)

    def of_bases() -> Image:
        bases = [
            jnp.stack([i, j])
            for i, j in zip((b.image, *b.halves), (u, x_a, x_b), strict=True)
        ]
        return _ensemble(*bases, x_a, x_b)

    denoised = lambda: oidn.denoise_frame(whole)
    return {
        "path tracing alone": lambda: whole.color,
        "photon mapping alone": lambda: whole.estimates[PHOTONS].image,
        "their mean": lambda: (u + b.image) / 2,
        "inverse error (k1)": blend,
        "james-stein": lambda: _james_stein(
            u, b.image, james_stein.smooth_variance(half.variance)
        ),
        "james-stein, whitened": lambda: _james_stein(u, b.image, v, **WHITENED),
        "ensemble, multi-scale": of_bases,
        "prior": lambda: inputs().prior,
        "double shrinkage": lambda: double_shrinkage.combine_frame(half, b).image,
        "path tracing alone, oidn": lambda: denoised().image,
        "path tracing alone, oidn, james-stein": lambda: _james_stein(
            whole.color,
            whole.estimates["oidn"].image,
            james_stein.robust_variance(whole.variance),
            **WHITENED,
        ),
        "path tracing alone, oidn, double shrinkage": lambda: (
            double_shrinkage.combine_frame(whole, denoised()).image
        ),
    }


_james_stein = jax.jit(james_stein.combine, static_argnames=("window", "whiten"))
_prior = jax.jit(double_shrinkage.radiance_prior, static_argnames="stride")
_ensemble = jax.jit(
    functools.partial(ensemble.combine, solver="multi-scale", filter=False)
)


def ablations(half: Frame) -> dict[str, Image]:
    """Figures 14 and 15: the prior swapped for y*, and the combiner for James-Stein."""
    u, b = half.color, half.estimates[PHOTONS]
    found = double_shrinkage.make_inputs(half, b)
    v = james_stein.robust_variance(half.variance)
    a_frame, b_frame = half.halves()
    halves = jax.jit(james_stein.cross_regression, static_argnames="stride")(
        a_frame.color,
        b_frame.color,
        *b.halves,
        stack(a_frame),
        stack(b_frame),
        stride=2,
    )
    star = (halves[0] + halves[1]) / 2
    w, m = found.variance, found.mse

    def towards(prior: Image) -> Image:
        eta = double_shrinkage.confidence(prior, u, b.image, w, m)
        return double_shrinkage.combine(prior, u, b.image, w, m, eta)

    one = lambda errors: jnp.mean(errors, axis=-1, keepdims=True)
    paper = _prior(u, b.image, one(w), one(m), stack(half), stride=2)
    return {
        "double shrinkage": double_shrinkage.combine_frame(half, b).image,
        "its prior alone": found.prior,
        "the paper's prior alone": paper,
        "double shrinkage to the paper's prior": towards(paper),
        "y* alone": star,
        "double shrinkage to y*": towards(star),
        "james-stein to y*": _james_stein(u, star, v, **WHITENED),
        "james-stein to the prior": _james_stein(u, found.prior, v, **WHITENED),
    }


def error_of(reference: Reference, image: Image) -> float:
    """Relative L2, less the reference's noise."""
    r, noise = reference
    return float(rel_l2(image, r, half_difference=noise))


def errors_of_photons(half: Frame, bias: Image) -> dict[str, list[float]]:
    """Estimated and true mean squared error, relative: frame, dark and bright."""
    assert half.reference is not None
    r, noise = half.reference
    b = half.estimates[PHOTONS]
    x_a, x_b = (part.color for part in half.halves())
    variance = jnp.square(b.halves[0] - b.halves[1]) / 4
    own = 0 if noise is None else jnp.square(noise) / 4
    each = {
        "true": jnp.square(b.image - r) - own,
        "by halves": double_shrinkage.biased_error(x_a, x_b, *b.halves),
        "by radii": bias + variance,
        "variance alone": variance,
    }
    level = np.asarray(r).mean(axis=-1, keepdims=True)
    weight = 1 / (level**2 + 0.01)
    dark, bright = np.quantile(level, [0.25, 0.75])
    parts = np.ones_like(level), level < dark, level > bright
    return {
        name: [float((weight * error * p).sum() / (3 * p.sum())) for p in parts]
        for name, error in ((n, np.asarray(e)) for n, e in each.items())
    }


def run(config: Config) -> dict[str, dict]:
    """Render and measure everything.

    Args:
        config: what, and where to keep it.

    Returns:
        by scene: `error` and `seconds` by method, `ablations`, `mse`, and `rates`,
        `spp` and `passes`.
    """
    if config.quick:
        config = dataclasses.replace(
            config, scenes=config.scenes[:1], seconds=0.2, size=24, reference_spp=64,
            photons=5000, radius=0.1,
        )  # fmt: skip
    config.out.mkdir(parents=True, exist_ok=True)
    results = config.out / "results.json"
    kept = json.loads(results.read_text()) if results.exists() else {}
    for scene in tqdm(config.scenes, unit="scene"):
        row = kept.setdefault(scene, {})
        whole, half, bias = frames(config, scene, row)
        results.write_text(json.dumps(kept, indent=1))
        whole = whole.normalised()
        half, bias = half.normalised(whole.unit), bias / whole.unit**2
        error = functools.partial(error_of, whole.reference)
        images, row["error"], row["seconds"] = {}, {}, {}
        for name, make in methods(whole, half).items():
            images[name] = jax.block_until_ready(make())
            start = time.perf_counter()
            jax.block_until_ready(make())
            row["seconds"][name] = time.perf_counter() - start
            row["error"][name] = error(images[name])
        row["ablations"] = {n: error(i) for n, i in ablations(half).items()}
        row["mse"] = errors_of_photons(half, bias)
        _picture(config.out / f"{scene}.png", whole, half, images)
        results.write_text(json.dumps(kept, indent=1))
    return {scene: kept[scene] for scene in config.scenes}


def _picture(path: pathlib.Path, whole: Frame, half: Frame, images: dict) -> None:
    """The images, and what share the biased image and the prior have."""
    found = double_shrinkage.make_inputs(half, half.estimates[PHOTONS])
    share = double_shrinkage.factors(found.variance, found.mse, found.confidence)
    shown = {
        "reference": whole.reference.image,
        "path tracing, all the time": images["path tracing alone"],
        "photon mapping, all the time": images["photon mapping alone"],
        "prior": found.prior,
        "double shrinkage": images["double shrinkage"],
        "james-stein, whitened": images["james-stein, whitened"],
    }
    figure, axes = plt.subplots(2, 4, figsize=(14, 7.4), layout="compressed")
    for axis, (name, image) in zip(axes.flat, shown.items(), strict=False):
        axis.imshow(np.asarray(tone_map(image)), interpolation="nearest")
        axis.set_title(name, fontsize=9)
    shares = (("share of photons, k1", share.biased),
              ("share of the prior, k2 (red)", share.prior))  # fmt: skip
    for axis, (name, image) in zip(axes.flat[6:], shares, strict=True):
        axis.imshow(np.mean(image, axis=-1), cmap="coolwarm", vmin=0, vmax=1)
        axis.set_title(name, fontsize=9)
    for axis in axes.flat:
        axis.axis("off")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    """Print the tables."""
    found = run(tyro.cli(Config, description=__doc__))
    for scene, row in found.items():
        print(f"\n{scene}: {row['spp']} samples a pixel or {row['passes']} passes")
        print("\n| method | relative L2 | combining, s |\n| --- | --- | --- |")
        for name, error in row["error"].items():
            print(f"| {name} | {error:.5f} | {row['seconds'][name]:.3f} |")
    for part, title in (("ablations", "ablation"), ("mse", "photons' error")):
        print(
            f"\n| {title} |",
            " | ".join(found),
            "|\n" + "| --- " * (len(found) + 1),
            "|",
        )
        for name in next(iter(found.values()))[part]:
            each = [np.atleast_1d(row[part][name]) for row in found.values()]
            cells = (", ".join(f"{n:.5f}" for n in numbers) for numbers in each)
            print(f"| {name} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
