"""The command `jscomb`: combine, compare and describe rendered frames.

Errors of the input are one line on standard error and exit status 2.
"""

import contextlib
import functools
import io
import os
import pathlib
import re
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

import jscomb
from jscomb import choice, exr, metrics
from jscomb.denoisers import oidn
from jscomb.exr import dialects
from jscomb.frame import Biased, Frame, Reference
from jscomb.numerics.guards import finite
from jscomb.typing import Image

Path = pathlib.Path
_Frame = tyro.conf.Positional[Path]
_Samples = Annotated[int | None, tyro.conf.arg(metavar="N")]
_Biased = Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")]
_Budget = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
_Method = Literal["auto", "kept", "james-stein", "whitened", "njs", "pd", "dsc"]
TIMED_RUNS = 7
_DEMO_FOLDER = Path("jscomb-demo")


def demo(*, out: Path = _DEMO_FOLDER) -> None:
    """Combine the bundled frames and show the error of every method.

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
        spp = f"{_samples(frame)} spp"
        print(f"{spp}:")
        chosen = _choose(frame, "oidn", None)
        combined, ms = _all_methods(frame)
        for method, image in combined.items():
            exr.write_image(out / f"{name}-{method}.exr", image)
        images = {"path tracing": frame.color, **combined, "chosen": combined[chosen]}
        table[spp] = _errors(images, frame)
        shown.append((frame, {f"chosen: {chosen}": combined[chosen]}))
    size = _size(by_samples[0][1])
    print(f"relative L2 of one scene, {size}, and the time of each step")
    _print_table({**table, "ms": ms})
    print("kept is the image by Open Image Denoise, and its time.")
    picture = out / "comparison.png"
    plots.comparison(picture, shown)
    print(f"wrote {picture} and the combinations as EXR to {out.resolve()}")


def combine(
    frame: _Frame,
    /,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    biased: _Biased = None,
    method: _Method = "auto",
    budget: _Budget = None,
    samples: _Samples = None,
) -> None:
    """Combine a path-traced frame with a biased image into one better image.

    Args:
        frame: EXR file of any known renderer, or a Tungsten directory.
        out: EXR file to write.
        biased: EXR file of the biased image, or its name within the frame. By default
            the frame's only one; a frame without any is denoised by Open Image Denoise.
        method: kept, the biased image as it is; whitened, or james-stein as in the
            paper without its network; by a trained network njs (James-Stein), dsc
            (double shrinkage, needs halves) or pd (progressive, needs Open Image
            Denoise); auto is the one of least error by the half buffers, and whitened
            where there are none.
        budget: seconds that the method of auto may take; any by default.
        samples: samples a pixel, where the file does not say.
    """
    path, loaded = frame, exr.read_frame(frame, samples=samples)
    try:
        _ = loaded.variance
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    name, image = _biased_image(path, loaded, biased)
    whole = loaded.with_biased(name, image)
    chosen = _choose(whole, name, budget) if method == "auto" else method
    key = jax.random.key(0)
    try:
        combined = choice.combine(key, whole, name, method=chosen)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    about = {
        "jscomb": jscomb.__version__,
        "method": chosen,
        "frame": path.name,
        "biased": name,
        "input": exr.read_provenance(path) if path.is_file() else {},
    }
    exr.write_image(out, combined, provenance=about)
    print(f"wrote {out}: {_size(loaded)}, {name} {chosen}")
    if loaded.reference is not None:
        images = {"input": loaded.color, name: image.full, chosen: combined}
        _print_table({"relative L2": _errors(images, loaded)})


def compare(image: _Frame, reference: _Frame, /) -> None:
    """Print the errors of an image against a reference.

    Args:
        image: EXR file; its colour is compared.
        reference: EXR file; the reference in it if it is a frame that has one, else
            its colour.
    """
    a, frame = exr.read_image(image), exr.read_frame(reference, statistics=False)
    truth = frame.reference or Reference(frame.color)
    r, noise = truth
    if a.shape != r.shape:
        raise ValueError(f"{image} is {a.shape}, {reference} is {r.shape}")
    mask = finite(a, r)
    left_out = int((~mask).sum())
    if left_out == mask.size:
        raise ValueError(f"{image} and {reference} have no finite pixel in common")
    rows: dict[str, Any] = {"relative L2": metrics.rel_l2(a, r, mask=mask)}
    if noise is not None:
        rows["relative L2, less the reference's noise"] = metrics.rel_l2(
            a, r, mask=mask, half_difference=noise
        )
    rows["RMSE"] = metrics.rmse(a, r, mask=mask)
    rows["SMAPE"] = metrics.smape(a, r, mask=mask)
    rows["DSSIM"] = metrics.dssim(a, r, mask=mask)
    for name, measure in (("FLIP", metrics.flip), ("HDR-FLIP", metrics.hdr_flip)):
        try:
            rows[name] = measure(a, r)
        except (ValueError, ImportError, RuntimeError) as error:
            print(f"{name:>40}  not measured: {error}")
    for name, value in rows.items():
        print(f"{name:>40}  {float(value):.6g}")
    if left_out:
        print(f"{left_out} of {mask.size} pixels are not finite and were left out")


def info(frame: _Frame, /, *, samples: _Samples = None) -> None:
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
    print(f"  size            {_size(loaded)}")
    count = loaded.sub_buffers
    print(f"  samples         {_samples(loaded)} a pixel in {count} sub-buffer(s)")
    print(f"  invalid pixels  {invalid}")
    print(f"  exposure        {float(loaded.exposure):.4g} (median radiance)")
    stored: dict[str, Any] = {
        n: b for n, b in loaded.buffers._asdict().items() if b is not None
    }
    stored |= {f"biased {name}": b.full for name, b in loaded.biased.items()}
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


def main() -> None:
    """Run the command; the entry point of `jscomb`."""
    _use_compilation_cache()
    try:
        _parse()()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print("jscomb:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)


def _parse() -> Callable[[], None]:
    """The command line as a call to make; a wrong one is a `ValueError`."""

    def later(command: Callable) -> Callable:
        @functools.wraps(command)
        def bind(*args: Any, **kwargs: Any) -> Callable[[], None]:
            return lambda: command(*args, **kwargs)

        return bind

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.extras.subcommand_cli_from_dict(
                {c.__name__: later(c) for c in (demo, combine, compare, info)},
                prog="jscomb",
                description="Combine unbiased and biased Monte Carlo renderings.",
            )
    except SystemExit as end:
        if not end.code:
            raise  # --help
        text = re.sub(r"\x1b\[[0-9;]*m|[^\x00-\x7f]", " ", said.getvalue())
        raise ValueError(text.replace("-" * 8, "")) from None


def _use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache, so the second run starts fast."""
    if jax.__version_info__ < (0, 10, 2):
        return  # it would complain of every program that it finds there
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        folder = os.path.join(cache, "jscomb", "xla")
        jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _all_methods(frame: Frame) -> tuple[dict[str, Image], dict[str, str]]:
    """Combinations of a denoised frame, and the milliseconds that each takes."""
    images, ms = {}, {}
    for method in choice.METHODS:
        make = lambda frame, method=method: choice.combine(
            jax.random.key(0), frame, "oidn", method=method
        )
        try:
            images[method], time_of_one = _timed(make, frame)
        except ImportError as error:
            print(f"{method}: {error}")
            continue
        ms[method] = f"{time_of_one:.1f}"
    ms[choice.KEEP] = ""  # its time is the denoiser's, where that is installed
    if oidn.available():
        guides = {"albedo": frame.albedo, "normal": frame.normal}
        denoise = functools.partial(oidn.denoise, **guides)
        ms[choice.KEEP] = f"{_timed(denoise, frame.color)[1]:.1f}"
    return images, ms


