"""How does a progressive rendering's error fall, and does the renderer know it?

Renders with Mitsuba, twice as many samples each time, up to a budget or an estimated
error. After every batch: mean and variance of the samples so far (Welford), Open Image
Denoise, SURE, and both mixed (`jscomb.progressive`). Relative L2, less the reference's
noise, of samples, denoised and mixed image, as it is and as estimated without the
reference. An interrupted run goes on where it was.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import tyro
from matplotlib.figure import Figure

from experiments.common.command import Options, main
from experiments.common.errors import relative_l2
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb import james_stein, progressive, rendering
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.numerics import sure
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render.

    Attributes:
        scene: name of a scene, see `jscomb.rendering`, or a Mitsuba XML file.
        work: folder that keeps what is rendered.
        size: width and height in pixels.
        spp: budget, samples a pixel.
        first: samples a pixel of the first batch, at least two.
        target: stop at this estimated error of the mixed image.
        reference_spp: samples a pixel of the reference.
    """

    scene: tyro.conf.Positional[str]
    work: pathlib.Path
    size: int = 128
    spp: int = 2048
    first: int = 8
    target: float = 0.0
    reference_spp: int = 16384

    def __post_init__(self) -> None:
        """Reject batches without a variance."""
        if not 2 <= self.first <= self.spp:
            raise ValueError(f"first must be from 2 to spp = {self.spp}: {self.first}")


def stages(config: Config) -> Iterator[Frame]:
    """The frame after each batch of samples."""
    config.work.mkdir(parents=True, exist_ok=True)
    whole = rendering.Settings(
        spp=config.spp,
        size=config.size,
        buffers=1,
        reference_spp=config.reference_spp,
    )
    every = rendering.plan_passes(whole)
    before = [p for p in every if p.target != "color0"]
    # A sample a pass, of streams beyond the others.
    color = [rendering.Pass("color0", 1, 10**6 + k, "path") for k in range(config.spp)]
    due = config.first
    todo, partial = [*before, *color], config.work / "frame.partial.npz"
    steps = rendering.render_steps(config.scene, whole, todo=todo, partial=partial)
    for done, moments in steps:
        samples = done - len(before)
        if samples >= due or samples == config.spp:
            yield rendering.assemble(dataclasses.replace(whole, spp=samples), moments)
            due = 2 * samples


def mixed(frame: Frame) -> dict[str, tuple[Image, Image]]:
    """Samples, denoised and mixed image, each with its estimated squared error."""
    x, v = frame.color, frame.variance
    denoise = functools.partial(oidn.denoise_color, frame=frame)
    estimate = lambda v: sure.monte_carlo_sure(
        jax.random.key(0), denoise, x, v, slope_limit=1.0
    )
    y, s, _ = estimate(v)
    # To mix by, no pixel shall be more certain than those around it.
    robust = james_stein.robust_variance(v)
    by = estimate(robust).squared_error
    alpha = progressive.mixing(x, y, robust, by, whiten=True)
    alpha = progressive.bound_mixing(alpha, x, y, v)
    z = (1 - alpha) * x + alpha * y
    risk = progressive.risk(alpha, x, y, v, s)
    return {"samples": (x, v), "denoised": (y, s), "mixed": (z, risk)}


def errors(frame: Frame, image: Image, estimate: Image) -> tuple[float, float]:
    """Relative error of an image as it is, and as estimated."""
    assert frame.reference is not None
    radiance = jnp.mean(frame.reference.image, axis=-1, keepdims=True)
    known = jnp.mean(estimate / (jnp.square(radiance) + 0.01))
    return relative_l2(image, frame), float(known)


Found = dict[int, dict[str, tuple[float, float]]]


def run(config: Config) -> Found:
    """Render until the budget is spent or the error is small enough.

    Args:
        config: what to render.

    Returns:
        by samples a pixel and image, its error as it is and as estimated.

    Raises:
        ImportError: if Open Image Denoise or Mitsuba is missing.
        ValueError: if the scene is unknown.
    """
    if config.quick:
        config = dataclasses.replace(config, size=24, spp=32, reference_spp=256)
    found: Found = {}
    for frame in stages(config):
        assert frame.samples is not None
        samples, frame = int(frame.samples), frame.normalised()
        images = mixed(frame)
        found[samples] = {n: errors(frame, *pair) for n, pair in images.items()}
        if found[samples]["mixed"][1] < config.target:
            break
    return found


def plot(found: Found) -> Figure:
    """Errors against samples: as they are, and dashed as estimated."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axis = figure.subplots()
    for color, name in enumerate(next(iter(found.values()))):
        for style, label, at in (("-", name, 0), ("--", f"{name}, estimated", 1)):
            values = [row[name][at] for row in found.values()]
            axis.loglog(list(found), values, style, color=f"C{color}", label=label)
    axis.set(xlabel="samples a pixel", ylabel="relative L2")
    axis.legend()
    return figure


def report(found: Found) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors and estimates of every stage, and their plot.
    """
    names = list(next(iter(found.values())))

    def off(name: str) -> float:
        """The largest factor between an estimate and the truth."""
        ratios = [known / true for true, known in (row[name] for row in found.values())]
        return max(max(r, 1 / r) if r > 0 else float("inf") for r in ratios)

    gains = [row["mixed"][0] / row["denoised"][0] for row in found.values()]
    answer = (
        f"From {min(found)} to {max(found)} samples the estimated error is right "
        f"within a factor of {off('samples'):.2f} for the samples, "
        f"{off('denoised'):.1f} for the denoised and {off('mixed'):.1f} for the mixed "
        f"image, which has {max(gains):.2f} of the denoised one's error at most and "
        f"{gains[-1]:.2f} at the end."
    )
    header = ["samples", *(f"{n}{e}" for n in names for e in ("", ", estimated"))]
    cells = [[s, *(v for n in names for v in row[n])] for s, row in found.items()]
    return Report(answer, table(header, cells), {"Errors against samples": plot(found)})


if __name__ == "__main__":
    main(Config, run, report)
