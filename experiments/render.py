"""Render a frame with everything that a combiner may ask for, as one EXR file.

    python -m experiments.render cornell-glass --spp 64 --size 256 \
        --reference-spp 4096 --out frame.exr

K independent sub-buffers with the variance of each mean (Welford over single
samples), albedo, normal, depth and visibility, Open Image Denoise of the frame and
of its halves (where the extra `oidn` is installed), and a reference that carries the
difference of its own two halves. Work done so far is kept in `OUT.partial.npz`; the
same command takes it up again.
"""

import dataclasses
import hashlib
import json
import os
import pathlib
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments import scenes, streams
from jscomb import exr, methods
from jscomb.denoisers import oidn
from jscomb.frame import Frame, Reference, make_frame

REFERENCE_CHUNK = 16  # samples of one reference pass: bounds memory, saves launches
TOLD = ("scene", "spp", "buffers", "feature_spp", "reference_spp")
TOLD += ("seed", "numbers", "tile", "passes", "photons", "radius")
SAVE_EVERY = 20.0  # seconds between two saves of the work so far


@dataclasses.dataclass(frozen=True)
class Config:
    """What to render.

    Attributes:
        scene: cornell-box, cornell-glass, cornell-glossy, random-SEED, or a Mitsuba XML
            file.
        out: EXR file to write.
        spp: samples a pixel of the full frame.
        size: width and height in pixels; 0 keeps an XML file's own size.
        width: of the film in pixels, where it is not square.
        height: of the film in pixels, where it is not square.
        buffers: number of independent sub-buffers, 1 or even.
        feature_spp: samples a pixel of each sub-buffer's features.
        reference_spp: samples a pixel of the reference; 0 renders none.
        reference_from: take the reference of this frame file instead.
        numbers: the random numbers of different pixels: independent, or common, the
            same for all.
        tile: width in pixels of the tiles that common numbers are common to; 0 for one
            over the whole frame.
        seed: first random stream; frames and references with streams apart are
            independent (one stream a pass).
        denoise: run Open Image Denoise on the frame and its halves.
    """

    scene: tyro.conf.Positional[str]
    out: pathlib.Path
    spp: int = 64
    size: int = 0
    width: int = 0
    height: int = 0
    buffers: int = 2
    feature_spp: int = 16
    reference_spp: int = 0
    reference_from: pathlib.Path | None = None
    numbers: Literal["independent", "common"] = "independent"
    tile: int = 0
    seed: int = 0
    denoise: bool = True

    def __post_init__(self) -> None:
        """Reject sizes and counts that cannot be rendered."""
        if min(self.size, self.width, self.height, self.tile, self.seed) < 0:
            raise ValueError("size, width, height, tile and seed must not be negative")
        if self.numbers == "common" and self.reference_spp:
            raise ValueError("a reference wants independent random numbers")
        if self.feature_spp < 1:
            raise ValueError(f"feature_spp must be positive, got {self.feature_spp}")
        k = self.buffers
        if k < 1 or (k > 1 and k % 2):
            raise ValueError(f"buffers must be 1 or even, got {k}")
        if self.spp % k or self.spp < 2 * k:
            raise ValueError(
                f"spp must be a multiple of buffers = {k} and at least {2 * k} (a "
                f"variance needs two samples a buffer), got {self.spp}"
            )
        if self.reference_spp and self.reference_from:
            raise ValueError("give reference_spp or reference_from, not both")
        if self.reference_spp < 0 or self.reference_spp % (2 * REFERENCE_CHUNK):
            raise ValueError(
                f"reference_spp must be a multiple of {2 * REFERENCE_CHUNK}, got "
                f"{self.reference_spp}"
            )


class Moments(NamedTuple):
    """Running mean and sum of squared deviations (Welford), [H,W,C] each."""

    number: float
    mean: np.ndarray
    squares: np.ndarray

    def add(self, image: np.ndarray) -> "Moments":
        """The moments with one more independent image."""
        number = self.number + 1
        step = image - self.mean
        mean = self.mean + step / number
        return Moments(number, mean, self.squares + step * (image - mean))

    @property
    def variance_of_mean(self) -> np.ndarray:
        """Unbiased estimate of the variance of `mean`."""
        return self.squares / (self.number * (self.number - 1))


class Pass(NamedTuple):
    """One launch of the renderer, added to the moments called `target`."""

    target: str
    spp: int
    seed: int
    integrator: str


