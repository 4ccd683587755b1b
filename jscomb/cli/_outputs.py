"""Where results go, and what is never replaced."""

import json
import os
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import tyro

from jscomb import exr

SUFFIX = ".exr"
Force = Annotated[bool, tyro.conf.FlagCreatePairsOff]


def targets(frames: Sequence[str], out: str) -> list[str]:
    """Return the file to write for each frame.

    Args:
        frames: files or directories.
        out: a file for one frame; else a folder, also one with a slash at the end that
            is not there yet.

    Raises:
        ValueError: if `out` is neither a folder nor an EXR file, or names collide.
    """
    if not out:
        raise ValueError("-o: expected a file or a folder, got nothing")
    is_folder = os.path.isdir(out) or out.endswith((os.sep, "/"))
    path = out.rstrip("/") or out
    is_file = os.path.lexists(path) and not os.path.isdir(path)
    has_suffix = out.lower().endswith(SUFFIX)
    if len(frames) == 1 and not is_folder:
        if not has_suffix:
            raise ValueError(
                f"-o {out}: expected a name that ends in {SUFFIX}, or a folder: "
                f"{os.path.join(out, '')}"
            )
        return [out]
    if is_file or (has_suffix and not is_folder):
        count = f"{len(frames)} frames need" if len(frames) > 1 else "this names"
        raise ValueError(f"-o {out}: {count} a folder, not a file")
    found = [os.path.join(out, name_of(frame) + SUFFIX) for frame in frames]
    if twice := {os.path.basename(f) for f in found if found.count(f) > 1}:
        raise ValueError(f"several frames would be written as {', '.join(twice)}")
    return found


def name_of(frame: str) -> str:
    """Return the name of a frame: a file's without its suffix, a directory's whole."""
    name = os.path.basename(os.path.abspath(frame))
    is_file = name.lower().endswith(SUFFIX) and not os.path.isdir(frame)
    return name[: -len(SUFFIX)] if is_file else name


def check_inputs_stay(found: Sequence[str], inputs: Sequence[str]) -> None:
    """Raise if an output is one of the inputs, by whatever name.

    Args:
        found: files to write.
        inputs: files to read.
    """
    known = {_identity(file): file for file in inputs if os.path.exists(file)}
    for target in found:
        same = known.get(_identity(target)) if os.path.exists(target) else None
        if same is not None:
            raise ValueError(
                f"-o {target}: is the input {same}, which is never replaced: choose "
                "another file or folder"
            )


def _identity(file: str) -> tuple[int, int]:
    """What is the same for all names of a file."""
    status = os.stat(file)
    return status.st_dev, status.st_ino


def check_folder(target: str) -> None:
    """Raise if a file that was named would be in no folder.

    Args:
        target: file to write.
    """
    folder = os.path.dirname(os.path.realpath(target))
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"{target}: the folder {folder} does not exist")


def check_is_new(target: str, *, force: bool) -> None:
    """Raise if a file is there that must not be replaced.

    Args:
        target: file to write.
        force: replace it.
    """
    if os.path.isfile(target) and not force:
        raise ValueError(f"{target} exists: --force replaces it")


def state(
    target: str, frame: str, made_from: dict[str, Any], *, force: bool
) -> Literal["done", "to do"]:
    """Return whether a target is made already; raise if it must not be replaced.

    Args:
        target: file to write.
        frame: that it is made of.
        made_from: what distinguishes this result from others.
        force: replace anything that is no input.

    Raises:
        ValueError: if there is a file that is not an older result of the same frame.
    """
    if not os.path.exists(target):
        return "to do"
    if os.path.isdir(target):
        raise ValueError(f"{target}: is a folder")
    if not os.path.isfile(target):
        raise ValueError(f"{target}: is not a file")
    found = exr.read_result(target)
    ours = "made from" in found
    if ours and found["made from"] == json.loads(json.dumps(made_from)):
        return "done"
    if force or (ours and found.get("path") == path_from(target, frame)):
        return "to do"
    why = "jscomb combine did not make it, or it was changed since"
    if ours:
        why = f"jscomb combine made it of {found.get('path')}"
    raise ValueError(f"{target} exists, and {why}: --force replaces it")


def path_from(target: str, frame: str) -> str:
    """Return the path of a frame as seen from its result.

    Args:
        target: the result.
        frame: file or directory.
    """
    return os.path.relpath(frame, os.path.dirname(os.path.abspath(target)))
