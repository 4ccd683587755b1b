"""Read damaged, hostile and unusual EXR files, and write where writing fails.

Every file of the corpus (`hostile`) is read in another process with little memory and
little time, so that crashes, hangs and believed claims are seen. Good outcomes are the
right image, one clear error, or another image where the file has no checksum that
covers the change. All else is bad. Also bad are a failed write (read-only folder, full
disk) that leaves a damaged file or gives no clear error, and a read during concurrent
writes that returns none of the written frames.
"""

import collections
import contextlib
import dataclasses
import os
import pathlib
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from tqdm import tqdm

from jscomb import exr
from tests.exr_corpus import hostile
from tests.exr_corpus.hostile import Arrays, Case
from tests.exr_corpus.workers import Reply, Worker


@dataclasses.dataclass(frozen=True)
class Config:
    """Limits of the attempts.

    Attributes:
        seed: of the images.
        step: bytes from one damage to the next.
        limit: mebibytes that a file may claim.
        headroom: mebibytes that reading may allocate.
        seconds: that an attempt may take.
        quick: damage few bytes.
    """

    seed: int = 0
    step: int = 5
    limit: int = 16
    headroom: int = 256
    seconds: float = 20.0
    quick: bool = False


GOOD = ("right image", "clear error", "no checksum")
BAD = (
    "wrong image",
    "unclear error",
    "out of memory",
    "damaged file",
    "hang",
    "crash",
)
Table = dict[str, collections.Counter[str]]  # outcomes by kind

Read = Callable[[str, int], Arrays]


def read(path: str, limit: int) -> Arrays:
    """Return the arrays of a frame that may claim at most `limit` bytes."""
    return hostile.arrays(exr.read_frame(path, max_bytes=limit))


def prepare() -> None:
    """Read and write once, so that everything is imported and JAX has started."""
    with tempfile.TemporaryDirectory() as name:
        write(f"{name}/frame.exr", 0)
        read(f"{name}/frame.exr", 2**30)


def _worker(config: Config) -> Worker:
    """Return a process to attempt in."""
    return Worker(prepare, config.headroom * 2**20, config.seconds)


def verdict(path: str, reply: Reply, right: Arrays | None, tolerance: float) -> str:
    """Return the outcome of reading a file, one of `GOOD` or `BAD`.

    Args:
        path: the file.
        reply: of the attempt.
        right: arrays of the frame in the file; None if only an error is right.
        tolerance: largest difference from them.

    Returns:
        the outcome; "no checksum" is left to the caller.
    """
    if reply.failure:
        return reply.failure
    if isinstance(reply.error, MemoryError):
        return "out of memory"
    if reply.error is not None:
        message = str(reply.error)
        clear = isinstance(reply.error, OSError | ValueError) and path in message
        return "clear error" if clear and "\n" not in message else "unclear error"
    same = right is not None and _same(reply.value, right, tolerance)
    return "right image" if same else "wrong image"


def _same(a: Arrays, b: Arrays, tolerance: float) -> bool:
    """Return whether two frames have the same arrays."""
    return a.keys() == b.keys() and all(
        a[k].shape == b[k].shape
        and np.allclose(a[k], b[k], rtol=0, atol=tolerance, equal_nan=True)
        for k in a
    )


def read_all(
    cases: Iterable[Case], folder: pathlib.Path, config: Config, *, read: Read = read
) -> Table:
    """Return the outcomes of reading every file of a corpus.

    Args:
        cases: the corpus.
        folder: for the files.
        config: the limits.
        read: function at the top of a module, from a path and a limit to arrays.

    Returns:
        counts of outcomes by kind.
    """
    table: Table = collections.defaultdict(collections.Counter)
    path = str(folder / "case.exr")
    with contextlib.closing(_worker(config)) as worker:
        for case in tqdm(cases, unit="file", disable=None):
            pathlib.Path(path).write_bytes(case.data)
            reply = worker.attempt(read, path, config.limit * 2**20)
            outcome = verdict(path, reply, case.right, case.tolerance)
            if outcome == "wrong image" and not case.has_checksum:
                outcome = "no checksum"
            table[case.kind][outcome] += 1
            if outcome in BAD:
                tqdm.write(f"{case.kind}: {outcome}: {reply.error}", sys.stderr)
    return table


def write(path: str, seed: int) -> None:
    """Write the frame of a seed."""
    exr.write_frame(path, hostile.own_frame(seed))


def write_often(path: str, seed: int) -> None:
    """Write it again and again."""
    for _ in range(100):
        write(path, seed)


