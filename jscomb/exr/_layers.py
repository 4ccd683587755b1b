"""The layers of a file, however its channels are distributed over parts.

Programs write all layers into one part (`albedo.R`), one part a layer (part `albedo`,
channel `R` or `albedo.R`), or one part a stereo view (attribute `view`; in a single
part, `multiView` lists the views and channels are `albedo.right.R`).
"""

import re
from typing import NamedTuple

from jscomb.exr._files import Headers
from jscomb.exr._names import WITHIN_GROUPS, plain, rank

_LETTERS = {"red": "R", "green": "G", "blue": "B", "alpha": "A"}
_TRIPLE = re.compile(r"(.+)([xyz])", re.I)


class Layer(NamedTuple):
    """An image of a file.

    Attributes:
        part: the number of its part.
        view: of a stereo image; empty without views.
        name: with dots, without the view; empty for the image that has none.
        channels: names in the file, by letter: R G B A, X Y Z, U V, T; "" for one
            channel without a letter.
        bare: whether its channels have no prefix, but at most a part's name.
        part_name: of its part.
    """

    part: int
    view: str
    name: str
    channels: dict[str, str]
    bare: bool
    part_name: str

    @property
    def group(self) -> str:
        """What stands before the last component: a view layer of a scene."""
        return self.name.rpartition(".")[0]

    @property
    def shown(self) -> str:
        """The layer as users are told of it."""
        own = sorted(self.channels, key=lambda each: ("RGBA".find(each) % 9, each))
        name = self.name or ", ".join(self.channels[letter] for letter in own)
        return f"{name} ({self.view})" if self.view else name

    def rank(self, role: str) -> int | None:
        """How well the name fits a role, 0 best; None if it does not."""
        last = plain(self.name.rpartition(".")[2])
        found = rank(role, plain(self.name))
        if found is None and (role != "beauty" or last in WITHIN_GROUPS):
            found = rank(role, last)
        return found

    def letters(self, *choices: str) -> list[str] | None:
        """The channels of the first set of letters that is complete."""
        for letters in choices:
            if all(letter in self.channels for letter in letters):
                return [self.channels[letter] for letter in letters]
        return None

    @property
    def color(self) -> list[str] | None:
        """The channels of a colour: three, or a grey one; not Y of X, Y, Z."""
        return self.letters("RGB", *([] if "X" in self.channels else ["Y"]))

    @property
    def single(self) -> list[str] | None:
        """The only channel, or the one that is usual for a scalar."""
        if len(self.channels) == 1:
            return list(self.channels.values())
        return next((self.letters(c) for c in "ZTVYRX" if c in self.channels), None)

    def called(self, name: str) -> bool:
        """Whether a user means this layer: its name, view, part, or view layer."""
        own = [self.name, self.name.rpartition(".")[2], self.part_name, self.view]
        own += [f"{self.view}.{self.name}", f"{self.name}.{self.view}", self.group]
        own += ["rgb", "rgba"] if not self.name else []
        wanted = name.lower().strip(".")
        return bool(wanted) and wanted in {each.lower().strip(".") for each in own}


def layers_of(headers: Headers) -> list[Layer]:
    """Return the layers of all parts that have flat images, in the file's order."""
    several = len(headers.parts) > 1
    found = []
    for number, part in enumerate(headers.parts):
        if number in headers.unusable:
            continue
        views = part.attributes.get("multiView", [])
        views = [str(v) for v in views] if isinstance(views, list) else []
        own = part.attributes.get("view", "")
        own = own if isinstance(own, str) else ""
        label = _without(part.name, own) if several else ""
        groups: dict[tuple[str, str, bool], dict[str, str]] = {}
        names = sorted(channel.name for channel in part.attributes["channels"])
        for channel in names:
            prefix, letter = _split(channel, names)
            bare = not prefix
            view, prefix = _view(prefix, views, own)
            key = view, prefix or label, bare
            groups.setdefault(key, {}).setdefault(letter, channel)
        found += [
            Layer(number, view, name, channels, bare, part.name if several else "")
            for (view, name, bare), channels in groups.items()
        ]
    return _sided(found)


def _split(channel: str, names: list[str]) -> tuple[str, str]:
    """The prefix of a channel and its letter."""
    prefix, dot, suffix = channel.rpartition(".")
    letter = _LETTERS.get(suffix.lower(), suffix.upper())
    if dot or len(letter) == 1:
        return prefix, letter if len(letter) == 1 else suffix
    triple = _TRIPLE.fullmatch(channel)  # Nsx, Nsy, Nsz
    if triple and all(triple[1] + axis in names for axis in _axes(triple[2])):
        return triple[1], triple[2].upper()
    return channel, ""


def _axes(like: str) -> str:
    """The axes in the case of one of them."""
    return "XYZ" if like.isupper() else "xyz"


def _view(prefix: str, views: list[str], own: str) -> tuple[str, str]:
    """The stereo view of a channel's prefix, and the rest of it."""
    components = prefix.split(".") if prefix else []
    for view in [*views, *([own] if own else [])]:
        if view in components[-1:] or view in components[:1]:
            components.remove(view)
            return view, ".".join(components)
    return own or ("" if components or not views else views[0]), prefix


def _without(name: str, view: str) -> str:
    """A part's name without the view that it is of: rgba_right, left.depth."""
    own = rf"(?:^|[._\- ]){re.escape(view)}(?=$|[._\- ])"
    return re.sub(own, "", name).lstrip("._- ") if view else name


def _sided(layers: list[Layer]) -> list[Layer]:
    """Layers of a left or a right image are views, where no attribute says so."""
    sides = {"left", "right"}
    if any(layer.view for layer in layers) or not any(
        layer.name.lower() in sides and layer.color for layer in layers
    ):
        return layers
    split = [layer.name.partition(".") for layer in layers]
    return [
        layer._replace(view=first, name=rest) if first.lower() in sides else layer
        for layer, (first, _, rest) in zip(layers, split, strict=True)
    ]
