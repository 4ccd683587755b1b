"""What is double shrinkage of path tracing and photon mapping worth, at equal time?

Every scene is rendered twice: path tracing and photon mapping for a given time each, to
be used alone, and both for half of it each, to be combined. Four tables:

    error      relative L2, less the reference's noise, and the seconds of combining
    ablations  double shrinkage with another prior (y*, James-Stein's cross-regressed
               image), or James-Stein in its place
    mse        the photon-mapped image's mean squared error as halves and as radii tell
               it, and the true one: mean over the frame, and over its darkest and
               brightest quarter, by the reference
    time       of the prior, divided by that of its parts timed alone (three kinds of
               weights, twice the products of features and their matrix product, once
               the predictions' product); of the rest, divided by reading the same
               images once and writing one, and by the bare window sums where it pools
"""

import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.common.command import Options, main
from experiments.common.errors import relative_l2
from experiments.common.report import Report
from experiments.common.results import Results
from experiments.common.tables import table
from experiments.common.timing import medians
from experiments.double_shrinkage import speed
from experiments.double_shrinkage.picture import picture
from jscomb import double_shrinkage, ensemble, james_stein, rendering
from jscomb.denoisers import oidn
from jscomb.features import stack
from jscomb.frame import Frame
from jscomb.rendering import PHOTONS, Launcher, Pass, Settings
from jscomb.typing import Image

