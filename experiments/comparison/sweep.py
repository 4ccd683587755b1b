"""Every combiner on every scene, at every sample count, with every seed: one harness.

Scenes are rendered into the work folder, or read from archives (`archives`), which
have one seed. Combiners that may be traced run vmapped over seeds and over factors for
the variance that they are told. A result is kept by a hash of all that it depends on:
the same command goes on where it was interrupted. Other experiments read the results.

Times are medians on one frame after a warm-up: of one sample a pixel, of denoising the
frame once, and of combining. Compilation, in the first case of a size, is the first
call less the median.
"""

import dataclasses
import functools
import hashlib
import json
import pathlib
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jscomb
from experiments.common import archives
from experiments.common.command import tool
from experiments.common.results import Results
from experiments.common.timing import apart
from experiments.comparison.combiners import combiners
from jscomb import exr, metrics
from jscomb.cli import render_file
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.rendering import Launcher, Pass, Settings
from jscomb.typing import Image

Record = dict[str, Any]
PASS = 16  # samples a pixel, so that launching takes no part of sampling's time


@dataclasses.dataclass(frozen=True)
class Config:
    """What to sweep over.

    Attributes:
        work: folder for rendered frames.
        results: file of `Results`.
        scenes: names of own scenes, XML files, or archives, which have sample counts of
            their own and one seed.
        spp: samples a pixel.
        seeds: how many frames of each, of independent samples.
        size: width and height of rendered frames in pixels.
        reference_spp: samples a pixel of their references.
        combiners: names of `experiments.comparison.combiners`; all by default.
        scales: factors for the variance, where a combiner is traced.
        repeats: timed calls.
        quick: one tiny scene, two seeds, three combiners.
    """

    work: pathlib.Path
    results: pathlib.Path
    scenes: tuple[str, ...] = ("cornell-box", "cornell-glass", "cornell-glossy")
    spp: tuple[int, ...] = (4, 16, 64, 256)
    seeds: int = 4
    size: int = 128
    reference_spp: int = 4096
    combiners: tuple[str, ...] = dataclasses.field(
        default_factory=lambda: tuple(combiners())
    )
    scales: tuple[float, ...] = (1.0,)
    repeats: int = 3
    quick: bool = False

    def __post_init__(self) -> None:
        """Reject what is not there."""
        known = list(combiners())
        if unknown := set(self.combiners) - set(known):
            raise ValueError(f"no combiner {sorted(unknown)}; there are {known}")


QUICK = {
    "scenes": ("cornell-box",),
    "spp": (4, 16),
    "seeds": 2,
    "size": 32,
    "reference_spp": 64,
    "combiners": ("path tracing", "oidn", "whitened"),
    "scales": (1.0, 4.0),
    "repeats": 1,
}


class Case(NamedTuple):
    """One scene at one sample count.

    Attributes:
        scene: its name.
        spp: samples a pixel.
        frames: one a seed, normalised, with reference.
        sample: seconds of one sample a pixel; None where nothing was rendered.
    """

    scene: str
    spp: int
    frames: list[Frame]
    sample: float | None


def cases(config: Config) -> Iterator[Case]:
    """Render what is missing.

    Args:
        config: what to sweep over.

    Yields:
        every scene at every sample count.
    """
    for scene in config.scenes:
        if scene.endswith(".npz"):
            path = pathlib.Path(scene)
            for spp in archives.sample_counts(path):
                frame = archives.load(path, spp)
                yield Case(path.stem, spp, [frame.normalised()], None)
            continue
        # Where Mitsuba and XLA have both compiled code, an exception may end a process.
        files, seconds = apart(_rendered, config, scene)
        for spp, seeds in files.items():
            yield Case(pathlib.Path(scene).stem, spp, _of_files(seeds), seconds)


def _of_files(paths: list[pathlib.Path]) -> list[Frame]:
    """All seeds, normalised by their reference, so that they are alike."""
    read = [exr.read_frame(path) for path in paths]
    assert read[0].reference is not None
    unit = jnp.median(read[0].reference.image)
    return [frame.normalised(unit) for frame in read]


def _rendered(
    config: Config, scene: str
) -> tuple[dict[int, list[pathlib.Path]], float]:
    """Files of every sample count and seed, and the seconds of a sample a pixel.

    Those files that are missing are rendered.
    """
    config.work.mkdir(parents=True, exist_ok=True)
    stem = f"{pathlib.Path(scene).stem}-{config.size}"
    reference = config.work / f"{stem}-reference-{config.reference_spp}.exr"
    of = functools.partial(Settings, size=config.size)
    if not reference.exists():
        much = of(spp=4, reference_spp=config.reference_spp)
        render_file(scene, reference, much, denoise=False)
    files, stream = {}, 1_000_000  # away from the reference's streams
    for spp in config.spp:
        files[spp] = []
        for seed in range(config.seeds):
            out = config.work / f"{stem}-{spp}-{seed}.exr"
            if not out.exists():
                settings = of(spp=spp, seed=stream)
                render_file(scene, out, settings, reference_from=reference)
            stream += 10 * spp + 1000
            files[spp].append(out)
    return files, _sampling(config, scene)


def _sampling(config: Config, scene: str) -> float:
    """Median seconds of one sample a pixel, after the first pass of many."""
    launch = Launcher(scene, Settings(size=config.size))
    times = []
    for number in range(1 + max(config.repeats, 3)):
        start = time.perf_counter()
        launch(Pass("color0", PASS, number, "path"))
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:]) / PASS


