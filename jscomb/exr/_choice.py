"""Which layer of a file is taken for what."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from jscomb.exr._layers import Layer
from jscomb.exr._names import FEATURES, VARIANCES, plain

_UNITS = ("mean", "sample", "deviation")
_LISTED = 12  # channels in an error


class Wanted(NamedTuple):
    """The layers that a user names; None to go by the table of names.

    Attributes:
        layer: the noisy colour, its view, or its view layer.
        albedo: a layer; this and the others may be files, which are not looked at here.
        normal: a layer.
        variance: a layer, also as NAME:mean or NAME:sample.
    """

    layer: str | None = None
    albedo: str | None = None
    normal: str | None = None
    variance: str | None = None


class Choice(NamedTuple):
    """What was taken for what.

    Attributes:
        color: the noisy image; None where there is only a denoised one.
        denoised: the same, denoised.
        features: by name of a buffer.
        alpha: the layer with the alpha of the colour.
        variance: of the colour.
        unit: of the variance, as in `VARIANCES`.
        notes: what a user must know: one image chosen among several.
        rivals: layers that could have been taken too, by role.
    """

    color: Layer | None
    denoised: Layer | None
    features: dict[str, Layer]
    alpha: Layer | None
    variance: Layer | None
    unit: str
    notes: list[str]
    rivals: dict[str, list[Layer]]


def choose(layers: Sequence[Layer], wanted: Wanted = Wanted()) -> Choice:  # noqa: B008
    """Choose by the table of names and by what a user wants; raise without colour."""
    pool = _wanted_pool(layers, wanted.layer)
    colors = _colors(pool)
    if not colors and wanted.layer is not None:
        colors = [layer for layer in pool if layer.color]
    denoised = _ranked(pool, "denoised", lambda layer: layer.color)
    if not colors and not denoised:
        colors = [layer for layer in pool if layer.letters("RGBA")]
        colors = colors if len(colors) == 1 else []
        if not colors:
            raise ValueError(_no_color(pool))
    color = colors[0] if colors else None
    main = color or denoised[0]
    near = [layer for layer in layers if layer is not color and _together(layer, main)]
    denoised = _ranked(near, "denoised", lambda layer: layer.color)
    if color is not None and color.rank("noisy") is not None:
        denoised += _ranked(near, "beauty", lambda layer: layer.color)
    if color is None:
        denoised = [main]
    rivals = {"color": _unlike(colors[1:], denoised), "denoised": denoised[1:]}
    features = {}
    for name in FEATURES:
        named = getattr(wanted, name, None)
        found = _feature(layers, near, name, main, named)
        if found:
            features[name], *rivals[name] = found
    variance, unit = _variance(layers, near, wanted.variance)
    if variance:
        rivals["variance"] = variance[1:]
    return Choice(
        color,
        denoised[0] if denoised else None,
        features,
        _alpha([main, *denoised, *near]),
        variance[0] if variance else None,
        unit,
        [*_notes(color, denoised, rivals), *_doubt(color, near)],
        {role: others for role, others in rivals.items() if others},
    )


def channels_of(layer: Layer, role: str) -> list[str]:
    """Return the channels of a layer that a role takes; raise if there are none."""
    found = {
        "albedo": layer.letters("RGB", "XYZ"),
        "normal": layer.letters("XYZ", "RGB", "UVW"),
        "depth": layer.single,
        "visibility": layer.single,
        "alpha": layer.letters("A") or layer.single,
        "variance": layer.letters("RGB", "XYZ") or layer.single,
    }.get(role, layer.color)
    if found is None:
        listed = ", ".join(layer.channels.values())
        raise ValueError(f"layer {layer.shown} cannot be the {role}: it has {listed}")
    return found


def _wanted_pool(layers: Sequence[Layer], name: str | None) -> list[Layer]:
    """The layers that a user allows."""
    if name is None:
        return list(layers)
    called = [layer for layer in layers if layer.called(name)]
    if not called:
        raise ValueError(f"no layer {name!r}; there are {_listed(layers)}")
    return called


def _colors(layers: Sequence[Layer]) -> list[Layer]:
    """What may be the noisy colour, the likeliest first."""
    order = []
    for number, layer in enumerate(layers):
        if layer.color is None:
            continue
        kinds = [layer.rank("noisy"), layer.rank("beauty")]
        if kinds == [None, None] and layer.bare and _is_unknown(layer):
            kinds = [None, None, 0]  # a part whose name says nothing
        if place := [(n, kind) for n, kind in enumerate(kinds) if kind is not None]:
            output = layer.group.lower() == "composite"  # of Blender's compositor
            order.append((output, *place[0], number, layer))
    return [layer for *_, layer in sorted(order, key=lambda item: item[:-1])]


def _is_unknown(layer: Layer) -> bool:
    """Whether a name is in no list of the table."""
    roles = ("denoised", "variance", *FEATURES)
    return all(layer.rank(role) is None for role in roles)


def _together(layer: Layer, main: Layer) -> bool:
    """Whether layers belong to one image: the same view and view layer."""
    same_view = layer.view in (main.view, "")
    return same_view and (layer.group == main.group or not (layer.group and main.group))


def _ranked(
    layers: Sequence[Layer], role: str, channels: Callable[[Layer], list[str] | None]
) -> list[Layer]:
    """The layers of a role that have channels for it, the likeliest first."""
    order = [
        (rank, number, layer)
        for number, layer in enumerate(layers)
        if (rank := layer.rank(role)) is not None and channels(layer)
    ]
    return [layer for *_, layer in sorted(order, key=lambda item: item[:-1])]


def _feature(
    layers: Sequence[Layer],
    near: Sequence[Layer],
    name: str,
    main: Layer,
    named: str | None,
) -> list[Layer]:
    """The layers of a feature."""
    if named is not None:
        return _named(layers, name, named)

    def has_channels(layer: Layer) -> list[str] | None:
        try:
            return channels_of(layer, name)
        except ValueError:
            return None

    found = _ranked(near, name, has_channels)
    if name == "depth":  # Z beside R, G, B, or alone in a part
        own = [main, *(layer for layer in near if layer.bare)]
        found += [
            layer._replace(channels={"Z": layer.channels["Z"]})
            for layer in own
            if layer.bare and "Z" in layer.channels and "X" not in layer.channels
            if layer not in found
        ]
    return found


def _alpha(layers: Sequence[Layer]) -> Layer | None:
    """The layer with the alpha: the colour's own, or one that is called so."""
    main, *others = layers
    if "A" in main.channels:
        return main
    own = [layer for layer in others if "A" in layer.channels]
    image = [layer for layer in own if layer.bare or layer.rank("beauty") is not None]
    called = [layer for layer in others if layer.rank("alpha") is not None]
    return next(iter([*image, *called]), None)


