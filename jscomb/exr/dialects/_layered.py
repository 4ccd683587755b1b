"""Read files whose layers have names that tell what they are.

This is how pbrt, Cycles, Arnold, Karma, RenderMan, V-Ray, Redshift, LuxCore and most
compositors write: `_names` has the table, `_choice` chooses.
"""

from typing import Any

import numpy as np

from jscomb.exr._choice import Choice, channels_of, choose, named_layer
from jscomb.exr._files import Headers, Part, read_pixels
from jscomb.exr._layers import Layer, layers_of
from jscomb.exr.dialects._images import (
    Arguments,
    Options,
    Reading,
    Source,
    clipped,
    data_window,
    finite_depth,
    placed,
    variance_of_mean,
)


def layered(
    source: Source, path: str, options: Options, *, unit: str | None = None
) -> Reading:
    """Read a file by the names of its layers; `unit` of its variance, if known."""
    headers = source.headers(path)
    layers = layers_of(headers)
    if not layers and headers.unusable:
        raise ValueError(next(iter(headers.unusable.values())))
    choice = choose(layers, options.wanted)
    roles = _roles(choice, options)
    wanted: dict[int, set[str]] = {}
    for role, layer in roles.items():
        wanted.setdefault(layer.part, set()).update(channels_of(layer, role))
    main = choice.color or choice.denoised
    assert main is not None
    alpha = None
    if choice.alpha is not None:
        alpha = choice.alpha.part, channels_of(choice.alpha, "alpha")[0]
        wanted.setdefault(alpha[0], set()).add(alpha[1])
    parts = read_pixels(
        headers, None if options.everything else wanted, max_bytes=options.max_bytes
    )
    images = {role: _image(parts, layer, role, main) for role, layer in roles.items()}
    samples = options.samples or _samples(parts, main)
    unit = unit or choice.unit
    arguments, missing = _arguments(images, samples), ""
    if choice.variance is not None and {"variance", "color"} <= images.keys():
        try:
            arguments["variance"] = _variance(images, samples, unit, choice.variance)
        except ValueError as error:
            missing = str(error)
    return Reading(
        arguments,
        path,
        main,
        parts,
        {role: channels_of(layer, role) for role, layer in roles.items()}
        | ({} if alpha is None else {"alpha": [alpha[1]]}),
        [*_skipped(headers), *choice.notes],
        choice,
        missing,
        alpha,
    )


def overridden(source: Source, read: Reading, options: Options) -> Reading:
    """Take layers that a user names, where a dialect has chosen by itself.

    Raises:
        ValueError: if the dialect has no layers, or a name is not among them.
    """
    given = options.wanted._asdict()
    wanted = {name: layer for name, layer in given.items() if layer is not None}
    if read.choice is not None or not wanted:
        return read
    if read.color is None or "layer" in wanted:
        named = ", ".join(f"--{name}" for name in wanted)
        raise ValueError(f"its layers cannot be chosen ({named})")
    layers = layers_of(source.headers(read.file))
    arguments, missing = dict(read.arguments), read.missing
    for name, layer in wanted.items():
        found, unit = named_layer(layers, name, layer)
        image = _image(read.parts, found, name, read.color)
        if name == "variance":
            images = {"variance": image, "color": np.asarray(arguments["color"])}
            image, missing = _variance(images, options.samples, unit, found), ""
        arguments[name] = clipped(image) if name == "albedo" else image
    return read._replace(arguments=arguments, missing=missing)


def _skipped(headers: Headers) -> list[str]:
    """Lines on the parts that cannot be used."""
    return [
        f"part {headers.parts[number].name or number}: skipped: {why}"
        for number, why in headers.unusable.items()
    ]


def _roles(choice: Choice, options: Options) -> dict[str, Layer]:
    """The layers to read, by what they are taken for."""
    roles = {"color": choice.color, "denoised": choice.denoised, **choice.features}
    if options.statistics:
        roles["variance"] = choice.variance
    return {role: layer for role, layer in roles.items() if layer is not None}


def _image(parts: list[Part], layer: Layer, role: str, main: Layer) -> np.ndarray:
    """A layer as float32 [H,W,C] on the window of the colour."""
    part = parts[layer.part]
    names = channels_of(layer, role)
    if len(names) == 1 and role in ("color", "denoised", "variance"):
        names *= 3
    image = np.empty((*part.channels[names[0]].shape, len(names)), np.float32)
    for number, name in enumerate(names):
        image[..., number] = part.channels[name]
    return placed(image, data_window(part), data_window(parts[main.part]))


def _samples(parts: list[Part], main: Layer) -> int | float | None:
    """The samples a pixel that the header states."""
    group = main.group or main.part_name
    names = ["samplesPerPixel", f"cycles.{group}.samples"]
    attributes: dict[str, Any] = {}
    for part in [parts[main.part], *parts]:
        attributes = {**part.attributes, **attributes}
    for name in names:
        value = attributes.get(name)
        if isinstance(value, str) and name.startswith("cycles.") and value.isdigit():
            return int(value)
        if isinstance(value, int | float) and not name.startswith("cycles."):
            return value
        if value is not None:
            raise ValueError(f"attribute {name} is {value!r}, not a number")
    return None


def _arguments(images: dict[str, np.ndarray], samples: int | float | None) -> Arguments:
    """The arguments of `make_frame`."""
    found: Arguments = {"samples": samples}
    if "color" in images:
        found["color"] = images["color"]
    if "denoised" in images:
        found["estimates"] = {"denoised": images["denoised"]}
    found["albedo"] = clipped(images.get("albedo"))
    found["normal"] = images.get("normal")
    if "depth" in images:
        found["depth"] = finite_depth(images["depth"])
    if "visibility" in images:
        found["visibility"] = images["visibility"]
    return found


def _variance(
    images: dict[str, np.ndarray], samples: int | float | None, unit: str, layer: Layer
) -> np.ndarray:
    """The variance of the mean.

    Renderers write 0 where nothing was hit: missing, not exact, if there is radiance.
    """
    stored = images["variance"]
    if unit == "mean":
        return stored
    variance = variance_of_mean(
        stored, samples, f"the variance ({layer.shown})", unbiased=unit == "sample"
    )
    known = [stored, *(images[n] for n in ("albedo", "normal") if n in images)]
    hit = np.any([np.any(image != 0, axis=-1) for image in known], axis=0)
    black = np.all(images["color"] == 0, axis=-1)
    return np.where(np.logical_or(hit, black)[..., None], variance, np.nan)
