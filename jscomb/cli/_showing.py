"""`jscomb demo` and `info`."""

import functools
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jscomb import exr, methods
from jscomb.cli import _tables as tables
from jscomb.cli._combining import FramePath, SampleCount, by_tier
from jscomb.denoisers import oidn
from jscomb.exr import dialects
from jscomb.frame import Frame
from jscomb.typing import Image

TIMED_RUNS = 7
SHOWN = "denoised", "james-stein", "whitened", "njs", "pd", "dsc"
TIERS = tuple(methods.TIERS)
_DEMO_FOLDER = Path("jscomb-demo")


def demo(*, out: Path = _DEMO_FOLDER) -> None:
    """Combine the bundled frames and print the error of the combiners.

    The frames are of one scene, path traced with 64 and with 1024 samples a pixel, and
    denoised by Open Image Denoise.

    Args:
        out: folder for the pictures and the combined frames.
    """
    from jscomb import plots  # matplotlib is slow to import

    out.mkdir(parents=True, exist_ok=True)
    frames = {name: exr.read_frame(file) for name, file in exr.bundled().items()}
    by_samples = sorted(frames.items(), key=lambda item: float(item[1].samples or 0))
    table, shown, ms = {}, [], {}
    for name, frame in by_samples:
        spp = f"{tables.samples(frame)} spp"
        print(f"{spp}:")
        combined, ms = _all_methods(frame)
        for tier in TIERS:
            start = time.perf_counter()  # of the second frame without compilation
            combined[tier] = jax.block_until_ready(by_tier(frame, tier).image)
            ms[tier] = f"{1e3 * (time.perf_counter() - start):.0f}"
        for method, image in combined.items():
            exr.write_image(out / f"{name}-{method}.exr", image)
        images = {"path tracing": frame.color, **combined}
        table[spp] = tables.errors(images, frame)
        shown.append((frame, {TIERS[-1]: combined[TIERS[-1]]}))
    size = tables.size(by_samples[0][1])
    print(f"relative L2 of one scene, {size}, and the time of each step")
    tables.print_table({**table, "ms": ms})
    print("denoised is the image by Open Image Denoise, and its time.")
    picture = out / "comparison.png"
    plots.comparison(picture, shown)
    print(f"wrote {picture} and the combinations as EXR to {out.resolve()}")


def info(frame: FramePath, /, *, samples: SampleCount = None) -> None:
    """Describe a frame: dialect, buffers, sizes, samples, invalid pixels.

    Args:
        frame: EXR file of any known renderer, or a Tungsten directory.
        samples: samples a pixel, where the file does not say.
    """
    path, missing = frame, None
    try:
        loaded = exr.read_frame(path, samples=samples)
    except ValueError as error:
        loaded, missing = exr.read_frame(path, statistics=False), error
    invalid = int((~loaded.valid).sum())
    print(f"{path}: {dialects.recognise(os.fspath(path))}")
    if missing:
        print(f"  no variance     {missing}")
    print(f"  size            {tables.size(loaded)}")
    count = loaded.sub_buffers
    spp = tables.samples(loaded)
    print(f"  samples         {spp} a pixel in {count} sub-buffer(s)")
    print(f"  invalid pixels  {invalid}")
    print(f"  median luminance {float(loaded.median_luminance):.4g}")
    stored: dict[str, Any] = {
        n: b for n, b in loaded.buffers._asdict().items() if b is not None
    }
    stored |= {f"biased {name}": e.image for name, e in loaded.estimates.items()}
    if loaded.reference is not None:
        stored["reference"] = loaded.reference.image
    for name, buffer in stored.items():
        good = np.asarray(buffer)[np.isfinite(buffer)]
        low, mean, high = (
            (good.min(), good.mean(), good.max()) if good.size else (np.nan,) * 3
        )
        print(f"  {name:<15} {low:10.4g} .. {high:<10.4g} mean {mean:.4g}")
    if path.is_file():
        for name, value in exr.read_provenance(path).items():
            print(f"  made with       {name} = {value}")


def _all_methods(frame: Frame) -> tuple[dict[str, Image], dict[str, str]]:
    """Combinations of a denoised frame, and the milliseconds that each takes."""
    images, ms = {}, {}
    for method in SHOWN:
        make = lambda frame, method=method: methods.plan(
            jax.random.key(0), frame, method=method, biased=None
        ).whole()
        try:
            images[method], time_of_one = _timed(make, frame)
        except ImportError as error:
            print(f"{method}: skipped: {error}")
            continue
        ms[method] = f"{time_of_one:.1f}"
    ms["denoised"] = ""  # its time is the denoiser's, where that is installed
    if oidn.available():
        guides = {"albedo": frame.albedo, "normal": frame.normal}
        denoise = functools.partial(oidn.denoise, **guides)
        ms["denoised"] = f"{_timed(denoise, frame.color)[1]:.1f}"
    return images, ms


def _timed(function: Callable, *inputs: Any) -> tuple[Image, float]:
    """A result, and the median milliseconds of making it again."""
    result = jax.block_until_ready(function(*inputs))
    times = []
    for _ in range(TIMED_RUNS):
        start = time.perf_counter()
        jax.block_until_ready(function(*inputs))
        times.append(1e3 * (time.perf_counter() - start))
    return result, statistics.median(times)
