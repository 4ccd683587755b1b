"""The filter of Open Image Denoise, on the host, of NumPy arrays."""

import functools
import threading
from collections.abc import Mapping

import numpy as np

from jscomb.denoisers.oidn._models import Model

_MEMORY = 1024  # MiB that the filter may take; it cuts larger images into tiles

_lock = threading.Lock()  # a filter has one configuration at a time


def run(model: Model, images: Mapping[str, np.ndarray], exposure: float) -> np.ndarray:
    """Filter images [H,W,3] by the filter's own network.

    Raises:
        RuntimeError: if the filter reports a failure.
    """
    import pyoidn

    inputs = {name: np.ascontiguousarray(images[name]) for name in model.inputs}
    output = np.full_like(inputs[model.inputs[0]], np.nan)
    kind = pyoidn.OIDN_FILTER_TYPE_RT
    if model.lightmap:
        kind = pyoidn.OIDN_FILTER_TYPE_RT_LIGHTMAP
    qualities = {
        "fast": pyoidn.OIDN_QUALITY_FAST,
        "balanced": pyoidn.OIDN_QUALITY_BALANCED,
        "high": pyoidn.OIDN_QUALITY_HIGH,
    }
    with _lock, pyoidn.Filter(_device(), kind) as filter:
        for name, image in (inputs | {"output": output}).items():
            filter.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
        if model.lightmap:
            filter.set_bool("directional", model.lightmap == "directional")
        else:
            filter.set_bool("hdr", model.hdr)
            filter.set_bool("cleanAux", model.clean)
        if not model.bounded:
            filter.set_float("inputScale", exposure)
        filter.set_int("maxMemoryMB", _MEMORY)
        filter.set_quality(qualities[model.quality])
        filter.commit()
        filter.execute()
        problem = _device().get_error()
    if problem or np.isnan(output).any():
        raise RuntimeError(f"Open Image Denoise failed: {problem or 'it made NaN'}")
    return output


@functools.cache
def _device():
    """The CPU, as a device of Open Image Denoise."""
    import pyoidn

    device = pyoidn.Device()
    device.commit()
    return device
