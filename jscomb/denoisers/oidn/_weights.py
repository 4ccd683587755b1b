"""The networks of the installed package: found in its library, told apart by parity.

The library holds one container for each network, all numbers little-endian:

    D7 41, major version 2, minor version, offset of the table      2 + 1 + 1 + 8 bytes
    table: number of arrays, then for each its name, shape, layout, type and offset

Names, shapes and sizes say how large a network is and how many channels it takes, not
for which model it is. So each model is held against the filter: the container whose
network makes the same image is the one. What was found is kept in the user's cache.
"""

import contextlib
import functools
import importlib.metadata
import importlib.util
import json
import math
import mmap
import os
import pathlib
import struct
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jscomb import cache
from jscomb.denoisers.oidn import _host
from jscomb.denoisers.oidn._models import SIZES, Model
from jscomb.frame import Package

PACKAGE = Package("pyoidn", "oidn")
TOLERANCE = 1e-4  # relative L2 of network and filter

_MAGIC = b"\xd7\x41\x02"
_TYPES = {b"f": np.dtype("<f4"), b"h": np.dtype("<f2")}
_SIDE = 128  # of the image that network and filter are compared on
_EXPOSURE = 0.5  # of that image


class Found(NamedTuple):
    """Which container is a model's.

    Attributes:
        number: in the order of the library.
        error: relative L2 of its network's image against the filter's.
        time: of its network, in that of the filter, on one small image.
    """

    number: int
    error: float
    time: float


def network(model: Model) -> Any:
    """Return a model's network; None, with one warning, if it cannot be read."""
    found = identify(model)
    return None if found is None else _loaded(found.number)


def identify(model: Model) -> Found | None:
    """Return a model's container; None, with one warning, if there is none."""
    found = _identified(model)
    if found is None:
        _warn_once()
    return found


@functools.cache
def _warn_once() -> None:
    """Say what the filter on the host cannot do."""
    warnings.warn(
        f"the networks of {PACKAGE.module} {_version()} cannot be read: Open Image "
        "Denoise runs on the host, with approximate derivatives; pyoidn 2.5.1 works",
        stacklevel=2,
    )


@functools.cache
def _loaded(number: int) -> Any:
    """Return a network in float32.

    Its weights are NumPy's: they outlive the trace that first asks for them.
    """
    wide = lambda array: np.ascontiguousarray(array, np.float32)
    return jax.tree.map(wide, trained_networks()[number].network)


@functools.cache
def trained_networks() -> list[Any]:
    """Return all networks of the installed library, in its order, as `Trained`.

    Their weights are views of the file, which is read where they are used.
    """
    from jscomb.denoisers.oidn._network import from_arrays

    containers = [c for p in _libraries() for c in read_containers(_mapped(p))]
    return [made for c in containers if (made := from_arrays(c)) is not None]


def _mapped(path: pathlib.Path) -> mmap.mmap:
    """Return a file as memory."""
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def read_containers(data: bytes | mmap.mmap) -> list[dict[str, np.ndarray]]:
    """Return the arrays of all containers in a file, by name.

    What begins like a container and is none is skipped.
    """
    containers, start = [], data.find(_MAGIC)
    while start >= 0:
        with contextlib.suppress(ValueError, OverflowError, struct.error):
            containers.append(_read_container(memoryview(data)[start:]))
        start = data.find(_MAGIC, start + 1)
    return containers


def _read_container(data: memoryview) -> dict[str, np.ndarray]:
    """Return the arrays of one container; raise if it is none."""
    at = struct.unpack_from("<Q", data, 4)[0]

    def take(format: str) -> tuple[Any, ...]:
        nonlocal at
        values = struct.unpack_from(f"<{format}", data, at)
        at += struct.calcsize(f"<{format}")
        return values

    arrays = {}
    for _ in range(*take("I")):
        (name,) = take(f"{take('H')[0]}s")
        (rank,) = take("B")
        shape = take(f"{rank}I")
        layout, kind, offset = take(f"{rank}sc") + take("Q")
        if layout not in (b"x", b"oihw") or kind not in _TYPES:
            raise ValueError("an array of another kind")
        values = np.frombuffer(data, _TYPES[kind], math.prod(shape), offset)
        arrays[str(name, "ascii")] = values.reshape(shape)
    if not arrays:
        raise ValueError("no arrays")
    return arrays


