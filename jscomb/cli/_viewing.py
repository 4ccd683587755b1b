"""`jscomb compare` and `view`: images beside a reference."""

import functools
import sys
from collections.abc import Callable, Sequence
from json import dumps
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from tqdm import tqdm

from jscomb import exr, metrics
from jscomb.cli._combining import MAX_MEMORY, MaxMemory
from jscomb.exr import Contents
from jscomb.frame import Reference
from jscomb.numerics.guards import finite
from jscomb.numerics.tiles import compiled
from jscomb.typing import Image, Mask

_Files = tyro.conf.Positional[tuple[Path, ...]]
_File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
_Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
_Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")]
_Host = Annotated[str | None, tyro.conf.arg(metavar="HOST[:PORT]")]
_Flag = tyro.conf.FlagCreatePairsOff[bool]


Skipped = dict[str, list[str]]
"""What is skipped, by the reason."""


class _Metric(NamedTuple):
    """An error of an image, by its name in the command.

    Attributes:
        title: in the printed table.
        measure: of an image and its reference.
        masked: takes the pixels that count; others take finite images only.
        less_noise: takes the difference of the reference's halves.
    """

    title: str
    measure: Callable[..., Any]
    masked: bool = True
    less_noise: bool = False


METRICS = {
    "relative-l2": _Metric("relative L2", metrics.rel_l2),
    "relative-l2-less-noise": _Metric(
        "relative L2, less the reference's noise", metrics.rel_l2, less_noise=True
    ),
    "rmse": _Metric("RMSE", metrics.rmse),
    "smape": _Metric("SMAPE", metrics.smape),
    "psnr": _Metric("PSNR in dB", metrics.psnr),
    "ssim": _Metric("SSIM", metrics.ssim),
    "dssim": _Metric("DSSIM", metrics.dssim),
    "flip": _Metric("FLIP", metrics.flip, masked=False),
    "hdr-flip": _Metric("HDR-FLIP", metrics.hdr_flip, masked=False),
}
MAPS = {
    "relative-l2": metrics.rel_l2_map,
    "flip": metrics.flip_map,
    "hdr-flip": metrics.hdr_flip_map,
}


def compare(
    images: _Files,
    /,
    *,
    reference: _File = None,
    metrics: _Names = tuple(METRICS),
    maps: _Folder = None,
    json: _Flag = False,
    max_memory: MaxMemory = MAX_MEMORY,
) -> None:
    """Print the errors of images against a reference.

    Errors are over the pixels that are finite in all of them. Lower is better, but for
    PSNR and SSIM. PSNR, SSIM, DSSIM and FLIP are of the tone-mapped images.

    Args:
        images: EXR files; of each its denoised image is compared if it has one, else
            its colour. Without --reference the last one is the reference.
        reference: EXR file; the reference in it if it is a frame that has one, else its
            denoised image or its colour.
        metrics: what to print; by default all.
        maps: folder for pictures of the errors of every pixel: relative squared error,
            and FLIP where that is installed.
        json: print one line of JSON instead, without numbers that are not finite.
        max_memory: mebibytes that the pixels of one file may take in memory.
    """
    if unknown := [name for name in metrics or ("",) if name not in METRICS]:
        known = ", ".join(METRICS)
        raise ValueError(f"--metrics {unknown[0]}: expected some of {known}")
    if reference is None:
        if len(images) < 2:
            raise ValueError("compare needs an image and a reference: two files")
        images, reference = images[:-1], images[-1]
    images, against = tuple(dict.fromkeys(images)), _read(reference, max_memory)
    truth, shown = _reference(against), {}
    for name, path in _named(images).items():
        found = _read(path, max_memory)
        shown[name] = _beside(found.image, found, against)
    mask = finite(truth.image, *shown.values())
    excluded = int((~mask).sum())
    if excluded == mask.size:
        files = " and ".join(map(str, (*images, reference)))
        raise ValueError(f"{files} have no finite pixel in common")
    skipped: Skipped = {}
    errors = _errors(shown, truth, mask, metrics, skipped)
    if maps is not None:
        _write_maps(maps, shown, truth.image, skipped)
    if json:
        found = {"reference": str(reference), "pixels": mask.size, "excluded": excluded}
        print(dumps({**found, "images": errors, "skipped": _said(skipped)}))
        return
    _print(errors, metrics)
    for line in _said(skipped):
        print(line)
    if excluded:
        print(f"{excluded} of {mask.size} pixels are not finite and were excluded")


