"""`jscomb info`."""

from typing import Any

import numpy as np

from jscomb import exr
from jscomb.cli import _tables as tables
from jscomb.cli._combining import (
    MAX_MEMORY,
    FramePath,
    LayerName,
    MaxMemory,
    SampleCount,
)


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
