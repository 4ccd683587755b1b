"""A network's combination as a local function."""

from collections.abc import Callable, Mapping
from typing import Any

from jscomb.numerics.tiles._crops import Local
from jscomb.numerics.tiles._programs import compiled


def network_plan(
    combine: Callable[..., Any],
    network: Any,
    inputs: Mapping[str, Any],
    *,
    kernel: int = 1,
    around: int = 0,
) -> Local:
    """Return what a network makes of its inputs as a local function of them.

    Args:
        combine: of the network and its inputs.
        network: pytree of parameters with `reach` and `multiple`; without them the
            combination depends on the whole image.
        inputs: images [H,W,*] by name.
        kernel: width in pixels of the kernels that the network predicts.
        around: pixels that the combination sees around the network's outputs.

    Returns:
        the function; compiled once for all networks of one shape.

    Example:
        >>> import numpy as np
        >>> plan = network_plan(lambda gain, i: gain(i["x"]), np.square, {"x": 3.0})
        >>> print(plan.whole(), plan.halo)
        9.0 None
    """
    reach = getattr(network, "reach", None)
    if reach is None:
        return Local(lambda images: combine(network, images), dict(inputs), None)
    function = lambda images: compiled(combine)(network, images)
    halo = max(reach, kernel // 2) + around
    return Local(function, dict(inputs), halo, network.multiple)