@functools.cache
def _identified(model: Model) -> Found | None:
    """Look a model up in the user's cache, else by parity, and keep what was found."""
    store = cache.folder() / "oidn.json"
    key = f"{_version()} {sum(path.stat().st_size for path in _libraries())}"
    known = _load(store)
    with contextlib.suppress(AttributeError, KeyError, TypeError, ValueError):
        entry = known[key][model.name]
        return Found(int(entry[0]), *map(float, entry[1:])) if entry else None
    with jax.ensure_compile_time_eval():
        found = _by_parity(model)
    before = known.get(key)
    same = before if isinstance(before, dict) else {}
    _save(store, known | {key: same | {model.name: found or []}})
    return found


def _by_parity(model: Model) -> Found | None:
    """Return the container whose network makes the filter's image."""
    from jscomb.denoisers.oidn._filter import apply

    images = _test_images(model)
    by_filter = lambda: _host.run(model, images, _EXPOSURE)
    by_network = lambda network: np.asarray(apply(network, model, images, _EXPOSURE))
    wanted, trained = by_filter(), trained_networks()
    fits = [n for n, t in enumerate(trained) if t.inputs == 3 * len(model.inputs)]
    for number in sorted(fits, key=lambda n: trained[n].size != SIZES[model.quality]):
        run = functools.partial(by_network, trained[number].network)
        error = np.linalg.norm(run() - wanted) / np.linalg.norm(wanted)
        if error < TOLERANCE:
            return Found(number, float(error), _seconds(run) / _seconds(by_filter))
    return None


def _test_images(model: Model) -> dict[str, np.ndarray]:
    """Return images with edges and noise, [H,W,3] each."""
    random = np.random.default_rng(0)
    tiles = np.kron(random.uniform(size=(8, 8, 3)), np.ones((_SIDE // 8,) * 2 + (1,)))
    noise = random.exponential(size=(_SIDE, _SIDE, 3))
    signed = 2 * tiles - 1 + 0.2 * (noise - 1)
    color = signed if model.signed else tiles * noise
    images = {"color": color, "albedo": np.roll(tiles, 5), "normal": signed}
    limits = {"color": None if not model.bounded else 1.0, "albedo": 1.0, "normal": 1.0}
    return {
        name: np.clip(images[name], -1.0, limits[name]).astype(np.float32)
        for name in model.inputs
    }


def _seconds(run: Callable[[], Any]) -> float:
    """Return the minimum time of three runs, after one."""
    times = []
    for _ in range(4):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def _libraries() -> list[pathlib.Path]:
    """Return the installed package's libraries that may hold containers."""
    found = importlib.util.find_spec(PACKAGE.module)
    if found is None or found.origin is None:
        return []
    files = pathlib.Path(found.origin).parent.rglob("*OpenImageDenoise_core*")
    return sorted(path for path in files if path.is_file())


def _version() -> str:
    """Return the installed package's version."""
    return importlib.metadata.version(PACKAGE.module)


def _load(store: pathlib.Path) -> dict[str, Any]:
    """Return what was found before; nothing if the file is missing or damaged."""
    try:
        known = json.loads(store.read_text())
        return known if isinstance(known, dict) else {}
    except (OSError, ValueError):
        return {}


def _save(store: pathlib.Path, known: Mapping[str, Any]) -> None:
    """Keep what was found, if the user's cache can be written."""
    temporary = store.with_name(f"{store.name}.{os.getpid()}")
    try:
        store.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(known, indent=1))
        os.replace(temporary, store)
    except OSError:
        return  # found again next time