def _choose(frame: Frame, name: str, budget: float | None) -> str:
    """The method that the half buffers choose; says why."""
    found = choice.choose(frame, name=name, budget=budget)
    if not found.trials:
        print("without half buffers of both images it is not known whether this helps")
    for trial in found.trials:
        print(f"by the half buffers, {trial.method:<12}{_said(trial)}")
    return found.method


def _said(trial: choice.Trial) -> str:
    """What was found out about a method, in a line."""
    if trial.change is None:
        return f"is not known: {trial.reason}"
    mean, error = map(float, trial.change)
    late = f", but {trial.reason}" if trial.reason else ""
    return f"adds {mean:+.2g} +- {error:.1g} relative L2{late}"


def _biased_image(path: Path, frame: Frame, choice: str | None) -> tuple[str, Biased]:
    """Name and image of what to combine with."""
    held = ", ".join(frame.biased) or "none"
    if choice in frame.biased:
        return choice, frame.biased[choice]
    if choice is not None:
        if not os.path.exists(choice):
            raise ValueError(
                f"--biased {choice}: neither a file nor a biased image in {path} "
                f"(it holds {held})"
            )
        image = exr.read_image(choice)
        if image.shape != frame.color.shape:
            raise ValueError(f"{choice} is {image.shape}, {path} {frame.color.shape}")
        return Path(choice).name, Biased(image)
    if len(frame.biased) > 1:
        raise ValueError(f"{path} holds several biased images, choose --biased: {held}")
    for name, image in frame.biased.items():
        return name, image
    if not oidn.available():
        raise ImportError(
            f"{path} holds no biased image: give --biased FILE, or pip install "
            '"jscomb[oidn]" to denoise it here'
        )
    return "oidn", oidn.denoise_frame(frame)


def _timed(function: Callable, *inputs: Any) -> tuple[Image, float]:
    """A result, and the median milliseconds of making it again."""
    result = jax.block_until_ready(function(*inputs))
    times = []
    for _ in range(TIMED_RUNS):
        start = time.perf_counter()
        jax.block_until_ready(function(*inputs))
        times.append(1e3 * (time.perf_counter() - start))
    return result, statistics.median(times)


def _errors(images: Mapping[str, Image], frame: Frame) -> dict[str, str]:
    """Relative L2, less the reference's noise, over the pixels that all images have."""
    assert frame.reference is not None
    r, noise = frame.reference
    mask = finite(r, *images.values())
    if left_out := int((~mask).sum()):
        print(f"{left_out} of {mask.size} pixels are not finite and were left out")
    error = functools.partial(metrics.rel_l2, half_difference=noise, mask=mask)
    return {name: f"{float(error(image, r)):.5f}" for name, image in images.items()}


def _print_table(columns: Mapping[str, Mapping[str, str]]) -> None:
    """Columns by title, rows by the first column's names."""
    names = list(next(iter(columns.values())))
    cells = [
        ["", *columns],
        *([n, *(c.get(n, "") for c in columns.values())] for n in names),
    ]
    for first, *others in cells:
        print(f"  {first:<22}{''.join(f'{c:>14}' for c in others)}".rstrip())


def _samples(frame: Frame) -> str:
    """Samples a pixel."""
    return "unknown" if frame.samples is None else f"{float(frame.samples):g}"


def _size(frame: Frame) -> str:
    """Width x height."""
    height, width = frame.color.shape[:2]
    return f"{width}x{height}"