SEED = 10**6  # of the frames at half the time
WHITENED = {"window": 7, "whiten": True}


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render and to measure.

    Attributes:
        work: folder that keeps what is rendered.
        scenes: names of own scenes, or XML files.
        seconds: of sampling, for each method.
        size: width and height in pixels.
        reference_spp: samples a pixel of the reference.
        photons: in each photon pass.
        radius: of the first photon passes; 0 for the default.
        repeats: timed calls of each method.
        timed_size: width and height in pixels of the images of the table of times.
    """

    work: tyro.conf.Positional[pathlib.Path]
    scenes: tuple[str, ...] = ("cornell-caustic", "cornell-glass", "cornell-box")
    seconds: float = 16.0
    size: int = 128
    reference_spp: int = 16384
    photons: int = 200_000
    radius: float = 0.0
    repeats: int = 5
    timed_size: int = 1024


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


class Rendered(NamedTuple):
    """A scene in equal time.

    Attributes:
        whole: path tracing and photon mapping in all the time, each.
        half: both in half of it.
        bias: of the half's photon-mapped image as its radii tell, squared radiance.
        samples: a pixel of the whole.
        passes: of photons of the whole.
    """

    whole: Frame
    half: Frame
    bias: Image
    samples: int
    passes: int


def name_of(scene: str) -> str:
    """An own scene's name, or that of an XML file's folder."""
    return pathlib.Path(scene).parent.name if scene.endswith(".xml") else scene


def rendered(config: Config, scene: str) -> Rendered:
    """Render a scene, or take what a run has left; normalised."""
    name = name_of(scene)
    kept = Results(config.work / "rates.jsonl")
    each = kept.get(f"{name} {config.size}", lambda: rates(config, scene))
    # The half has two buffers of two samples at least.
    counts = [max(8, 4 * round(config.seconds / seconds / 4)) for seconds in each]
    settings = _settings(config, *counts, reference_spp=config.reference_spp)
    partial = config.work / f"{name}-whole.npz"
    whole = rendering.render(scene, settings, partial=partial)
    settings = _settings(config, *(n // 2 for n in counts), seed=SEED)
    partial = config.work / f"{name}-half.npz"
    *_, (_, moments) = rendering.render_steps(scene, settings, partial=partial)
    half = rendering.assemble(settings, moments)._replace(reference=whole.reference)
    weighted = np.mean([moments[f"{PHOTONS}{k}"].mean[..., 3:] for k in range(2)], 0)
    every = rendering.plan_passes(settings)
    radii = jnp.asarray([p.radius for p in every if p.integrator == PHOTONS])
    whole = whole.normalised()
    whole = whole.with_estimate("oidn", oidn.denoise_frame(whole))
    half, unit = half.normalised(whole.unit), whole.unit
    assert unit is not None
    bias = double_shrinkage.radius_bias(
        half.estimates[PHOTONS].image,
        jnp.asarray(weighted, half.color.dtype) / unit,
        radii.astype(half.color.dtype),
    )
    return Rendered(whole, half, bias, *counts)


def methods(whole: Frame, half: Frame) -> dict[str, Callable[[], Image]]:
    """All images by name; those of half the time unless they say alone."""
    u, b = half.color, half.estimates[PHOTONS]
    v = james_stein.robust_variance(half.variance)
    assert b.halves is not None
    y_a, y_b = b.halves
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
            for i, j in zip((b.image, y_a, y_b), (u, x_a, x_b), strict=True)
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
    assert b.halves is not None
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
        eta = double_shrinkage.prior_error(prior, u, b.image, w, m)
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


def errors_of_photons(half: Frame, bias: Image) -> dict[str, list[float]]:
    """Estimated and true mean squared error, relative: frame, dark and bright."""
    assert half.reference is not None
    r, noise = half.reference
    b = half.estimates[PHOTONS]
    assert b.halves is not None
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


class Measured(NamedTuple):
    """What is known of a scene.

    Attributes:
        error: by method.
        seconds: of combining, by method.
        ablations: error by method.
        mse: of the photons by way, of the frame and its dark and bright parts.
        samples: a pixel of path tracing alone.
        passes: of photon mapping alone.
        picture: of the images and shares.
    """

    error: dict[str, float]
    seconds: dict[str, float]
    ablations: dict[str, float]
    mse: dict[str, list[float]]
    samples: int
    passes: int
    picture: Figure


class Found(NamedTuple):
    """What was measured: of each scene, and the ratios of times."""

    scenes: dict[str, Measured]
    times: dict[str, float]


def measure(scene: Rendered, repeats: int) -> Measured:
    """All tables of one scene."""
    whole, half, bias, samples, passes = scene
    error = functools.partial(relative_l2, frame=whole)
    calls = methods(whole, half)
    images = {name: make() for name, make in calls.items()}
    return Measured(
        {name: error(image) for name, image in images.items()},
        medians(calls, repeats),
        {name: error(image) for name, image in ablations(half).items()},
        errors_of_photons(half, bias),
        samples,
        passes,
        picture(whole, half, images),
    )


def run(config: Config) -> Found:
    """Render and measure everything.

    Args:
        config: what, and where to keep it.

    Returns:
        tables by scene, and times.

    Raises:
        ImportError: if Open Image Denoise or Mitsuba is missing.
        ValueError: if the scene is unknown, or there is no LLVM for photon mapping.
    """
    if config.quick:
        config = dataclasses.replace(
            config, scenes=config.scenes[:1], seconds=0.2, size=24, reference_spp=64,
            photons=5000, radius=0.1, repeats=1, timed_size=64,
        )  # fmt: skip
    config.work.mkdir(parents=True, exist_ok=True)
    scenes = {
        name_of(scene): measure(rendered(config, scene), config.repeats)
        for scene in tqdm(config.scenes, unit="scene")
    }
    return Found(scenes, speed.ratios(config.timed_size, config.repeats))


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        the four tables, and a picture of each scene.
    """
    rows = found.scenes

    def of(part: str) -> str:
        first, *_ = (getattr(row, part) for row in rows.values())
        cells = lambda name: [getattr(row, part)[name] for row in rows.values()]
        return table([part, *rows], [[name, *cells(name)] for name in first])

    def against(name: str) -> str:
        ratios = (r.error["double shrinkage"] / r.error[name] for r in rows.values())
        return ", ".join(f"{ratio:.2f}" for ratio in ratios)

    answer = (
        f"In equal time on {', '.join(rows)} double shrinkage of both has "
        f"{against('path tracing alone')} of path tracing's relative L2, "
        f"{against('photon mapping alone')} of photon mapping's and "
        f"{against('path tracing alone, oidn')} of denoised path tracing's."
    )
    sampled = [[n, row.samples, row.passes] for n, row in rows.items()]
    parts = [
        [name, *(cell for row in rows.values() for cell in row.mse[name])]
        for name in next(iter(rows.values())).mse
    ]
    columns = [f"{n}{part}" for n in rows for part in ("", ", dark", ", bright")]
    tables = [
        table(["scene", "samples a pixel", "or passes of photons"], sampled),
        of("error"),
        "Seconds of combining:",
        of("seconds"),
        of("ablations"),
        "The photon-mapped image's mean squared error, relative:",
        table(["told by", *columns], parts),
        table(["time", "ratio"], found.times.items()),
    ]
    pictures = {scene: row.picture for scene, row in rows.items()}
    return Report(answer, "\n\n".join(tables), pictures)


if __name__ == "__main__":
    main(Config, run, report)
