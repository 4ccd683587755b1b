"""The models of Open Image Denoise: what each takes, and which the filter runs."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

Quality = Literal["high", "balanced", "fast"]

SIZES = {"fast": "small", "balanced": "base", "high": "large"}
"""Of the network, by quality; "high" takes the base one where there is no large one."""


class Model(NamedTuple):
    """One configuration of the filter, which chooses a network by it.

    Attributes:
        inputs: names of the images, the one to denoise first: "color" with nothing,
            with "albedo" or with "albedo" and "normal"; "albedo" or "normal" alone.
        clean: the features are free of noise.
        quality: "high", "balanced" or "fast".
        hdr: the colour is linear radiance without a limit; else in [0, 1].
        lightmap: the colour is a lightmap: "hdr" radiance, or "directional".
    """

    inputs: tuple[str, ...] = ("color",)
    clean: bool = False
    quality: Quality = "high"
    hdr: bool = True
    lightmap: Literal["hdr", "directional"] | None = None

    @property
    def curve(self) -> str:
        """Name of the transfer function of the image to denoise."""
        if self.lightmap:
            return {"hdr": "log", "directional": "linear"}[self.lightmap]
        if self.inputs[0] == "normal":
            return "linear"
        return "pu" if self.inputs[0] == "color" and self.hdr else "srgb"

    @property
    def signed(self) -> bool:
        """Whether the image to denoise has components in [-1, 1]."""
        return self.inputs[0] == "normal" or self.lightmap == "directional"

    @property
    def bounded(self) -> bool:
        """Whether the image to denoise has a maximum of one."""
        return self.curve in ("srgb", "linear")

    @property
    def name(self) -> str:
        """Say what it denoises and how, in a few words."""
        color = "lightmap " + self.lightmap if self.lightmap else ""
        color = color or ("hdr" if self.hdr else "ldr")
        words = [color] if self.inputs[0] == "color" else []
        words += [*self.inputs, *(["clean"] if self.clean else []), self.quality]
        return " ".join(words)


Images = Mapping[str, Any]  # by the names of `Model.inputs`, [H,W,3]

GUIDES = (), ("albedo",), ("albedo", "normal")
_QUALITIES: tuple[Quality, ...] = "high", "balanced", "fast"

MODELS = (
    *(
        Model(("color", *guides), quality=quality, hdr=hdr)
        for hdr in (True, False)
        for guides in GUIDES
        for quality in _QUALITIES[1:]
    ),
    *(
        Model(("color", *GUIDES[2]), clean=True, quality=quality, hdr=hdr)
        for hdr, qualities in ((True, _QUALITIES), (False, _QUALITIES[1:]))
        for quality in qualities
    ),
    *(
        Model((feature,), quality=quality, hdr=False)
        for feature in GUIDES[2]
        for quality in _QUALITIES[:2]
    ),
    Model(lightmap="hdr"),
    Model(lightmap="directional"),
)
"""One for each network that version 2.5 holds."""
