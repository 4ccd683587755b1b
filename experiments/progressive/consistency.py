"""Does the mix of progressive denoising converge, from few samples to very many?

A small frame with four times as many samples each time, each frame of its own: by
default 64x64 pixels and 4 to 16384 samples a pixel, 16 thousand to 67 million in all.
Relative L2, less the reference's noise, divided by path tracing's: of the denoised
image and of the network's mix, unbounded, with the paper's bound (channels independent)
and with that of the measured noise of the channels' mean. A consistent image's ratio
stays bounded as samples grow; the denoised one's need not.
"""

import dataclasses
import pathlib

import jax
import tyro
from matplotlib.figure import Figure

from experiments.common.command import Options, main
from experiments.common.errors import relative_l2
from experiments.common.report import Report
from experiments.common.tables import table
from jscomb import exr, progressive, rendering
from jscomb.cli import render_file
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.learning import recipes

INPUTS = ("path tracing", "denoised")


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to render.

    Attributes:
        scene: name of a scene, see `jscomb.rendering`, or a Mitsuba XML file.
        work: folder that keeps what is rendered.
        size: width and height in pixels.
        first: samples a pixel of the first frame.
        frames: number of frames, each with four times the samples of the one before.
        reference_spp: samples a pixel of the reference.
    """

    scene: tyro.conf.Positional[str]
    work: pathlib.Path
    size: int = 64
    first: int = 4
    frames: int = 7
    reference_spp: int = 65536


def render(config: Config) -> dict[int, Frame]:
    """Render what is missing.

    Args:
        config: what to render.

    Returns:
        frames by samples a pixel.
    """
    config.work.mkdir(parents=True, exist_ok=True)
    counts = [config.first * 4**k for k in range(config.frames)]
    name = pathlib.Path(config.scene).stem
    files = {n: config.work / f"{name}-{n}.exr" for n in counts}
    first = files[counts[0]]
    for number, (spp, file) in enumerate(files.items()):
        if file.exists():
            continue
        reference = {"reference_spp": config.reference_spp} if file == first else {}
        settings = rendering.Settings(
            spp=spp, size=config.size, buffers=2, seed=number * 10**6, **reference
        )
        borrowed = None if file == first else first
        render_file(config.scene, file, settings, reference_from=borrowed)
    return {n: exr.read_frame(file) for n, file in files.items()}


def measure(frame: Frame) -> dict[str, float]:
    """Return the relative L2 of the inputs and of every mix.

    Args:
        frame: with a reference.

    Returns:
        by name.
    """
    frame = frame.normalised()
    network = recipes.shipped("pd")
    inputs = progressive.neural_inputs(jax.random.key(0), oidn.denoise_color, frame)
    bare = {name: image for name, image in inputs.items() if name != "noise"}
    mix = jax.jit(progressive.combine_inputs, static_argnames="bound")
    images = {
        "path tracing": inputs["unbiased"],
        "denoised": inputs["biased"],
        "mix, no bound": mix(network, bare, bound=False),
        "mix, the paper's bound": mix(network, bare),
        "mix": mix(network, inputs),
    }
    return {name: relative_l2(image, frame) for name, image in images.items()}


def run(config: Config) -> dict[int, dict[str, float]]:
    """Measure every frame.

    Args:
        config: what to render.

    Returns:
        relative L2 by samples a pixel and image.

    Raises:
        ImportError: if Open Image Denoise or Mitsuba is missing.
        ValueError: if the scene is unknown.
    """
    if config.quick:
        config = dataclasses.replace(config, size=24, frames=3, reference_spp=1024)
    return {samples: measure(frame) for samples, frame in render(config).items()}


def plot(found: dict[int, dict[str, float]]) -> Figure:
    """Errors against samples."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axis = figure.subplots()
    for name in next(iter(found.values())):
        axis.loglog(list(found), [row[name] for row in found.values()], label=name)
    axis.set(xlabel="samples a pixel", ylabel="relative L2")
    axis.legend()
    return figure


def report(found: dict[int, dict[str, float]]) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        errors of every frame, and their plot.
    """
    names = list(next(iter(found.values())))
    over = lambda name: [row[name] / row["path tracing"] for row in found.values()]
    said = "; ".join(
        f"{name} {over(name)[0]:.3f} to {over(name)[-1]:.3f}, at most "
        f"{max(over(name)):.2f}"
        for name in names
        if name != "path tracing"
    )
    answer = (
        f"From {min(found)} to {max(found)} samples a pixel, relative L2 over path "
        f"tracing's: {said}."
    )
    cells = [[n, *(row[name] for name in names)] for n, row in found.items()]
    figures = {"Errors against samples": plot(found)}
    return Report(answer, table(["samples", *names], cells), figures)


if __name__ == "__main__":
    main(Config, run, report)
