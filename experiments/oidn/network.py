"""Is the network the filter, what do both cost, and is its derivative right?

Three tables and a number:

    parity    every model of the installed version: relative root mean square difference
              of network and filter on a rendering, whose network it has, and how many
              numbers that has.
    time      seconds of the filter on the host, of the network compiled, and of the
              network with one forward derivative, in turns; a square image.
    memory    what each takes at most beside the image: growth of the process's peak, in
              a process of its own.
    gradient  of a frame's relative L2 in all weights (`jax.grad`): how far the error
              falls by a small step along it, divided by what the derivative says.
"""

import dataclasses
import functools
import pathlib
import resource
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.common import archives
from experiments.common.command import Options, main
from experiments.common.report import Report
from experiments.common.tables import table
from experiments.common.timing import apart, medians
from jscomb.denoisers import oidn
from jscomb.denoisers.oidn import _denoise, _filter, _host, _weights
from jscomb.denoisers.oidn._models import MODELS, Model
from jscomb.frame import Frame
from jscomb.metrics import rel_l2

TIMED = {
    "base": Model(("color", "albedo", "normal"), quality="balanced"),
    "large": Model(("color", "albedo", "normal"), clean=True),
}
SIZES = 256, 1024, 2048
LARGEST = 4096  # of the memory alone
STEP = 0.01  # of the error, that the step along the gradient is to take away


@dataclasses.dataclass(frozen=True)
class Config(Options):
    """What to measure.

    Attributes:
        folder: of NumPy archives.
        frame: which archive is denoised.
        samples: its samples a pixel.
        repeats: timed calls of each function.
    """

    folder: tyro.conf.Positional[pathlib.Path]
    frame: str = "cbox-glass"
    samples: int = 64
    repeats: int = 5