def _timed(function: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """The result, the median seconds, and how much longer the first call took."""
    times, result = [], None
    for _ in range(1 + repeats):
        start = time.perf_counter()
        result = jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    median = statistics.median(times[1:])
    return result, median, times[0] - median


def errors(image: Image, frame: Frame, *, displayed: bool) -> dict[str, float]:
    """Every metric.

    Args:
        image: linear radiance.
        frame: with a reference.
        displayed: FLIP and HDR-FLIP too, which take a second.

    Returns:
        errors by name; NaN where an evaluator rejects the image.
    """
    assert frame.reference is not None
    r, noise = frame.reference
    measures: dict[str, Callable[[], Any]] = {
        "relative L2": lambda: metrics.rel_l2(image, r, half_difference=noise),
        "RMSE": lambda: metrics.rmse(image, r),
        "SMAPE": lambda: metrics.smape(image, r),
        "DSSIM": lambda: metrics.dssim(image, r),
    }
    if displayed:
        measures["FLIP"] = lambda: metrics.flip(image, r)
        measures["HDR-FLIP"] = lambda: metrics.hdr_flip(image, r)
    return {name: float(measure()) for name, measure in measures.items()}


def measure(
    case: Case, name: str, config: Config, *, denoising: float
) -> Iterator[Record]:
    """Measure a combiner on all seeds of a case.

    Args:
        case: the frames.
        name: of `experiments.comparison.combiners`.
        config: scales and repeats.
        denoising: seconds of Open Image Denoise on a frame.

    Yields:
        one record for each factor of the variance.
    """
    chosen, seeds = combiners()[name], case.frames
    scales = config.scales if chosen.traced else (1.0,)
    # One frame's time is what a user waits for, not its share of a batch.
    if chosen.traced:
        one, batch = _compiled(name)
        once = lambda: one(seeds[0], jnp.float32(1))
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *seeds)
        images = batch(stacked, jnp.asarray(scales, jnp.float32))
    else:
        once = lambda: chosen.combine(seeds[0])
        images = jnp.stack([chosen.combine(frame) for frame in seeds])[None]
    _, seconds, compiling = _timed(once, config.repeats)
    for scale, each in zip(scales, images, strict=True):
        found = [
            errors(image, frame, displayed=number == 0 and scale == 1.0)
            for number, (image, frame) in enumerate(zip(each, seeds, strict=True))
        ]
        yield {
            "scene": case.scene,
            "spp": case.spp,
            "combiner": name,
            "scale": scale,
            "errors": {
                metric: [row[metric] for row in found if metric in row]
                for metric in found[0]
            },
            "seconds": {
                "sampling": None if case.sample is None else case.sample * case.spp,
                "denoising": chosen.denoised * denoising,
                "combining": seconds,
                "compiling": compiling,
            },
        }


@functools.cache
def _compiled(name: str) -> tuple[Callable, Callable]:
    """A traced combiner for one frame, and vmapped over factors and seeds.

    Kept: compiled anew for every case, programs that were given up made libgcc crash.
    """
    combine = combiners()[name].combine
    over_seeds = jax.vmap(combine, (0, None))
    return jax.jit(combine), jax.jit(jax.vmap(over_seeds, (None, 0)))


def _denoising(frame: Frame, repeats: int) -> float:
    """Median seconds of Open Image Denoise on a frame."""
    guides = {"albedo": frame.albedo, "normal": frame.normal}
    denoise = functools.partial(oidn.denoise, frame.color, **guides)
    return _timed(denoise, repeats)[1]


def digest_of(case: Case) -> str:
    """Hash of a case's pixels.

    Args:
        case: the frames.

    Returns:
        hexadecimal digits.
    """
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(case.frames):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def key_of(pixels: str, *rest: str | float) -> str:
    """Hash of all that a result depends on.

    Args:
        pixels: by `digest_of`.
        rest: names and numbers.

    Returns:
        hexadecimal digits.
    """
    said = json.dumps([pixels, jscomb.__version__, *rest])
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def results(path: pathlib.Path, *, quick: bool = False) -> list[Record]:
    """What an experiment that only reads results begins with.

    Args:
        path: file of `Results`.
        quick: measure the quick sweep into it first, in a folder beside it.

    Returns:
        the records.

    Raises:
        ValueError: if there are none.
    """
    if quick:
        run(Config(path.with_suffix(""), path, quick=True))
    if not (found := Results(path).values):
        raise ValueError(f"{path} has no results of experiments.comparison.sweep")
    return list(found.values())


def run(
    config: Config, *, change: Callable[[Case], Case] = lambda case: case
) -> list[Record]:
    """Measure what is missing.

    Args:
        config: what to sweep over.
        change: to make of every case before it is measured.

    Returns:
        the records of this configuration.
    """
    if config.quick:
        config = dataclasses.replace(config, **QUICK)
    kept, records = Results(config.results), []
    bar = tqdm(unit="combiner")
    for case in map(change, cases(config)):
        pixels = digest_of(case)
        # Once for all combiners, whose costs are compared.
        of_case = functools.partial(_denoising, case.frames[0], config.repeats)
        denoising = functools.cache(of_case)
        for name in config.combiners:
            bar.set_description(f"{case.scene} {case.spp} {name}")
            scales = config.scales if combiners()[name].traced else (1.0,)
            keys = [key_of(pixels, name, scale, config.repeats) for scale in scales]
            # Only if a factor is missing: all factors are measured at once.
            made = functools.cache(
                lambda c=case, n=name, d=denoising: list(
                    measure(c, n, config, denoising=d())
                )
            )
            records += [
                kept.get(key, lambda number=number, made=made: made()[number])
                for number, key in enumerate(keys)
            ]
            bar.update()
    bar.close()
    return records


if __name__ == "__main__":
    tool(Config, run)
