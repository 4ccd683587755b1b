"""A frame denoised, and each of its halves by itself."""

from collections.abc import Callable

import jax.numpy as jnp

from jscomb.frame import Biased, Frame
from jscomb.typing import Image


def of_parts(
    frame: Frame,
    denoise: Callable[[Frame], Image],
    *,
    variance: bool = True,
    halves: bool = False,
) -> Biased:
    """Denoise a frame, and its halves where they have what the denoiser needs.

    Args:
        frame: the frame.
        denoise: of a frame, or of a half as a frame, its denoised image [H,W,C].
        variance: the denoiser needs the variance: given, or two sub-buffers to estimate
            it from.
        halves: the denoiser needs halves, and their variance if that is needed.

    Returns:
        the denoised frame; its halves unless they lack something.

    Example:
        >>> from jscomb.frame import make_frame
        >>> frame = make_frame(jnp.stack([jnp.zeros((2, 2, 1)), jnp.ones((2, 2, 1))]))
        >>> made = of_parts(frame, lambda part: 2 * part.color, variance=False)
        >>> print(made.full[0, 0], made.halves[:, 0, 0, 0])
        [1.] [0. 2.]
    """
    estimated = variance and frame.buffers.variance is None
    least = 2 * (2 if estimated else 1) * (2 if halves else 1)
    if frame.sub_buffers < least:
        return Biased(denoise(frame))
    both = jnp.stack([denoise(half) for half in frame.halves()])
    return Biased(denoise(frame), both)
