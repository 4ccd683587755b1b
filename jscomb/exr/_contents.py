"""What was read of a file: the frame, and all that has to be written again."""

import os
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jscomb.exr import _color, native
from jscomb.exr._choice import Wanted
from jscomb.exr._files import MAX_BYTES, Headers, Part, window
from jscomb.exr._layers import Layer
from jscomb.exr.dialects import DIALECTS, recognise
from jscomb.exr.dialects._images import (
    Options,
    Reading,
    Source,
    Window,
    data_window,
    placed,
)
from jscomb.exr.dialects._layered import overridden
from jscomb.frame import Frame, make_frame
from jscomb.typing import Image

_NAMES = {np.float16: "half", np.float32: "float", np.uint32: "uint"}


class Channels(NamedTuple):
    """A layer of a file, for a list.

    Attributes:
        part: name of the part, where there are several.
        names: of its channels.
        kind: half, float, uint, or several of them.
        taken_for: channels by role, such as albedo.
    """

    part: str
    names: list[str]
    kind: str
    taken_for: dict[str, list[str]]


class Contents(NamedTuple):
    """What was read of a file or directory, and is needed to write its like.

    Attributes:
        path: as given.
        file: the file with the colour.
        dialect: a key of `dialects.DIALECTS`.
        frame: of the data window; None where there is only a denoised image.
        denoised: what the renderer or a denoiser has denoised, [H,W,3]; None if there
            is none.
        window: the data window of the colour: left, top, width, height.
        display: the display window.
        alpha: [H,W], NaN where it is unknown; None if there is none.
        chromaticities: of its primaries and white; None if not stated.
        layers: all channels.
        notes: lines for the user.
        rivals: names of layers that could have been taken too, by role.
        color: the layer of the colour; None in jscomb's own format.
        parts: of `file`; with all pixels if everything was asked for.
        unusable: numbers of parts that have no flat image.
        provenance: where the file came from, if jscomb wrote it.
        missing: why a variance that the file has was not read; else empty.
    """

    path: str
    file: str
    dialect: str
    frame: Frame | None
    denoised: Image | None
    window: Window
    display: Window
    alpha: np.ndarray | None
    chromaticities: tuple[float, ...] | None
    layers: list[Channels]
    notes: list[str]
    rivals: dict[str, list[str]]
    color: Layer | None
    parts: list[Part]
    unusable: dict[int, str]
    provenance: dict[str, Any]
    missing: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the data window."""
        return self.window[3], self.window[2]

    @property
    def image(self) -> Image:
        """The denoised image if there is one beside the noise, else the colour."""
        if self.denoised is not None and self.dialect != "result":
            return self.denoised
        assert self.frame is not None
        return self.frame.color

    @property
    def median_luminance(self) -> float:
        """The median of the positive luminances, by the file's own primaries."""
        weights = _color.luminance_weights(self.chromaticities)
        image = self.image if self.frame is None else self.frame.color
        luminance = np.asarray(image, np.float64) @ weights
        lit = luminance[np.isfinite(luminance) & (luminance > 0)]
        return float(np.median(lit)) if lit.size else 1.0

    @property
    def empty(self) -> np.ndarray:
        """Where a transparent film shows nothing: no alpha and no radiance, [H,W,1]."""
        if self.alpha is None or self.frame is None:
            return np.zeros((*self.size, 1), bool)
        black = np.all(np.asarray(self.frame.color) == 0, axis=-1)
        return ((self.alpha == 0) & black)[..., None]


def read_contents(
    path: str | os.PathLike | Source,
    *,
    samples: int | None = None,
    dialect: str | None = None,
    statistics: bool = True,
    layer: str | None = None,
    albedo: str | None = None,
    normal: str | None = None,
    variance: str | None = None,
    everything: bool = False,
    max_bytes: int = MAX_BYTES,
) -> Contents:
    """Read a file with all that it takes to write one of the same layout.

    Each file is opened twice: for its header, and for the pixels that are needed.

    Args:
        path: EXR file, or directory of a Tungsten frame, or a `Source` of it.
        samples: samples a pixel, where the file does not state them; overrides it.
        dialect: key of `dialects.DIALECTS`; None to recognise it.
        statistics: read variances.
        layer: the noisy colour, or its stereo view or view layer; None to choose by
            the usual names.
        albedo: a layer.
        normal: a layer.
        variance: a layer; NAME:sample or NAME:mean says what it is of, else its name.
        everything: read all channels, also those that make no frame.
        max_bytes: memory that the pixels that are read of each file may take.

    Returns:
        what was read.

    Raises:
        FileNotFoundError: if `path` does not exist.
        ValueError: if the file cannot be read; names it and says why.

    Example:
        >>> from jscomb import exr
        >>> contents = exr.read_contents(exr.bundled()["cornell-glass-64"])
        >>> print(contents.dialect, contents.window)
        jscomb (0, 0, 192, 192)
    """
    source = path if isinstance(path, Source) else open_source(path)
    path = source.path
    if samples is not None and samples < 1:
        raise ValueError(f"{path}: samples must be at least 1, got {samples}")
    wanted = Wanted(layer, albedo, normal, variance)
    options = Options(samples, statistics, max_bytes, wanted, everything)
    name = dialect
    try:
        name = name or _dialect(source, wanted)
        if name not in DIALECTS:
            known = ", ".join(DIALECTS)
            raise ValueError(f"unknown dialect {name!r}, expected one of {known}")
        read = DIALECTS[name].read(source, path, options)
        return _contents(source, name, overridden(source, read, options))
    except _MALFORMED as error:
        if path in str(error):
            raise ValueError(str(error)) from None
        raise ValueError(_named(path, name, str(error))) from None


