"""The table of methods: everything that names one reads it."""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax

from jscomb import (
    double_shrinkage,
    ensemble,
    james_stein,
    progressive,
    uncorrelated,
)
from jscomb.denoisers import bilateral, nfor, nonlocal_means, oidn, rdfc, smoothing
from jscomb.frame import Estimate, Frame, Needs, estimates_of, with_halves
from jscomb.numerics.tiles import Local
from jscomb.typing import Image, Key


class Method(NamedTuple):
    """A denoiser or combiner: a `plan`, or a `make` for what has none.

    Attributes:
        summary: what it does, in one line.
        needs: what it needs of a frame.
        takes: what it takes beside the frame: nothing, one estimate, or several by
            name.
        plan: of a key, a normalised frame and its estimates, to a local function of
            images.
        make: of a key, a normalised frame and what it takes (each an `Estimate` or a
            `Maker`), to an `Estimate`.
        denoiser: the denoiser that it runs by itself, where it takes no estimate.
        pure: decides on no values, for `jit` and `vmap`.
        variant: of Open Image Denoise; those of one frame are made together.
        bases: what it is made of beside the frame's own estimates, if it takes several.
        input: name of the estimate that it takes, which no denoiser makes; None for
            any biased image.
        own_halves: its halves come without half frames.
    """

    summary: str
    needs: Needs
    takes: Literal["nothing", "one estimate", "estimates"]
    plan: Callable[..., Local] | None = None
    make: Callable[..., Estimate] | None = None
    denoiser: str | None = None
    pure: bool = False
    variant: oidn.Variant | None = None
    bases: tuple[str, ...] = ()
    input: str | None = None
    own_halves: bool = False

    def missing_for_halves(self, frame: Frame) -> str:
        """Return what a frame lacks for an estimate with halves; empty if nothing."""
        if self.own_halves:
            return self.needs.missing(frame)
        return self.needs.missing_for_halves(frame)

    def image(self, key: Key, frame: Frame, *estimates: Any) -> Image:
        """Return the image alone, [H,W,C]."""
        key = jax.random.clone(key)  # the parts of a frame share their probes
        if self.plan is not None:
            return self.plan(key, frame, *estimates).whole()
        assert self.make is not None
        return self.make(key, frame, *estimates).image

    def estimate(self, key: Key, frame: Frame, *given: Any) -> Estimate:
        """Return the image, and that of each half where it can be made."""
        if self.make is not None:
            return self.make(jax.random.clone(key), frame, *given)
        image = functools.partial(self.image, key)
        return with_halves(frame, image, *given, needs=self.needs)


def _oidn(summary: str, name: str) -> Method:
    """Open Image Denoise in one of its variants."""
    variant = oidn.VARIANTS[name]
    make = lambda key, frame: oidn.denoise_frame(frame, variant=variant)
    return Method(summary, variant.needs, "nothing", make=make, variant=variant)


def _filter(summary: str, room: Any, **options: Any) -> Method:
    """A method that denoises a frame by a local function."""
    plan = lambda key, frame: room.plan_frame(frame, **options)
    return Method(summary, room.NEEDS, "nothing", plan, pure=True)


def _network(name: str) -> Any:
    """The trained network of a method."""
    from jscomb.learning.recipes import shipped  # flax is slow to import

    return shipped(name)


def _shrinkage_network(frame: Frame, estimate: Estimate) -> str:
    """Which network a biased image needs, by whether its noise is the frame's."""
    return "dsc" if double_shrinkage.depends(frame, estimate) else "dsc-photons"


def _james_stein(summary: str, **options: Any) -> Method:
    """James-Stein without its network."""
    plan = lambda key, frame, y: james_stein.plan_frame(frame, y, **options)
    return Method(summary, james_stein.NEEDS, "one estimate", plan, pure=True)


BASES = (
    *(name for name in oidn.VARIANTS if not oidn.VARIANTS[name].turned),
    *("bilateral", "rdfc", "pd"),
)
"""What `ensemble` is made of beside a frame's own estimates; the variants of eight
turns lower its error little, and take eight times as long."""

FEW = (
    *("oidn", "path-tracing", "oidn-demodulated", "nonlocal-means"),
    *("whitened", "multi-scale"),
)
"""What `neural-ensemble` is made of."""