def view(
    images: _Files,
    /,
    *,
    reference: _File = None,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("view.html"),
    maps: _Names = ("flip",),
    open: _Flag = False,
    tev: _Host = None,
    max_memory: MaxMemory = MAX_MEMORY,
) -> None:
    """Write a page to look at images: panes, flips, errors, values, insets.

    The page needs no network and no server: open it in a browser. Its address holds
    what is looked at.

    Args:
        images: EXR files; of a frame its colour and its estimates.
        reference: EXR file; the reference in it if it is a frame that has one, else its
            denoised image or its colour. By default that of the first frame that has
            one.
        out: HTML file to write.
        maps: errors to compute beside the relative squared ones: flip, hdr-flip.
        open: open the page in the browser.
        tev: send the images to a tev that runs there instead of writing a page; its
            usual place is localhost:14158.
        max_memory: mebibytes that the pixels of one file may take in memory.
    """
    from jscomb import viewer  # matplotlib is slow to import

    if unknown := [name for name in maps if name not in list(MAPS)[1:]]:
        raise ValueError(f"--maps {unknown[0]}: expected some of flip, hdr-flip")
    if not images:
        raise ValueError("view needs an image: jscomb view FILE ...")
    images = tuple(dict.fromkeys(images))
    shown, truth = _shown(images, reference, max_memory)
    made, skipped = {}, {}
    if truth is not None and tev is None:
        made = {kind: _maps(kind, shown, truth.image, skipped) for kind in maps}
    for line in _said(skipped):
        print(line)
    title = ", ".join(path.stem for path in images)
    scene = viewer.make_scene(title, shown, reference=truth, maps=made)
    if tev is not None:
        host, _, port = tev.partition(":")
        if port and not port.isdecimal():
            raise ValueError(f"--tev {tev}: expected HOST or HOST:PORT")
        where = {"port": int(port)} if port else {}
        viewer.send_to_tev(scene, host=host, **where)
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(viewer.page([scene], title=title))
    print(f"wrote {out}, {out.stat().st_size / 1e6:.1f} MB: open it in a browser")
    if open:
        import webbrowser

        webbrowser.open(out.resolve().as_uri())


def _shown(
    paths: Sequence[Path], reference: Path | None, max_memory: int
) -> tuple[dict[str, Image], Reference | None]:
    """All images of files by a name each, and the reference of them."""
    against = None if reference is None else _read(reference, max_memory)
    truth = None if against is None else _reference(against)
    shown: dict[str, Image] = {}
    for name, path in _named(paths).items():
        found = _read(path, max_memory)
        against = against or found
        if truth is None and found.frame is not None and found.frame.reference:
            r, noise = found.frame.reference
            truth = Reference(_beside(r, found, against), noise)
        for own, image in _images(found).items():
            title = f"{name} {own}" if own and len(paths) > 1 else own or name
            shown[title] = _beside(image, found, against)
    return shown, truth


def _images(contents: Contents) -> dict[str, Image]:
    """The colour of a file, without a name, and its estimates."""
    if contents.frame is None:
        return {"": contents.image}
    estimates = contents.frame.estimates
    return {"": contents.frame.color} | {n: e.image for n, e in estimates.items()}


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """Files by their stems, or by their whole names where those are not clear."""
    stems = [path.stem for path in paths]
    whole = len(set(stems)) < len(stems) or "reference" in stems
    return {str(path) if whole else path.stem: path for path in paths}


