"""`jscomb demo` and `info`."""

import functools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jscomb import exr, methods
from jscomb.cli import _tables as tables
from jscomb.cli._combining import (
    MAX_MEMORY,
    FramePath,
    LayerName,
    MaxMemory,
    SampleCount,
)
from jscomb.cli._making import by_tier
from jscomb.denoisers import oidn
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
        spp = f"{float(frame.samples or 0):g} spp"
        print(f"{spp}:")
        combined, ms = _all_methods(frame)
        for tier in TIERS:
            start = time.perf_counter()  # of the second frame without compilation
            made = by_tier(frame, tier)
            combined[tier] = jax.block_until_ready(made.image)
            ms[tier] = f"{1e3 * (time.perf_counter() - start):.0f}"
            print(made.sentence(frame))
        for method, image in combined.items():
            exr.write_image(out / f"{name}-{method}.exr", image)
        images = {"path tracing": frame.color, **combined}
        errors, excluded = tables.errors(images, frame)
        table[spp] = tables.rounded(errors)
        if excluded:
            print(excluded)
        shown.append((frame, {TIERS[-1]: combined[TIERS[-1]]}))
    size = tables.size(by_samples[0][1])
    print(f"relative L2 of one scene, {size}, and the time of each step")
    print(*tables.table({**table, "ms": ms}), sep="\n")
    print("denoised is the image by Open Image Denoise, and its time.")
    picture = out / "comparison.png"
    plots.comparison(picture, shown)
    print(f"wrote {picture} and the combinations as EXR to {out.resolve()}")


def info(
    frame: FramePath,
    /,
    *,
    samples: SampleCount = None,
    layer: LayerName = None,
    albedo: LayerName = None,
    normal: LayerName = None,
    variance: LayerName = None,
    max_memory: MaxMemory = MAX_MEMORY,
) -> None:
    """Describe a frame: dialect, channels, buffers, sizes, samples, invalid pixels.

    Args:
        frame: EXR file of any known renderer, or a Tungsten directory.
        samples: samples a pixel, where the file does not say.
        layer: the noisy colour in a file of several, a stereo view, or a view layer.
        albedo: the layer with the albedo.
        normal: the layer with the normals.
        variance: the layer with the variance.
        max_memory: mebibytes that the pixels of the file may take in memory.
    """
    contents = exr.read_contents(
        frame,
        samples=samples,
        layer=layer,
        albedo=albedo,
        normal=normal,
        variance=variance,
        max_bytes=max_memory * 2**20,
    )
    print(f"{contents.path}: {contents.dialect}")
    _print_file(contents)
    if contents.missing:
        print(f"  no variance     {contents.missing}")
    if contents.frame is not None:
        _print_frame(contents)
    else:
        _print_range("denoised alone", contents.image)
    for name, value in contents.provenance.items():
        if name != "made from":
            print(f"  made with       {_MADE_WITH.get(name, name)} = {value}")


# Of a render; its file may hold it merged into fewer sub-buffers.
_MADE_WITH = {"spp": "samples a pixel", "buffers": "sub-buffers rendered"}


def _print_file(contents: exr.Contents) -> None:
    """Channels, what was taken for what, windows, and what else there is to say."""
    for found in contents.layers:
        each = found.taken_for.items()
        taken = [f"{role} ({', '.join(names)})" for role, names in each]
        taken = taken if len(taken) > 1 else list(found.taken_for)
        taken = f": {', '.join(taken)}" if taken else ""
        part = f"part {found.part}: " if found.part else ""
        print(f"  channels        {part}{', '.join(found.names)} ({found.kind}){taken}")
    for role, others in contents.rivals.items():
        option = "layer" if role == "color" else role
        also = f"  could be {role}, too: {', '.join(others)}"
        print(also + (f" (--{option})" if option in _NAMED else ""))
    for note in contents.notes:
        print(f"  note            {note}")
    if contents.window != contents.display:
        left, top, *_ = contents.window
        x, y, width, height = contents.display
        print(f"  window          at {left}, {top} of {width}x{height} at {x}, {y}")
    if contents.chromaticities is not None:
        values = ", ".join(f"{value:g}" for value in contents.chromaticities)
        print(f"  chromaticities  {values}")


_NAMED = ("layer", "albedo", "normal", "variance")  # options


def _print_frame(contents: exr.Contents) -> None:
    """Size, samples, and the range of every buffer."""
    frame = contents.frame
    assert frame is not None
    count = frame.sub_buffers
    print(f"  size            {tables.size(frame)}")
    rendered = contents.provenance.get("buffers", count)
    merged = f", rendered in {rendered} and merged" if rendered != count else ""
    print(f"  samples         {tables.samples(frame)}{merged}")
    print(f"  invalid pixels  {int((~frame.valid).sum())}")
    print(f"  median luminance {contents.median_luminance:.4g}")
    if frame.buffers.variance is None and count < 2:
        print("  noise           unknown: neither variance nor half buffers (--halves)")
    stored: dict[str, Any] = {
        n: b for n, b in frame.buffers._asdict().items() if b is not None
    }
    stored |= {f"biased {name}": e.image for name, e in frame.estimates.items()}
    if frame.reference is not None:
        stored["reference"] = frame.reference.image
    for name, buffer in stored.items():
        _print_range(name, buffer)


def _print_range(name: str, buffer: Any) -> None:
    """The smallest, largest and mean finite value of a buffer."""
    good = np.asarray(buffer)[np.isfinite(buffer)]
    low, mean, high = (
        (good.min(), good.mean(), good.max()) if good.size else (np.nan,) * 3
    )
    print(f"  {name:<15} {low:10.4g} .. {high:<10.4g} mean {mean:.4g}")


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
