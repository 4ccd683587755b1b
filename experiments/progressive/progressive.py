"""How does a progressive rendering's error fall, and does the renderer know it?

    python -m experiments.progressive.progressive cornell-glass --out FOLDER

Renders with Mitsuba, twice as many samples each time, up to a budget or an estimated
error. After every batch: mean and variance of the samples so far (Welford), Open Image
Denoise, SURE, and both mixed (`jscomb.progressive`). Prints the errors of samples,
denoised and mixed image, relative to the reference squared (plus 0.01), as they are and
as estimated without the reference; writes a picture of each stage, and a plot of the
errors. An interrupted run goes on where it was.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import tyro
from matplotlib import pyplot as plt
from tqdm import tqdm

from jscomb import james_stein, plots, progressive, rendering
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.metrics import rel_l2
from jscomb.numerics import sure
from jscomb.typing import Image


@dataclasses.dataclass(frozen=True)
class Config:
    """What to render.

    Attributes:
        scene: cornell-box, cornell-glass, cornell-glossy, or a Mitsuba XML file.
        out: folder of the pictures and the plot.
        size: width and height in pixels.
        spp: budget, samples a pixel.
        first: samples a pixel of the first batch, at least two.
        target: stop at this estimated error of the mixed image.
        reference_spp: samples a pixel of the reference.
    """

    scene: tyro.conf.Positional[str]
    out: pathlib.Path
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
    config.out.mkdir(parents=True, exist_ok=True)
    whole = rendering.Settings(
        spp=config.spp,
        size=config.size,
        buffers=1,
        reference_spp=config.reference_spp,
    )
    every = rendering.plan_passes(whole)
    before = [p for p in every if p.target != "color0"]
    color = [p for p in every if p.target == "color0"]
    due = config.first
    todo, partial = [*before, *color], config.out / "frame.partial.npz"
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
    estimate = lambda v: sure.monte_carlo_sure(jax.random.key(0), denoise, x, v)
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
    r, noise = frame.reference
    radiance = jnp.mean(r, axis=-1, keepdims=True)
    known = jnp.mean(estimate / (jnp.square(radiance) + 0.01))
    return float(rel_l2(image, r, half_difference=noise)), float(known)


def run(config: Config) -> dict[int, dict[str, tuple[float, float]]]:
    """Render until the budget is spent or the error is small enough.

    Args:
        config: what to render.

    Returns:
        by samples a pixel and image, its error as it is and as estimated.
    """
    found: dict[int, dict[str, tuple[float, float]]] = {}
    for frame in stages(config):
        assert frame.samples is not None
        samples, frame = int(frame.samples), frame.normalised()
        images = mixed(frame)
        found[samples] = {n: errors(frame, *pair) for n, pair in images.items()}
        row = (f"{n} {a:.5f} ({b:.5f})" for n, (a, b) in found[samples].items())
        tqdm.write(f"{samples} spp: " + ", ".join(row))
        shown = {
            name: image for name, (image, _) in images.items() if name != "samples"
        }
        plots.comparison(config.out / f"{samples:05d}.png", [(frame, shown)])
        plot(config.out / "errors.png", found)
        if found[samples]["mixed"][1] < config.target:
            break
    return found


def plot(path: pathlib.Path, found: dict[int, dict[str, tuple[float, float]]]) -> None:
    """Errors against samples: as they are, and dashed as estimated."""
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for color, name in enumerate(next(iter(found.values()))):
        for style, label, at in (("-", name, 0), ("--", f"{name}, estimated", 1)):
            values = [row[name][at] for row in found.values()]
            axis.loglog(list(found), values, style, color=f"C{color}", label=label)
    axis.set(xlabel="samples a pixel", ylabel="relative L2")
    axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Run from the command line."""
    run(tyro.cli(Config, description=__doc__))


if __name__ == "__main__":
    main()