def passes(config: Config) -> Iterator[Pass]:
    """Every pass of a frame in order; sub-buffers take turns, each its own stream."""
    seed = config.seed
    for number in range(config.spp):
        yield Pass(f"color{number % config.buffers}", 1, seed, "path")
        seed += 1
    for name in ("aov", "visibility"):
        for k in range(config.buffers):
            yield Pass(f"{name}{k}", config.feature_spp, seed, name)
            seed += 1
    for number in range(config.reference_spp // REFERENCE_CHUNK):
        yield Pass(f"reference{number % 2}", REFERENCE_CHUNK, seed, "path")
        seed += 1


def launcher(config: Config) -> Callable[[Pass], np.ndarray]:
    """Load a scene.

    Args:
        config: which one, and its size.

    Returns:
        a function that renders one pass of it, [H,W,...] in float64.

    Raises:
        ValueError: if the scene is unknown, or a borrowed reference does not fit it.
    """
    mi = scenes.mitsuba()
    width, height = config.width or config.size, config.height or config.size
    common = config.numbers == "common"
    if common:
        streams.register(mi)
    scene = scenes.load(
        config.scene,
        width=width,
        height=height,
        sampler=streams.NAME if common else "independent",
    )
    sensor = scene.sensors()[0]
    columns, rows = sensor.film().size()
    if common:
        sensor.sampler().columns, sensor.sampler().tile = int(columns), config.tile
    if config.reference_from:  # found out now, not after the last pass
        shape = _borrowed(config.reference_from).image.shape
        if shape != (rows, columns, 3):
            raise ValueError(
                f"the reference in {config.reference_from} is {shape}, the film "
                f"{(rows, columns, 3)}"
            )
    integrators = {
        "path": scene.integrator(),
        "aov": mi.load_dict(
            {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,depth:depth"}
        ),
        "visibility": _visibility(mi),
    }

    def launch(p: Pass) -> np.ndarray:
        image = mi.render(
            scene, integrator=integrators[p.integrator], spp=p.spp, seed=p.seed
        )
        return np.asarray(image, np.float64)

    return launch


def render(config: Config) -> dict[str, Moments]:
    """The moments of every target after all passes, see `steps`."""
    *_, (_, moments) = steps(config)
    return moments


def steps(
    config: Config,
    todo: Sequence[Pass] | None = None,
    launch: Callable[[Pass], np.ndarray] | None = None,
) -> Iterator[tuple[int, dict[str, Moments]]]:
    """Run all passes, or those that an interrupted run has left.

    Args:
        config: what to render.
        todo: the passes in their order; None for `passes(config)`.
        launch: renders a pass; None for `launcher(config)`.

    Yields:
        after each pass (and first what an interrupted run has left, if anything) how
        many are done, and the moments of every target so far in float64: `color0`,
        ..., `aov0`, ..., `visibility0`, ..., `reference0`, `reference1`.

    Raises:
        ValueError: if the scene is unknown, or the partial file on disk belongs to
            another configuration.
    """
    launch = launch or launcher(config)
    partial = _Partial(config)
    done, moments = partial.load()
    todo = list(passes(config)) if todo is None else todo
    progress = tqdm(
        total=sum(p.spp for p in todo), unit="spp", desc=config.scene, leave=None
    )
    progress.update(sum(p.spp for p in todo[:done]))
    if done:
        yield done, moments
    for number, p in enumerate(todo[done:], done + 1):
        image = launch(p)
        empty = Moments(0, np.zeros_like(image), np.zeros_like(image))
        moments[p.target] = moments.get(p.target, empty).add(image)
        progress.update(p.spp)
        partial.save(number, moments, last=number == len(todo))
        yield number, moments
    progress.close()


def assemble(config: Config, moments: dict[str, Moments]) -> Frame:
    """The frame that the moments describe, without biased images.

    Args:
        config: what was rendered.
        moments: of every target, from `render`.

    Returns:
        the frame in float32.
    """

    def stack(name: str, value: Callable[[Moments], np.ndarray]) -> np.ndarray:
        each = [value(moments[f"{name}{k}"]) for k in range(config.buffers)]
        return np.stack(each).astype(np.float32)

    aov = stack("aov", lambda m: m.mean)
    return make_frame(
        stack("color", lambda m: m.mean),
        variance=stack("color", lambda m: m.variance_of_mean),
        albedo=aov[..., :3].clip(0, 1),  # metals report up to 10
        normal=aov[..., 3:6],
        depth=aov[..., 6:7],
        visibility=stack("visibility", lambda m: m.mean[..., :1]),
        samples=config.spp,
        reference=_reference(config, moments),
    )


def _reference(config: Config, moments: dict[str, Moments]) -> Reference | None:
    """Mean and difference of the reference's two halves, or another frame's."""
    if config.reference_from:
        return _borrowed(config.reference_from)
    if not config.reference_spp:
        return None
    a, b = moments["reference0"].mean, moments["reference1"].mean
    image, difference = (a + b) / 2, a - b
    return Reference(*(jnp.asarray(i, jnp.float32) for i in (image, difference)))


def _borrowed(path: pathlib.Path) -> Reference:
    """The reference in another frame's file."""
    reference = exr.read_frame(path, statistics=False).reference
    if reference is None:
        raise ValueError(f"{path} holds no reference")
    return reference


def _visibility(mi):
    """An integrator: the unoccluded fraction of emitter samples at the first hit."""
    import drjit as dr  # comes with Mitsuba

    class Visibility(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(ray, active)
            lit = active & si.is_valid()
            light, _ = scene.sample_emitter_direction(
                si, sampler.next_2d(lit), False, lit
            )
            lit &= light.pdf > 0
            occluded = scene.ray_test(si.spawn_ray_to(light.p), lit)
            # `select`, since in scalar variants these are Python's own booleans.
            seen = dr.select(lit, dr.select(occluded, 0.0, 1.0), 0.0)
            return mi.Color3f(seen), active, []

    return Visibility(mi.Properties())


class _Partial:
    """The moments so far, on disk beside the output, so that no pass is run twice."""

    def __init__(self, config: Config) -> None:
        self.path = config.out.with_name(config.out.name + ".partial.npz")
        fields = dataclasses.asdict(config)
        for name in ("out", "denoise", "reference_from"):  # do not touch a pass
            del fields[name]
        fields["variant"] = scenes.mitsuba().variant()
        if os.path.isfile(config.scene):
            text = pathlib.Path(config.scene).read_bytes()
            fields["scene"] = hashlib.sha256(text).hexdigest()
        self.key = json.dumps(fields, sort_keys=True, default=str)
        self.saved = time.monotonic()

    def load(self) -> tuple[int, dict[str, Moments]]:
        """Passes done and their moments; none where there is no file."""
        if not self.path.exists():
            return 0, {}
        try:
            with np.load(self.path) as data:
                stored = {name: data[name] for name in data.files}
            key, done = str(stored.pop("key")), int(stored.pop("done"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(f"{self.path}: not a partial render: {error}") from None
        if key != self.key:
            raise ValueError(
                f"{self.path} belongs to another configuration: remove it or choose "
                "another --out"
            )
        names = {name.rpartition(".")[0] for name in stored}
        return done, {
            name: Moments(*(stored[f"{name}.{f}"] for f in Moments._fields))
            for name in names
        }

    def save(self, done: int, moments: dict[str, Moments], *, last: bool) -> None:
        """Write now and then, and always after the last pass; atomically."""
        if not last and time.monotonic() - self.saved < SAVE_EVERY:
            return
        arrays = {
            f"{name}.{field}": value
            for name, each in moments.items()
            for field, value in each._asdict().items()
        }
        temporary = self.path.with_suffix(".tmp.npz")
        np.savez(temporary, key=self.key, done=done, **arrays)  # type: ignore[arg-type]
        os.replace(temporary, self.path)
        self.saved = time.monotonic()

    def remove(self) -> None:
        """Forget the partial work."""
        self.path.unlink(missing_ok=True)


def run(config: Config) -> Frame:
    """Render, denoise and write a frame.

    Args:
        config: what to render and where to write it.

    Returns:
        the frame that was written.
    """
    return write(config, assemble(config, render(config)))


def write(config: Config, frame: Frame) -> Frame:
    """Denoise a frame, write it, and forget the partial work.

    Args:
        config: what was rendered.
        frame: what came of it.

    Returns:
        the frame that was written.
    """
    if config.denoise and oidn.available():
        denoised = methods.combine(jax.random.key(0), frame, method="oidn")
        frame = frame.with_estimate("oidn", denoised)
    provenance = {
        "renderer": f"Mitsuba {scenes.mitsuba().__version__}",
        "variant": scenes.mitsuba().variant(),
        **{k: v for k, v in dataclasses.asdict(config).items() if k in TOLD},
    }
    if config.reference_from:
        other = exr.read_provenance(config.reference_from)
        provenance["reference_from"] = config.reference_from.name
        provenance["reference_spp"] = other.get("reference_spp")
    exr.write_frame(config.out, frame, provenance=provenance)
    _Partial(config).remove()
    return frame


def main() -> None:
    """Run from the command line."""
    try:
        run(tyro.cli(Config, description=__doc__))
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"render: {' '.join(str(error).split())}")


if __name__ == "__main__":
    main()