def _variance(
    layers: Sequence[Layer], near: Sequence[Layer], named: str | None
) -> tuple[list[Layer], str]:
    """The layers of the variance, and what it is of."""
    if named is not None:
        layer, unit = named_layer(layers, "variance", named)
        return [layer], unit
    found = _ranked(near, "variance", lambda layer: layer.single)
    return found, unit_of(found[0]) if found else ""


def named_layer(layers: Sequence[Layer], role: str, given: str) -> tuple[Layer, str]:
    """Return the layer that a user names for a role, and what a variance is of."""
    name, _, unit = given.rpartition(":")
    if role != "variance" or unit not in _UNITS:
        name, unit = given, ""
    layer = _named(layers, role, name)[0]
    return layer, unit or unit_of(layer)


def unit_of(layer: Layer) -> str:
    """Return what a variance is of, as its name tells."""
    last = plain(layer.name.rpartition(".")[2])
    return VARIANCES.get(plain(layer.name), VARIANCES.get(last, "mean"))


def _named(layers: Sequence[Layer], role: str, name: str) -> list[Layer]:
    """The layers that a user names for a role."""
    found = [layer for layer in layers if layer.called(name)]
    if not found:
        raise ValueError(f"no layer {name!r} for {role}; there are {_listed(layers)}")
    channels_of(found[0], role)
    return found[:1]


def _unlike(layers: Sequence[Layer], others: Sequence[Layer]) -> list[Layer]:
    """The layers that are not among others."""
    return [layer for layer in layers if layer not in others]


def _notes(
    color: Layer | None, denoised: list[Layer], rivals: dict[str, list[Layer]]
) -> list[str]:
    """What a user must know of the choice."""
    notes = []
    if color is not None and denoised:
        notes.append(
            f"the noisy image is {color.shown}, a denoised one is {denoised[0].shown}"
        )
    if others := rivals["color"]:
        shown = color.shown if color else ""
        names = ", ".join(layer.shown for layer in others)
        notes.append(f"the colour is {shown}; --layer takes another: {names}")
    return notes


def _doubt(color: Layer | None, near: Sequence[Layer]) -> list[str]:
    """A line if the colour, as a user names it, is beside a noisy image."""
    noisy = _ranked(near, "noisy", lambda layer: layer.color)
    if color is None or color.rank("noisy") is not None or not noisy:
        return []
    return [f"{color.shown} may be denoised: {noisy[0].shown} is beside it"]


def _no_color(layers: Sequence[Layer]) -> str:
    """The error for a file without a colour."""
    names = sorted(c for layer in layers for c in layer.channels.values())
    listed = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
    return (
        f"no colour channels R, G, B (or Y) among {listed or 'no flat image'}: name "
        "the layer (--layer)"
    )


def _listed(layers: Sequence[Layer]) -> str:
    """The layers in a line."""
    return ", ".join(dict.fromkeys(layer.shown for layer in layers))