def write_as_nobody(path: str, seed: int) -> None:
    """Write as a user without permission, even if this process is root."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        write(path, seed)
    finally:
        os.seteuid(user)


def write_little(path: str, seed: int, size: int) -> None:
    """Write where files are limited to `size` bytes."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        write(path, seed)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def written(
    worker: Worker, folder: pathlib.Path, function: Callable, *arguments: Any
) -> str:
    """Return the outcome of writing over a file.

    Args:
        worker: to write and read in.
        folder: with the file.
        function: writes to a path the frame of a seed.
        arguments: its other arguments.

    Returns:
        the outcome; a file is damaged if it changed despite an error, or differs from
        what was written.
    """
    path, contents = folder / "old.exr", lambda: _contents(folder)
    before = contents()
    reply = worker.attempt(function, str(path), NEW, *arguments)
    outcome = verdict(str(path), reply, None, 0)
    if outcome == "wrong image":  # no error: the new frame must be there
        reply = worker.attempt(read, str(path), 2**30)
        outcome = verdict(str(path), reply, hostile.arrays(hostile.own_frame(NEW)), 0)
        alone = contents().keys() == before.keys()
        return outcome if outcome == "right image" and alone else "damaged file"
    return outcome if contents() == before else "damaged file"


OLD, NEW = 100, 200  # seeds


def _contents(folder: pathlib.Path) -> dict[str, bytes]:
    """Return all files of a folder."""
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def write_all(folder: pathlib.Path, config: Config) -> Table:
    """Return the outcomes of writing where it is difficult.

    Args:
        folder: for the files.
        config: the limits.

    Returns:
        counts of outcomes by kind; empty for a kind that this machine cannot try, with
        the reason in its name.
    """
    table: Table = collections.defaultdict(collections.Counter)
    path = folder / "old.exr"
    write(str(path), OLD)
    size = path.stat().st_size
    with contextlib.closing(_worker(config)) as worker:
        folder.chmod(0o555)
        table["read-only folder"][written(worker, folder, write_as_nobody)] += 1
        folder.chmod(0o755)
        for limit in range(0, size + 2 * 512, 512):
            outcome = written(worker, folder, write_little, limit)
            table["full disk (limit of a file's size)"][outcome] += 1
        for kibibytes in range(2 * size // 1024 + 12, size // 1024, -4):
            with _disk(folder / "disk", kibibytes) as (disk, reason):
                kind = "full disk (a small one)"
                if reason:
                    table[f"{kind}: {reason}"].clear()
                    break
                with contextlib.suppress(OSError):
                    write(str(disk / "old.exr"), OLD)
                table[kind][written(worker, disk, write)] += 1
        table["two writers and a reader"] = _race(worker, path, config)
    return table


@contextlib.contextmanager
def _disk(folder: pathlib.Path, kibibytes: int) -> Iterator[tuple[pathlib.Path, str]]:
    """Mount a disk of that size; yield its folder, and the reason if that fails."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kibibytes}k", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True)
        reason = done.stderr.strip()
    except OSError as error:
        reason = str(error)
    try:
        yield folder, reason
    finally:
        if not reason:
            subprocess.run(["umount", str(folder)], check=True)
        folder.rmdir()


def _race(worker: Worker, path: pathlib.Path, config: Config) -> collections.Counter:
    """Count outcomes of reading a file that two processes write."""
    found: collections.Counter[str] = collections.Counter()
    rights = [hostile.arrays(hostile.own_frame(seed)) for seed in (OLD, NEW)]
    writers = [_worker(config), _worker(config)]
    for writer, seed in zip(writers, (OLD, NEW), strict=True):
        writer.send(write_often, str(path), seed)
    end = time.monotonic() + config.seconds
    while time.monotonic() < end and not all(w.pipe.poll() for w in writers):
        reply = worker.attempt(read, str(path), 2**30)
        outcomes = [verdict(str(path), reply, right, 0) for right in rights]
        found[max(outcomes, key=lambda outcome: outcome == "right image")] += 1
    for writer in writers:
        reply = writer.receive()
        if reply.error or reply.failure:
            found[reply.failure or "unclear error"] += 1
        writer.close()
    left = [file for file in path.parent.iterdir() if file != path]
    found["damaged file"] += len(left)
    return +found


def run(config: Config) -> Table:
    """Return the counts of outcomes of everything, by kind."""
    step = 40 * config.step if config.quick else config.step
    with tempfile.TemporaryDirectory() as name:
        files, writing = pathlib.Path(name, "files"), pathlib.Path(name, "writing")
        files.mkdir()
        writing.mkdir()
        pathlib.Path(name).chmod(0o755)  # for those who are not its owner
        cases = hostile.corpus(files, seed=config.seed, step=step)
        return read_all(cases, files, config) | write_all(writing, config)


def bad(table: Table) -> int:
    """Return how many outcomes are bad."""
    return sum(counts[outcome] for counts in table.values() for outcome in BAD)
