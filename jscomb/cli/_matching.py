"""Files that belong to the frames of a sequence: folders and patterns, by number.

The number of a frame is the run of digits in its name that differs within the sequence,
or the last one: `shot_v2.0007.exr` is frame 7.
"""

import os
import re
from collections.abc import Sequence

from jscomb.exr import dialects

_NUMBER = re.compile(r"#+|@+|%0?\d*d|\$F\d*|<F\d*>|\{frame\}")
_ANY = re.compile(r"[*?]")


def is_several(given: str) -> bool:
    """Return whether a folder of images or a pattern is meant, not one file."""
    if os.path.exists(given):
        return os.path.isdir(given) and not dialects.is_frame(given)
    return bool(_NUMBER.search(given) or _ANY.search(given))


def match(option: str, given: str, frames: Sequence[str]) -> list[str | ValueError]:
    """Return the file that belongs to each frame, or why there is none.

    Args:
        option: that it was given to, for errors.
        given: a file, a folder, or a pattern: # or %04d for the number, * for anything.
        frames: all frames of the sequence.

    Raises:
        ValueError: if one file is given for several frames, or one would be taken for
            two.
    """
    if not is_several(given):
        if len(frames) > 1 and os.path.exists(given):
            raise ValueError(
                f"{option} {given}: is one image for {len(frames)} frames: give a "
                "folder, or a pattern such as denoised.####.exr"
            )
        return [given] * len(frames)
    files = _files(given)
    if not files:
        raise ValueError(f"{option} {given}: no such files")
    by_name = {os.path.basename(file): file for file in files}
    numbers, own = _numbers(files), _numbers(frames)
    found: list[str | ValueError] = []
    for frame in frames:
        same = by_name.get(os.path.basename(os.path.abspath(frame)))
        number = own[frame]
        among = [f for f in files if numbers[f] == number and number is not None]
        if same is not None and not _NUMBER.search(given):
            found.append(same)
        elif len(among) == 1:
            found.append(among[0])
        elif len(files) == len(frames) == 1 and number is None:
            found.append(files[0])
        else:
            listed = ", ".join(os.path.basename(file) for file in among) or "none"
            found.append(
                ValueError(
                    f"{option} {given}: needs one file of frame {number}, has {listed}"
                )
            )
    _check_distinct(option, frames, found)
    return found


def _check_distinct(
    option: str, frames: Sequence[str], found: Sequence[str | ValueError]
) -> None:
    """Raise if two frames would take the same file."""
    first: dict[str, str] = {}
    for frame, file in zip(frames, found, strict=True):
        if isinstance(file, str) and first.setdefault(file, frame) != frame:
            raise ValueError(
                f"{option}: {file} would be taken for both {first[file]} and {frame}"
            )


def expand(pattern: str) -> list[str]:
    """Return the files of a folder or a pattern, in the order of their numbers."""
    files = _files(pattern)
    numbers = _numbers(files)
    return sorted(files, key=lambda file: (numbers[file] or 0, file))


def _files(given: str) -> list[str]:
    """The files of a folder or a pattern."""
    if os.path.isdir(given):
        folder, wanted = given, re.compile(r".*\.exr", re.I)
    else:
        folder, name = os.path.split(given)
        wanted = re.compile(_regular(name))
    if not os.path.isdir(folder or "."):
        return []
    names = sorted(name for name in os.listdir(folder or ".") if wanted.fullmatch(name))
    return [os.path.join(folder, name) for name in names if not name.startswith(".")]


def _regular(name: str) -> str:
    """A pattern of names as a regular expression."""
    found, place = "", 0
    for wild in re.finditer(f"{_NUMBER.pattern}|{_ANY.pattern}", name):
        found += re.escape(name[place : wild.start()])
        found += {"*": ".*", "?": "."}.get(wild[0], r"\d+")
        place = wild.end()
    return found + re.escape(name[place:])


def _numbers(files: Sequence[str]) -> dict[str, int | None]:
    """The frame numbers in the names of files."""
    runs = {f: re.findall(r"\d+", os.path.basename(os.path.abspath(f))) for f in files}
    columns = {len(each) for each in runs.values()}
    varying: list[int] = []
    if len(columns) == 1:
        count = columns.pop()
        values = [[int(run) for run in each] for each in runs.values()]
        varying = [n for n in range(count) if len({value[n] for value in values}) > 1]
    place = varying[-1] if varying else -1
    return {f: int(each[place]) if each else None for f, each in runs.items()}
