"""The corpus of hostile files, and whether its verdicts are right."""

import contextlib
import os
import pathlib
import signal
import time

import numpy as np
import pytest

from jscomb.frame import make_frame
from tests.exr_corpus import attack, hostile

CONFIG = attack.Config(quick=True)


@pytest.mark.slow
def test_nothing_bad_comes_of_the_corpus():
    table = attack.run(CONFIG)
    assert not attack.bad(table), table
    assert sum(counts.total() for counts in table.values()) > 1000
    for kind in ("deep", "read-only folder", "full disk (limit of a file's size)"):
        assert table[kind]["clear error"]
    for kind in (f"{hostile.THEIRS}, every compression", "two writers and a reader"):
        assert table[kind]["right image"] > 5


def crash(path, limit):
    os.kill(os.getpid(), signal.SIGSEGV)


def hang(path, limit):
    time.sleep(60)


def believe(path, limit):
    np.ones(2**31)


def look_away(path, limit):
    return hostile.arrays(make_frame(np.zeros((8, 8, 3), np.float32)))


def mumble(path, limit):
    raise ValueError("bad file")


def stammer(path, limit):
    raise ValueError(f"{path}: bad\nfile")


def leak(path, limit):
    raise KeyError(path)


@pytest.mark.parametrize(
    ("read", "outcome"),
    [
        (crash, "crash"),
        (hang, "hang"),
        (believe, "out of memory"),
        (look_away, "wrong image"),
        (mumble, "unclear error"),
        (stammer, "unclear error"),
        (leak, "unclear error"),
        (attack.read, "right image"),
    ],
)
def test_verdicts_are_right(tmp_path, read, outcome):
    """The worker continues after a crash or a hang."""
    frame = hostile.own_frame(0)
    data = hostile.own_bytes(frame, tmp_path)
    case = hostile.Case("file", data, hostile.arrays(frame))
    config = attack.Config(seconds=1.0)
    table = attack.read_all([case] * 2, tmp_path, config, read=read)
    assert table == {"file": {outcome: 2}}
    assert attack.bad(table) == (0 if read is attack.read else 2)


def write_in_place(path, seed):
    """Overwrite the file, as the binding does, and leave it truncated."""
    data = hostile.own_bytes(hostile.own_frame(seed), pathlib.Path(path).parent)
    with open(path, "wb") as file:
        file.write(data[:-1])


def write_in_vain(path, seed):
    """Fail, and leave a temporary file behind."""
    with open(f"{path}.tmp", "wb"):
        raise OSError(f"{path}: no space left")


@pytest.mark.parametrize("write", [write_in_place, write_in_vain])
def test_damage_is_seen(tmp_path, write):
    attack.write(os.fspath(tmp_path / "old.exr"), attack.OLD)
    with contextlib.closing(attack._worker(CONFIG)) as worker:
        assert attack.written(worker, tmp_path, write) == "damaged file"
        attack.write(os.fspath(tmp_path / "old.exr"), attack.OLD)
        (tmp_path / "old.exr.tmp").unlink(missing_ok=True)
        (tmp_path / "own.exr").unlink(missing_ok=True)
        assert attack.written(worker, tmp_path, attack.write) == "right image"
