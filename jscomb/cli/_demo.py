"""`jscomb demo`: every kind of method on one frame, its error beside its time."""

import contextlib
import importlib
import multiprocessing
import os
import signal
import statistics
import threading
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jscomb import exr, methods
from jscomb.cli import _tables as tables
from jscomb.cli import collect_rarely
from jscomb.denoisers import oidn
from jscomb.frame import Frame
from jscomb.typing import Image

NAME = "cornell-glass-256"
PAPERS = "james-stein", "whitened", "njs", "pd", "dsc"
TIERS = tuple(methods.TIERS)
_APART = "njs", "pd", "dsc"  # whose programs take as long to load as all others'
_SECONDS, _RUNS = 0.1, 7  # of repeating what is timed
_OUT = Path("jscomb-demo")

Made = dict[str, Image | str]
"""Images, or why there is none, by method."""


def demo(*, out: Path = _OUT) -> None:
    """Combine a bundled frame by several methods; print their errors and times.

    The frame is path traced with 256 samples a pixel, and denoised.

    Args:
        out: folder for the picture and the combined images.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = exr.bundled()[NAME]
    frame = exr.read_frame(file)
    spp = f"{float(frame.samples or 0):g} samples a pixel"
    print(f"combining a frame of {tables.size(frame)} pixels, {spp}:", flush=True)
    denoiser = ("oidn",) if oidn.available() else ()
    here = *TIERS, *denoiser, *(name for name in PAPERS if name not in _APART)
    with _other_process(file, _APART) as other:
        made = _made(frame, here)
        importlib.import_module("jscomb.plots")  # matplotlib is slow to import
        made |= _received(other)
        ms = _ms(frame, here)
        other.send("time them")  # nothing else runs now
        ms |= _received(other)
        _tell(out, frame, made, ms)  # while the other process ends


def _tell(out: Path, frame: Frame, made: Made, ms: dict[str, str]) -> None:
    """Print the table, and write the images and their picture."""
    from jscomb import plots

    made["denoised"], ms["denoised"] = frame.estimates["oidn"].image, ms.pop("oidn", "")
    images = {"path tracing": frame.color} | {
        name: image
        for name in ("denoised", *PAPERS, *TIERS)
        if not isinstance(image := made[name], str)
    }
    errors, _ = tables.errors(images, frame)
    columns = {"error": tables.rounded(errors), "ms": ms}
    print(*tables.table(columns), sep="\n")
    for name in PAPERS:
        if isinstance(reason := made[name], str):
            print(f"{name} is left out: it {reason}")
    print("error: relative L2, of the light and not of the display; 0 is perfect")
    print("ms: milliseconds for this frame on this machine, after the first time")
    print("denoised: by Open Image Denoise; all below start from it")
    for name in (*PAPERS, *TIERS):
        if name in images:
            exr.write_image(out / f"{NAME}-{name}.exr", images[name])
    shown = {name: images[name] for name in ("path tracing", "denoised", TIERS[-1])}
    plots.comparison(out / "comparison.png", frame, shown)
    print(f"wrote {out / 'comparison.png'} and the images as EXR")
    best = out / f"{NAME}-{TIERS[-1]}.exr"
    print(f"look at them: jscomb view {exr.bundled()[NAME]} {best}")


@contextlib.contextmanager
def _other_process(file: Path, names: Sequence[str]) -> Iterator[Connection]:
    """Make images in another process: one can compile on one core only.

    First come the images, and, when asked for, the milliseconds of making each.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    arguments = theirs, file, names
    other = context.Process(target=_serve, args=arguments, daemon=True)
    other.start()
    theirs.close()
    try:
        with ours:
            yield ours
    finally:
        other.join()


def _serve(ours: Connection, file: Path, names: Sequence[str]) -> None:
    """What the other process does."""
    collect_rarely()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # the first process says that it ends
    threading.Thread(target=_end_with_the_first, daemon=True).start()
    frame = exr.read_frame(file)
    with contextlib.suppress(EOFError, BrokenPipeError), ours:  # the first has ended
        made = _made(frame, names)
        ours.send(
            {n: i if isinstance(i, str) else np.asarray(i) for n, i in made.items()}
        )
        ours.recv()
        there = [name for name in names if not isinstance(made[name], str)]
        ours.send(_ms(frame, there))


def _end_with_the_first() -> None:
    """End this process, whatever it computes, when the first one has ended."""
    first = multiprocessing.parent_process()
    assert first is not None
    first.join()
    os._exit(1)


def _received(other: Connection) -> dict:
    """What the other process sends."""
    try:
        return {
            name: jnp.asarray(each) if isinstance(each, np.ndarray) else each
            for name, each in other.recv().items()
        }
    except EOFError:
        raise RuntimeError(
            "demo: the second process has ended; its error is above"
        ) from None


def _made(frame: Frame, names: Sequence[str]) -> Made:
    """Images by method, or why there is none."""
    made: Made = {}
    for name in names:
        try:
            made[name] = _image(frame, name)
        except ImportError as error:
            made[name] = str(error).removeprefix(f"{name} ")
    return made


def _image(frame: Frame, name: str) -> Image:
    """An image by a method, a tier, or Open Image Denoise."""
    key = jax.random.key(0)
    if name == "oidn":
        image = oidn.denoise(frame.color, albedo=frame.albedo, normal=frame.normal)
    elif name in methods.TIERS:
        image = methods.combine(key, frame, method=name).image
    else:
        image = methods.plan(key, frame, method=name).whole()
    return jax.block_until_ready(image)


def _ms(frame: Frame, names: Sequence[str]) -> dict[str, str]:
    """Median milliseconds of making each image again."""
    found = {}
    for name in names:
        times: list[float] = []
        while len(times) < _RUNS and sum(times) < _SECONDS:
            start = time.perf_counter()
            _image(frame, name)
            times.append(time.perf_counter() - start)
        ms = 1e3 * statistics.median(times)
        found[name] = f"{ms:.1f}" if ms < 10 else f"{ms:.0f}"
    return found