METHODS: dict[str, Method] = {
    **{
        name: _oidn(f"Open Image Denoise{summary}", name)
        for name, summary in {
            "oidn": " with the frame's albedo and normal",
            "oidn-color": " with the colour alone",
            "oidn-albedo": " with the albedo alone",
            "oidn-demodulated": " of the colour divided by the albedo",
            "oidn-clean": " with albedo and normal denoised first",
            "oidn-clean-balanced": " as `oidn-clean`, by smaller networks",
            "oidn-turned": ", mean of eight flips and rotations",
            "oidn-clean-turned": " as `oidn-clean`, mean of eight flips and rotations",
        }.items()
    },
    "nfor": Method(
        "first-order regression on the features",
        nfor.NEEDS,
        "nothing",
        make=lambda key, frame: nfor.denoise_frame(frame),
        own_halves=True,
    ),
    "bilateral": _filter("joint bilateral filter", bilateral),
    "nonlocal-means": _filter("non-local means", nonlocal_means),
    "nonlocal-means-narrow": _filter(
        "non-local means that search 11x11 pixels", nonlocal_means, window=11
    ),
    "rdfc": _filter("non-local means restricted by the features", rdfc),
    "gaussian": _filter("Gaussian blur", smoothing),
    "path-tracing": Method(
        "the frame's own noisy image",
        Needs(),
        "nothing",
        lambda key, frame: Local(lambda image: image, frame.color, 0),
        pure=True,
    ),
    "denoised": Method(
        "the biased image, unchanged",
        Needs(),
        "one estimate",
        lambda key, frame, y: Local(lambda image: image, y.image, 0),
        pure=True,
    ),
    "james-stein": _james_stein(
        "James-Stein with one variance a 15x15 window", window=15, whiten=False
    ),
    "whitened": _james_stein("James-Stein with a robust variance for each pixel"),
    "multi-scale": Method(
        "`whitened`, then James-Stein in bands of spatial scale",
        james_stein.BANDS_NEEDS,
        "one estimate",
        lambda key, frame, y: james_stein.plan_bands(frame, y),
        pure=True,
    ),
    "progressive": Method(
        "mixing with Open Image Denoise by SURE",
        progressive.NEEDS._replace(channels=3, package=oidn.NEEDS.package),
        "nothing",
        make=lambda key, frame: progressive.combine_frame(
            key, oidn.denoise_color, frame
        ),
        denoiser="oidn",
    ),
    "double-shrinkage": Method(
        "double shrinkage with errors from half buffers",
        double_shrinkage.NEEDS,
        "one estimate",
        make=lambda key, frame, y: double_shrinkage.combine_frame(frame, y),
    ),
    "njs": Method(
        "James-Stein with a trained network",
        james_stein.NEURAL_NEEDS,
        "one estimate",
        lambda key, frame, y: james_stein.plan_neural(key, _network("njs"), frame, y),
    ),
    "pd": Method(
        "progressive denoising with a trained network, of Open Image Denoise",
        progressive.NEEDS._replace(channels=3, package=oidn.NEEDS.package),
        "nothing",
        lambda key, frame: progressive.plan_neural(
            key, oidn.denoise_color, _network("pd"), frame
        ),
        denoiser="oidn",
    ),
    "dsc": Method(
        "double shrinkage with a trained network",
        double_shrinkage.NEEDS._replace(channels=3),
        "one estimate",
        lambda key, frame, y: double_shrinkage.plan_neural(
            _network(_shrinkage_network(frame, y)), frame, y
        ),
    ),
    "uncorrelated": Method(
        "uncorrelated kernels with a rendering by common random numbers",
        uncorrelated.NEEDS,
        "one estimate",
        make=lambda key, frame, z: uncorrelated.combine_frame(
            frame, estimates_of(frame, z)
        ),
        input="correlated",
    ),
    "ensemble": Method(
        "weights of minimum error for all the frame's estimates and several denoisers",
        ensemble.NEEDS,
        "estimates",
        make=lambda key, frame, bases: ensemble.combine_frame(frame, bases),
        bases=BASES,
    ),
    "neural-ensemble": Method(
        "ensemble of a few estimates, its weights corrected by a trained network",
        ensemble.NEURAL_NEEDS,
        "estimates",
        make=lambda key, frame, bases: ensemble.neural_combine_frame(
            _network("neural-ensemble"), frame, bases
        ),
        bases=FEW,
    ),
}
"""By name; the cheaper first among the combiners. Two renderings with sub-buffers are
combined by `uncorrelated.combine_frame`, with more of the paper's kernels than here."""


def table() -> str:
    """Return all methods as a Markdown table: name, what each does, takes and needs.

    Returns:
        the table.

    Example:
        >>> print(table().splitlines()[0])
        | method | what it does | takes | needs |
    """
    rows = [
        f"| `{name}` | {m.summary} | {m.takes} | {m.needs.summary()} |"
        for name, m in METHODS.items()
    ]
    head = ["| method | what it does | takes | needs |", "| --- | --- | --- | --- |"]
    return "\n".join([*head, *rows])