def _read(path: Path, max_memory: int) -> Contents:
    """A file; what there is to say of it goes to standard error."""
    found = exr.read_contents(path, statistics=False, max_bytes=max_memory * 2**20)
    for note in found.notes:
        print(f"{path}: {note}", file=sys.stderr)
    return found


def _reference(contents: Contents) -> Reference:
    """The reference of a frame that has one, else the image."""
    frame = contents.frame
    return (frame and frame.reference) or Reference(contents.image)


def _beside(image: Image, contents: Contents, target: Contents) -> Image:
    """An image of one file as it goes with another."""
    made, notes = exr.convert(image, contents, target)
    for note in notes:
        print(note, file=sys.stderr)
    return made


def _errors(
    images: dict[str, Image],
    truth: Reference,
    mask: Mask,
    names: Sequence[str],
    skipped: Skipped,
) -> dict[str, dict[str, float | None]]:
    """Errors by image and metric."""
    r, noise = truth
    errors: dict[str, dict[str, float | None]] = {name: {} for name in images}
    for key in tqdm(names, unit="metric", disable=None, leave=False):
        title, measure, masked, less_noise = METRICS[key]
        if less_noise and noise is None:
            continue
        options: dict[str, Any] = {"mask": mask} if masked else {}
        measure = compiled(measure) if masked else measure
        if less_noise:
            options["half_difference"] = noise
        for name, image in images.items():
            make = functools.partial(measure, image, r, **options)
            value = _unless_skipped(f"{title} of {name}", make, skipped)
            if value is not None:
                errors[name][key] = float(value) if np.isfinite(value) else None
    return errors


def _maps(
    kind: str, images: dict[str, Image], reference: Image, skipped: Skipped
) -> dict[str, np.ndarray]:
    """Maps of errors by image."""
    made = {}
    for name, image in tqdm(images.items(), desc=kind, disable=None, leave=False):
        make = functools.partial(MAPS[kind], image, reference)
        error = _unless_skipped(f"map {kind} of {name}", make, skipped)
        if error is not None:
            made[name] = np.asarray(error)
    return made


def _unless_skipped(what: str, make: Callable[[], Any], skipped: Skipped) -> Any:
    """What is made; None, with the reason noted, where it cannot be."""
    try:
        return make()
    except (ValueError, ImportError, RuntimeError) as error:
        skipped.setdefault(str(error), []).append(what)
        return None


def _said(skipped: Skipped) -> list[str]:
    """A line for each reason."""
    return [f"{', '.join(what)} skipped: {reason}" for reason, what in skipped.items()]


def _write_maps(
    folder: Path, images: dict[str, Image], reference: Image, skipped: Skipped
) -> None:
    """Write pictures of errors."""
    from jscomb import plots  # matplotlib is slow to import

    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("relative-l2", "flip"):
        flat = {"limits": (0.0, 1.0), "logarithmic": False} if kind == "flip" else {}
        for name, error in _maps(kind, images, reference, skipped).items():
            title = f"{METRICS[kind].title} of {name}"
            file = "-".join(Path(name).with_suffix("").parts).strip("-/")
            plots.error_map(folder / f"{file}-{kind}.png", error, title=title, **flat)


def _print(errors: dict[str, dict[str, float | None]], names: Sequence[str]) -> None:
    """Print a table: metrics in rows, images in columns."""
    if len(errors) > 1:
        print(" " * 40 + "".join(f"  {name:>14}" for name in errors))
    width = 14 if len(errors) > 1 else 0
    for key in names:
        values = [row.get(key, "-") for row in errors.values()]
        if all(value == "-" for value in values):
            continue
        shown = ["inf" if v is None else v if v == "-" else f"{v:.6g}" for v in values]
        cells = "".join(f"  {value:>{width}}" for value in shown)
        print(f"{METRICS[key].title:>40}{cells}")