def _named(path: str, dialect: str | None, error: str) -> str:
    """An error with its file."""
    read_as = "" if dialect in (None, "layers") else f"read as {dialect}: "
    return f"{path}: {read_as}{error}"


# Raised by attributes and channels of unexpected types, sizes or encodings.
_MALFORMED = (ValueError, TypeError, AttributeError, KeyError, IndexError)


def open_source(path: str | os.PathLike, *, digests: bool = False) -> Source:
    """Return the files of a frame, to look at before their pixels are read.

    Args:
        path: EXR file, or directory of a Tungsten frame.
        digests: of all files that reading it opens.

    Returns:
        the source.

    Raises:
        FileNotFoundError: if `path` does not exist.
        ValueError: if a file cannot be read.

    Example:
        >>> from jscomb import exr
        >>> source = exr.open_source(exr.bundled()["cornell-glass-64"], digests=True)
        >>> print([len(digest) for digest in source.digests().values()])
        [64]
    """
    path = os.fspath(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such file or directory")
    source = Source(path, digests=digests)
    if digests:
        for file in DIALECTS[_dialect(source, Wanted())].files(path):
            source.headers(file)
    return source


def _dialect(source: Source, wanted: Wanted) -> str:
    """The dialect of a source."""
    path = source.path
    if os.path.isdir(path):
        return "tungsten"
    name = recognise(path, headers=source.headers(path))
    by_names = wanted.layer is not None and name in ("mitsuba", "njs")
    return "layers" if by_names else name


def _contents(source: Source, dialect: str, read: Reading) -> Contents:
    """What was read, with the rest of its file."""
    headers = source.headers(read.file)
    native_frame = read.arguments.get("frame")
    frame = native_frame
    if frame is None and "color" in read.arguments:
        frame = make_frame(**read.arguments)
    part = read.parts[read.color.part if read.color else 0]
    at = data_window(part)
    denoised = None
    if read.choice is not None and read.choice.denoised is not None:
        denoised = jnp.asarray(read.arguments["estimates"]["denoised"])
    return Contents(
        source.path,
        read.file,
        dialect,
        frame,
        denoised,
        at,
        window(part.attributes, "displayWindow"),
        _alpha(read, at),
        _color.stated(part.attributes),
        _listed(headers, read),
        [*headers.notes, *read.notes],
        {} if read.choice is None else _shown(read.choice.rivals),
        read.color,
        read.parts,
        headers.unusable,
        native.provenance(headers.parts),
        _named(source.path, dialect, read.missing) if read.missing else "",
    )


def _alpha(read: Reading, at: Window) -> np.ndarray | None:
    """The alpha of the colour."""
    place = read.alpha
    if place is None and read.color is not None and "A" in read.color.channels:
        place = read.color.part, read.color.channels["A"]
    if place is None or place[1] not in read.parts[place[0]].channels:
        return None
    part = read.parts[place[0]]
    return placed(part.channels[place[1]].astype(np.float32), data_window(part), at)


def _shown(rivals: dict[str, list[Layer]]) -> dict[str, list[str]]:
    """Names of layers by role."""
    return {role: [each.shown for each in found] for role, found in rivals.items()}


def _listed(headers: Headers, read: Reading) -> list[Channels]:
    """All channels of a file, by layer."""
    color = read.color.part if read.color else None
    roles: dict[tuple[int | None, str], list[str]] = {}
    choice = read.choice
    if choice is not None:
        layers = {"color": choice.color, "denoised": choice.denoised}
        layers |= {**choice.features, "alpha": choice.alpha}
        layers["variance"] = choice.variance
        for role, layer in layers.items():
            for name in read.taken.get(role, []):
                assert layer is not None
                roles.setdefault((layer.part, name), []).append(role)
    elif read.color is not None:
        for name in read.color.color or []:
            roles[color, name] = ["color"]
    several = len(headers.types) > 1
    groups: dict[tuple[str, int], list[str]] = {}
    for number, types in enumerate(headers.types):
        label = headers.parts[number].name if several else ""
        for name in types:
            prefix = name.rpartition(".")[0]
            groups.setdefault((prefix or label, number), []).append(name)
    found = []
    for (_, number), names in sorted(groups.items()):
        kinds = {_NAMES[headers.types[number][name]] for name in names}
        taken: dict[str, list[str]] = {}
        for name in names:
            for role in roles.get((number, name), []):
                taken.setdefault(role, []).append(name)
        part = headers.parts[number].name or str(number) if several else ""
        found.append(Channels(part, names, ", ".join(sorted(kinds)), taken))
    return found
