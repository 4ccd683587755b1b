"""Common random numbers: a Mitsuba sampler whose pixels all draw the same numbers.

Where neighbouring pixels' paths look alike their noise is then alike too, and the
difference of the two is known far better than either. Every pixel by itself is as right
as ever.
"""

NAME = "common"


def register(mi) -> None:
    """Make the sampler known to Mitsuba as `NAME`.

    Args:
        mi: the module, its variant set.

    Raises:
        ValueError: if the variant works pixel by pixel, as `scalar_rgb` does.
    """
    if mi.variant().startswith("scalar"):
        raise ValueError(
            "common random numbers need a vectorised variant of Mitsuba (LLVM 17 or "
            f"newer brings one), got {mi.variant()}"
        )
    mi.register_sampler(NAME, _sampler(mi))


def _sampler(mi) -> type:
    """The sampler's class; its base exists only once a variant is set."""
    import drjit as dr  # comes with Mitsuba

    class Common(mi.Sampler):
        """One stream of numbers for each sample of each tile, of all its pixels.

        Attributes:
            columns: of the film in pixels.
            tile: width of a tile in pixels; 0 for one that is the whole film.
        """

        def __init__(self, properties) -> None:
            super().__init__(properties)
            self.columns = self.tile = 0
            self.numbers = mi.PCG32()

        def fork(self) -> "Common":
            return self

        def clone(self) -> "Common":
            return self

        def seed(self, seed, wavefront_size) -> None:
            super().seed(seed, wavefront_size)
            lane, spp = dr.arange(mi.UInt32, wavefront_size), self.sample_count()
            pixel, sample = lane // spp, lane % spp
            number = dr.zeros(mi.UInt32, wavefront_size)
            if self.tile:
                row, column = pixel // self.columns, pixel % self.columns
                across = -(-self.columns // self.tile)
                number = row // self.tile * across + column // self.tile
            # Opaque: written into the kernel as a constant, each seed would have to be
            # compiled anew.
            seed = dr.opaque(mi.UInt32, int(mi.UInt32(seed)[0]), wavefront_size)
            first, _ = mi.sample_tea_32(seed, sample)
            state, sequence = mi.sample_tea_32(first, number)
            self.numbers = mi.PCG32(
                initstate=mi.UInt64(state), initseq=mi.UInt64(sequence)
            )

        def next_1d(self, active=True):
            return self.numbers.next_float32(active)

        def next_2d(self, active=True):
            return mi.Point2f(self.next_1d(active), self.next_1d(active))

    return Common
