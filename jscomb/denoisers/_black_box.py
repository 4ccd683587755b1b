"""Any denoiser on the host, such as one of NumPy or torch, as a denoiser of frames."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from jscomb.frame import CHANNELS, Estimate, Frame, Needs, with_halves
from jscomb.numerics.guards import finite, first_finite
from jscomb.numerics.windows import window_mean
from jscomb.typing import Image

Host = Callable[..., Any]

_FILL = 7  # width of the window whose mean an invalid pixel is given
_LOST = 1e-4  # of the radiance: a smaller step drowns in the rounding of float32
_GUIDES = (*CHANNELS, "variance")


@dataclasses.dataclass(frozen=True)
class BlackBox:
    """A denoiser of which nothing is known but what it makes of an image.

    Call it with a frame for an `Estimate`: wherever a maker goes, it goes.

    Attributes:
        function: from a colour [H,W,C], and guides by name, to an image of its shape.
        guides: what of the frame it is given.
        step: of derivatives, in units of the tangent.
    """

    function: Host
    guides: tuple[str, ...]
    step: float

    @property
    def needs(self) -> Needs:
        """What it needs of a frame."""
        features = tuple(name for name in self.guides if name != "variance")
        return Needs(variance="variance" in self.guides, features=features)

    def __call__(self, frame: Frame) -> Estimate:
        """Denoise a frame, and each half of it that has what is needed."""
        frame.require("this black box", self.needs)
        make = lambda part: self.denoise(part.color, part)
        return with_halves(frame, make, needs=self.needs)

    def denoise(self, color: Image, frame: Frame) -> Image:
        """Denoise a colour, guided by its frame; with forward derivatives in it.

        This is what `numerics.sure` and `progressive` take.

        Args:
            color: radiance, [H,W,C]; invalid pixels are filled from around them.
            frame: whose guides it has.

        Returns:
            the image, finite, [H,W,C]; no derivative passes to the guides.

        Raises:
            ValueError: if the function makes an image of another shape.
        """
        guides = {name: getattr(frame, name) for name in self.guides}
        valid = finite(color)
        around = window_mean(color, _FILL, mask=valid)
        filled = jnp.where(valid, color, around)
        return first_finite(_denoise(self, filled, guides), filled)


def black_box(
    function: Host, *, guides: tuple[str, ...] = (), step: float = 0.1
) -> BlackBox:
    """Make a denoiser of frames of any function of NumPy arrays.

    The function runs on the host, one image at a time: `jit` calls back, and `vmap` is
    a loop. Its directional derivative is a central difference,

        J b = (F(x + h b) - F(x - h b)) / (2 h),

    two more calls. SURE's tangent b is the noise, so h = 0.1 moves each pixel by a
    tenth of its own noise: little against what a denoiser distinguishes, much against
    the rounding of float32. Where b is less than a thousandth of the radiance (in the
    median pixel), h is larger, to be seen at all. Reverse derivatives there are none.

    Args:
        function: of a colour [H,W,C] and, by name, the guides: arrays of its own that
            it may change. It returns an image of the colour's shape, as anything that
            NumPy takes, or as a torch tensor on any device.
        guides: of "albedo", "normal", "depth", "visibility" and "variance", those that
            the function is given; a frame must have them.
        step: h > 0.

    Returns:
        the denoiser: of a frame, to an `Estimate` with halves; its `denoise` for SURE.

    Raises:
        ValueError: if a guide is unknown or the step is not positive.

    Example:
        >>> from scipy.ndimage import median_filter
        >>> from jscomb.frame import make_frame
        >>> median = black_box(lambda color: median_filter(color, size=(5, 5, 1)))
        >>> noise = np.random.default_rng(0).normal(1, 0.5, (2, 16, 16, 1))
        >>> made = median(make_frame(noise.astype("float32")))
        >>> print([f"{i.std():.1f}" for i in (noise.mean(0), made.image, made.halves)])
        ['0.4', '0.1', '0.2']

    Source: S. Ramani, T. Blu, M. Unser, "Monte-Carlo SURE", 2008 (the differences).
    """
    if unknown := [name for name in guides if name not in _GUIDES]:
        raise ValueError(f"no guide {unknown[0]!r}: there are {', '.join(_GUIDES)}")
    if not step > 0:
        raise ValueError(f"step must be positive, got {step}")
    return BlackBox(function, tuple(guides), step)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _denoise(box: BlackBox, color: Image, guides: dict[str, Array]) -> Image:
    """The function's image."""
    return _called(functools.partial(_run, box.function), color, guides)


@_denoise.defjvp
def _denoise_jvp(box: BlackBox, primals: tuple, tangents: tuple) -> tuple[Image, Image]:
    """The image, and its central difference along the colour's tangent."""
    (color, guides), (tangent, _) = primals, tangents
    moved = _called(functools.partial(_difference, box), color, guides, tangent)
    return _denoise(box, color, guides), moved


def _called(host: Callable[..., np.ndarray], color: Image, *others: Any) -> Image:
    """What a function on the host makes, in this process or called from a program."""
    if not any(isinstance(each, Tracer) for each in jax.tree.leaves((color, others))):
        return jnp.asarray(host(color, *others))
    like = jax.ShapeDtypeStruct(color.shape, color.dtype)
    return jax.pure_callback(host, like, color, *others, vmap_method="sequential")


def _run(function: Host, color: ArrayLike, guides: dict[str, Any]) -> np.ndarray:
    """Call the function with arrays of its own."""
    color, own = np.array(color), {n: np.array(guide) for n, guide in guides.items()}
    shape, dtype = color.shape, color.dtype
    made = function(color, **own)
    if hasattr(made, "detach"):  # a torch tensor
        made = made.detach().cpu()
    made = np.asarray(made, dtype)
    if made.shape != shape:
        what = f"the function made {made.shape} of an image of {shape}"
        raise ValueError(f"{what}: a black box keeps the shape")
    return made


def _difference(
    box: BlackBox, color: ArrayLike, guides: dict[str, Any], tangent: ArrayLike
) -> np.ndarray:
    """The function's central difference along a tangent."""
    color, tangent = np.asarray(color), np.asarray(tangent)
    size = np.median(np.abs(tangent))
    seen = _LOST * np.median(np.abs(color)) / size if size > 0 else 0.0
    h = np.asarray(max(box.step, seen), color.dtype)
    ahead, behind = (
        _run(box.function, color + s * h * tangent, guides) for s in (1, -1)
    )
    return (ahead - behind) / (2 * h)