def images_of(frame: Frame, size: int | None = None) -> dict[str, np.ndarray]:
    """The images that a filter takes of a frame, repeated up to a square."""
    found = {"color": frame.color, "albedo": frame.albedo, "normal": frame.normal}
    images = {}
    for name, image in found.items():
        guarded = np.asarray(_denoise.guarded(name, image, image.shape))
        if size is not None:
            height, width, _ = guarded.shape
            times = -(-size // height), -(-size // width), 1
            guarded = np.tile(guarded, times)[:size, :size]
        images[name] = guarded
    return images


def in_range(model: Model, images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The images, the colour in the range of a model."""
    color = images["color"]
    if model.signed:
        color = 2 * color / color.max() - 1
    elif model.bounded:
        color = np.minimum(color, 1.0)
    return images | {"color": color.astype(np.float32)}


def parity(frame: Frame) -> dict[str, dict[str, Any]]:
    """How network and filter differ, by model."""
    images, rows = images_of(frame), {}
    for model in MODELS:
        own = in_range(model, images)
        wanted = _host.run(model, own, _denoise.EXPOSURE)
        network = _weights.network(model)
        made = _filter.apply(network, model, own, _denoise.EXPOSURE)
        difference = np.linalg.norm(made - wanted) / np.linalg.norm(wanted)
        rows[model.name] = {
            "difference": float(difference),
            "container": _weights.identify(model).number,
            "numbers": sum(a.size for a in jax.tree.leaves(network)),
        }
    return rows


def by_network(model: Model, images: dict[str, Any]) -> jax.Array:
    """Filter by the network."""
    return _filter.apply(_weights.network(model), model, images, _denoise.EXPOSURE)


def times(frame: Frame, size: int, repeats: int) -> dict[str, dict[str, float]]:
    """Seconds of filter, network and forward derivative, by kind."""
    images, found = images_of(frame, size), {}
    tangent = 0.1 * images["color"]
    for kind, model in TIMED.items():

        @jax.jit
        def derivative(color: jax.Array, model: Model = model) -> Any:
            run = lambda color: by_network(model, images | {"color": color})
            return jax.jvp(run, (color,), (tangent,))

        calls = {
            "filter": functools.partial(_host.run, model, images, _denoise.EXPOSURE),
            "network": functools.partial(by_network, model, images),
            "derivative": functools.partial(derivative, images["color"]),
        }
        found[kind] = medians(calls, repeats)
    return found


def peak(kind: str, way: str, path: pathlib.Path, samples: int, size: int) -> float:
    """MiB that one call takes beside the image at most."""
    images = images_of(archives.load(path, samples).normalised(), size)
    model = TIMED[kind]
    small = {name: image[:16, :16] for name, image in images.items()}
    run = functools.partial(_host.run, exposure=_denoise.EXPOSURE)
    if way == "network":
        run = by_network
    jax.block_until_ready(run(model, small))  # weights, threads
    used = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    before = used()
    jax.block_until_ready(run(model, images))
    return used() - before


def fall(frame: Frame) -> float:
    """How far a step along the gradient in the weights lowers the error, as it says."""
    guides = {"albedo": frame.albedo, "normal": frame.normal}
    assert frame.reference is not None
    r = frame.reference.image

    @jax.jit
    def error(network: Any) -> jax.Array:
        made = oidn.denoise_normalised(frame.color, **guides, network=network)
        return rel_l2(made, r)

    network = oidn.pretrained()
    value, slope = jax.value_and_grad(error)(network)
    square = sum(jnp.sum(s**2) for s in jax.tree.leaves(slope))
    step = STEP * value / square
    moved = jax.tree.map(lambda w, s: w - step * s, network, slope)
    return float((value - error(moved)) / (STEP * value))


def run(config: Config) -> dict:
    """Measure everything.

    Args:
        config: what to measure.

    Returns:
        `parity` by model, `times` by size and kind, `memory` by size, kind and way, and
        `fall`.

    Raises:
        ValueError: if the folder holds no such archive.
    """
    path, samples = config.folder / f"{config.frame}.npz", config.samples
    sizes, largest, repeats = SIZES, LARGEST, config.repeats
    if config.quick:
        path, samples = archives.cases(config.folder, quick=True)[0]
        sizes, largest, repeats = (32,), 48, 1
    frame = archives.load(path, samples).normalised()
    memory = {
        size: {
            kind: {
                way: apart(peak, kind, way, path, samples, size)
                for way in ("filter", "network")
            }
            for kind in TIMED
        }
        for size in (*sizes, largest)
    }
    return {
        "parity": parity(frame),
        "times": {size: times(frame, size, repeats) for size in sizes},
        "memory": memory,
        "fall": fall(frame),
    }


def report(found: dict) -> Report:
    """Say what was found.

    Args:
        found: by `run`.

    Returns:
        the tables named above.
    """
    rows, spent, memory = found["parity"], found["times"], found["memory"]
    worst = max(row["difference"] for row in rows.values())
    body = [
        table(
            ["model", "difference", "container", "numbers"],
            [[name, *row.values()] for name, row in rows.items()],
        ),
        table(
            ["size", "network", "filter s", "network / filter", "derivative / network"],
            [
                [
                    f"{size}²",
                    kind,
                    s["filter"],
                    s["network"] / s["filter"],
                    s["derivative"] / s["network"],
                ]
                for size, kinds in spent.items()
                for kind, s in kinds.items()
            ],
        ),
        table(
            ["size", "network", "filter MiB", "network MiB"],
            [
                [f"{size}²", kind, *ways.values()]
                for size, kinds in memory.items()
                for kind, ways in kinds.items()
            ],
        ),
    ]
    middle = spent[sorted(spent)[len(spent) // 2]]
    ratios = ", ".join(
        f"{s['network'] / s['filter']:.2f} ({kind})" for kind, s in middle.items()
    )
    slopes = max(
        s["derivative"] / s["network"]
        for kinds in spent.values()
        for s in kinds.values()
    )
    answer = (
        f"All {len(rows)} networks make the filter's image to a relative {worst:.1g}. "
        f"Compiled they take {ratios} of its time at "
        f"{sorted(spent)[len(spent) // 2]}², and with a forward derivative at most "
        f"{slopes:.1f} times their own. Along its gradient in the weights a frame's "
        f"error falls by {found['fall']:.2f} of what the gradient says."
    )
    return Report(answer, "\n\n".join(body))


if __name__ == "__main__":
    main(Config, run, report)
