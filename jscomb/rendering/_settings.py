"""What is rendered of a scene, and how."""

import dataclasses
from typing import Literal

REFERENCE_CHUNK = 16  # samples of one reference pass: bounds memory, saves launches
LARGEST_LAUNCH = 2**19  # single samples that are rendered together; bounds memory


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is rendered of a scene, and how.

    Attributes:
        spp: samples a pixel of the full frame.
        size: width and height in pixels; 0 keeps an XML file's own size.
        width: of the film in pixels, where it is not square.
        height: of the film in pixels, where it is not square.
        buffers: number of independent sub-buffers, 1 or even; with one sample each
            they have no variance of their own, and the frame's is from their spread.
        feature_spp: samples a pixel of each sub-buffer's features.
        reference_spp: samples a pixel of the reference; 0 renders none.
        numbers: the random numbers of different pixels: independent, or common, the
            same for all.
        tile: width in pixels of the tiles that common numbers are common to; 0 for one
            over the whole frame.
        seed: first random stream; frames and references with streams apart are
            independent (one stream a pass).
        photons: paths from the lights in each pass of photon mapping; 0 for no photon
            mapping.
        passes: number of passes of photon mapping, even.
        radius: of the first two passes of photon mapping, in the scene's unit; 0 for a
            hundredth of the scene's diagonal.

    Raises:
        ValueError: if that cannot be rendered.
    """

    spp: int = 64
    size: int = 0
    width: int = 0
    height: int = 0
    buffers: int = 2
    feature_spp: int = 16
    reference_spp: int = 0
    numbers: Literal["independent", "common"] = "independent"
    tile: int = 0
    seed: int = 0
    photons: int = 0
    passes: int = 64
    radius: float = 0.0

    def __post_init__(self) -> None:
        """Reject sizes and counts that cannot be rendered."""
        if min(self.size, self.width, self.height, self.tile, self.seed) < 0:
            raise ValueError("size, width, height, tile and seed must not be negative")
        if self.feature_spp < 1:
            raise ValueError(f"feature_spp must be positive, got {self.feature_spp}")
        k = self.buffers
        if k < 1 or (k > 1 and k % 2):
            raise ValueError(f"buffers must be 1 or even, got {k}")
        if self.spp % k or self.spp < 2:
            raise ValueError(
                f"spp must be a multiple of buffers = {k} and at least 2, got "
                f"{self.spp}"
            )
        if self.reference_spp < 0 or self.reference_spp % (2 * REFERENCE_CHUNK):
            raise ValueError(
                f"reference_spp must be a multiple of {2 * REFERENCE_CHUNK}, got "
                f"{self.reference_spp}"
            )
        if self.numbers == "common" and self.reference_spp:
            raise ValueError("a reference needs independent random numbers")
        if self.photons < 0 or self.radius < 0:
            raise ValueError(
                "photons and radius must not be negative, got "
                f"{self.photons} and {self.radius}"
            )
        if self.passes < 2 or self.passes % 2:
            raise ValueError(f"passes must be even and positive, got {self.passes}")
        if self.photons and self.numbers == "common":
            raise ValueError("photon mapping needs independent random numbers")
        if not self.photons and (self.radius or self.passes != Settings.passes):
            raise ValueError("passes and radius are of photon mapping: give photons")

    @property
    def film(self) -> tuple[int, int]:
        """Width and height in pixels; 0 for the scene's own."""
        return self.width or self.size, self.height or self.size

    @property
    def samples_together(self) -> int:
        """Samples a pixel that one pass renders; a small film's launch is dear."""
        width, height = self.film
        if self.numbers == "common" or not (width and height):
            return 1
        most = min(REFERENCE_CHUNK, LARGEST_LAUNCH // (width * height))
        each = self.spp // self.buffers
        return max((n for n in range(1, most + 1) if each % n == 0), default=1)
