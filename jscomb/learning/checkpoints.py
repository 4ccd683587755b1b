"""The arrays of a pytree, such as a network, as a safetensors file and back."""

import os
import pathlib
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

__all__ = ["load", "save"]

Tree = TypeVar("Tree")


def save(path: pathlib.Path, tree: Any) -> pathlib.Path:
    """Write the arrays of a tree under their names in it.

    Replaces an existing file completely or not at all.

    Args:
        path: file to write.
        tree: any pytree.

    Returns:
        the path.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "gain.safetensors")
        ...     print(list(load_file(save(path, {"gain": np.ones(2)}))))
        ['gain']
    """
    arrays = {name: jax.device_get(array) for name, array in _named(tree)}
    temporary = path.with_name(path.name + ".tmp")
    save_file(arrays, temporary)
    os.replace(temporary, path)
    return path


def load(path: pathlib.Path, like: Tree) -> Tree:
    """Read arrays into a tree of a given structure.

    Args:
        path: a file that `save` wrote.
        like: a tree of arrays, or of their shapes (`jax.eval_shape`).

    Returns:
        the tree with the file's arrays.

    Raises:
        ValueError: if the file is missing, damaged, or differs from the tree in names,
            shapes or types; names the first array that differs.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> tree = {"gain": np.array([1.0, 2.0], np.float32)}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = save(pathlib.Path(folder, "gain.safetensors"), tree)
        ...     print(load(path, tree)["gain"])
        [1. 2.]
    """
    try:
        arrays = load_file(path)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file of parameters") from None
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file: {error}") from None
    wanted = dict(_named(like))
    for name in sorted(wanted.keys() | arrays.keys()):
        has, wants = (
            f"{d[name].dtype}{list(d[name].shape)}" if name in d else "nothing"
            for d in (arrays, wanted)
        )
        if has != wants:
            raise ValueError(
                f"{path}: does not fit the network: {name} is {has}, expected {wants}"
            )
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(tree: Any) -> list[tuple[str, Any]]:
    """Return the leaves with their names, such as body/down/0/1/kernel/value."""
    leaves, _ = jax.tree.flatten_with_path(tree)
    return [
        (jax.tree_util.keystr(path, simple=True, separator="/"), leaf)
        for path, leaf in leaves
    ]
