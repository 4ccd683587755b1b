"""A network's combination as a local function."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from jscomb.numerics.tiles._crops import Local
from jscomb.numerics.tiles._programs import compiled


def network_plan(
    combine: Callable[..., Any],
    network: Any,
    inputs: Mapping[str, Any],
    *,
    around: int = 0,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> Local:
    """Return what a network makes of its inputs as a local function of them.

    Args:
        combine: of the network, its inputs and more.
        network: pytree of parameters with `reach`, `multiple` and, if it predicts
            kernels, their width `window`; without a reach the combination depends on
            the whole image.
        inputs: images [H,W,*] by name.
        around: pixels that the combination sees around the network's outputs.
        more: arrays that are the same for all crops, by the combination's keywords.

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
        return Local(lambda i: combine(network, i, **more), dict(inputs), None)
    function = lambda images: compiled(combine)(network, images, **more)
    halo = max(reach, getattr(network, "window", 1) // 2) + around
    return Local(function, dict(inputs), halo, network.multiple)
