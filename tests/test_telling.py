"""What `jscomb combine` shows and says: to people, to programs, to no one."""

import io
import json
import sys
import time

import jax.numpy as jnp
import pytest

from jscomb import exr
from jscomb.cli import _telling
from jscomb.frame import Estimate
from jscomb.methods import Combined
from jscomb.metrics import ErrorEstimate
from tests.conftest import DATA
from tests.test_exr import layer, write
from tests.test_pipeline import BIASED, SMOOTH, SPP, H, W, pbrt


class Terminal(io.StringIO):
    """Standard error that someone looks at."""

    def isatty(self):
        """As of a terminal."""
        return True


def strictly(line):
    """What a line of JSON says, if it is strict."""

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(line, parse_constant=refuse)


@pytest.fixture
def combine(jscomb, tmp_path, monkeypatch):
    """Run `jscomb combine` in a folder with a frame, by what compiles nothing."""
    monkeypatch.chdir(tmp_path)
    write("f.exr", pbrt(), samplesPerPixel=SPP)
    write("d.exr", layer("", SMOOTH))
    return lambda *arguments: jscomb("combine", *arguments, "--method", "denoised")


@pytest.fixture
def two(combine, tmp_path):
    """The arguments for two frames in a folder, and the denoised images of them."""
    for folder in ("in", "den"):
        (tmp_path / folder).mkdir()
    for n in (1, 2):
        write(f"in/s.{n}.exr", pbrt(), samplesPerPixel=SPP)
        write(f"den/s.{n}.exr", layer("", SMOOTH))
    return "in/s.1.exr", "in/s.2.exr", "--biased", "den", "-o", "out/"


def test_quiet_says_nothing(combine):
    assert combine("f.exr", *BIASED, "-o", "o.exr", "--quiet") == (0, "", "")
    again = combine("f.exr", *BIASED, "-o", "o.exr", "--quiet")
    assert again == (0, "", "")
    status, said, error = combine("f.exr", *BIASED, "-o", "f.exr", "--quiet")
    assert (status, said, error.count("\n")) == (2, "", 1)


def test_verbose_says_what_was_read_and_how_long_it_took(combine):
    status, said, error = combine("f.exr", *BIASED, "-o", "o.exr", "--verbose")
    read, wrote, seconds = said.splitlines()
    frame = f"{W}x{H}, 16 samples a pixel in 1 sub-buffer, median luminance 0."
    assert (status, error) == (0, "")
    assert read.startswith(f"read f.exr: {frame}")
    assert wrote == f"wrote o.exr: {W}x{H}, denoised of d.exr"
    assert seconds.startswith("seconds: reading ")
    assert "; combining by denoised " in seconds
    assert "; writing " in seconds


def test_json_is_one_line_a_frame(combine, two, tmp_path):
    (tmp_path / "in/s.2.exr").write_bytes(b"no image")
    status, said, error = combine(*two, "--json")
    assert status == 2
    assert error == "jscomb: 1 of 2 frames failed: s.2.exr\n"
    good, bad = (strictly(line) for line in said.splitlines())
    assert set(good.pop("seconds")) == {"reading", "combining", "writing"}
    assert good == {
        "frame": "in/s.1.exr",
        "out": "out/s.1.exr",
        "status": "written",
        "tier": None,
        "method": "denoised",
        "bases": ["s.1.exr"],
        "errors": None,
        "notes": [],
    }
    assert (bad["frame"], bad["status"]) == ("in/s.2.exr", "failed")
    assert "\n" not in bad["error"]
    _, said, _ = combine(*two, "--json")
    assert strictly(said.splitlines()[0])["status"] == "there already"


def test_json_of_the_only_frame_that_fails(jscomb, tmp_path):
    path, out = tmp_path / "s.exr", tmp_path / "o.exr"
    path.write_bytes(b"no image")
    status, said, error = jscomb("combine", path, "-o", out, "--json")
    assert status == 2
    found = strictly(said)
    assert (found["frame"], found["out"]) == (str(path), str(out))
    assert found["status"] == "failed"
    assert error == f"jscomb: {path}: {found['error']}\n"


def test_json_of_a_tier(jscomb, tmp_path, glass_frame):
    """Its estimates, why not others, its error, and those against the reference."""
    truth = glass_frame.reference.image
    halves = jnp.stack([truth, truth])
    frame = glass_frame._replace(estimates={"y": Estimate(truth, halves)})
    exr.write_frame(tmp_path / "f.exr", frame)
    command = ("combine", tmp_path / "f.exr", "-o", tmp_path / "o.exr", "--biased", "y")
    status, said, error = jscomb(*command, "--json")
    found = strictly(said)
    assert (status, error, said.count("\n")) == (0, "", 1)
    assert (found["tier"], found["method"]) == ("best", None)
    assert found["bases"] == ["y", "path-tracing"]
    assert (found["skipped"], found["reason"]) == ({}, "")
    assert set(found["seconds"]) == {"reading", "making", "combining", "writing"}
    assert set(found["errors"]) == {"input", "y", "best"}
    told = exr.read_provenance(tmp_path / "o.exr")["estimated relative L2"]
    assert [*found["estimated_relative_l2"].values()] == told


def test_voices_exclude_each_other(combine):
    for flags in (("--quiet", "--json"), ("--verbose", "--quiet")):
        status, said, error = combine("f.exr", *BIASED, "-o", "o.exr", *flags)
        assert (status, said) == (2, "")
        assert error.endswith(": expected one of them\n")
        assert all(flag in error for flag in flags)


def test_progress_is_for_a_terminal(combine, two, monkeypatch):
    """By phase, with the number of frames; never on standard output."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    status, said, _ = combine(*two)
    assert (status, said.count("\n")) == (0, 2)
    shown = terminal.getvalue()
    for part in (
        "s.1.exr: reading",
        "s.2.exr: combining by denoised",
        "writing",
        "1 of 2 frames done",
    ):
        assert part in shown
    for flag in ("--quiet", "--json"):
        terminal = Terminal()
        monkeypatch.setattr(sys, "stderr", terminal)
        _, said, _ = combine("f.exr", *BIASED, "-o", f"{flag[2:]}.exr", flag)
        assert ("reading" in terminal.getvalue()) == (flag == "--json")
        assert all(strictly(line) for line in said.splitlines())
        assert "\r" not in said


def test_time_goes_on_while_something_is_compiled(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with _telling.Teller("sentences", 1) as teller:
        teller.begin("making pd")
        time.sleep(2.5)
    shown = terminal.getvalue()
    for second in (0, 1, 2):
        assert f"00:0{second} making pd (compiled the first time)" in shown


def test_a_sentence_says_what_and_why():
    """Reasons that several share are said once."""
    image = Estimate(jnp.ones((4, 4, 3)))
    error = ErrorEstimate(jnp.ones((4, 4, 1)), jnp.array(0.00312), jnp.array(0.00043))
    skipped = {"a": "needs x", "b": "needs y", "c": "needs x"}
    made = Combined(image, "best", ("d", "e"), skipped, "", error)
    assert _telling.sentence(made, "because") == (
        "best: ensemble of 2 estimates; estimated relative L2 0.0031 ± 0.0004 at "
        "median luminance 1; because; a, c skipped: needs x; b skipped: needs y"
    )
    alone = made._replace(error=None, bases=("oidn",), skipped={}, tier="denoised")
    assert _telling.sentence(alone, "") == "denoised: oidn alone"
    empty = error._replace(mean=jnp.array(jnp.nan), standard_error=jnp.array(0.0))
    assert "nan ± 0" in _telling.sentence(made._replace(error=empty), "")
    found = _telling.summary(made._replace(error=empty))["estimated_relative_l2"]
    assert found == {"mean": None, "standard_error": 0.0}


def test_info_tells_sub_buffers_from_those_that_were_rendered(jscomb):
    """Of a file that holds a render's four, merged into two."""
    (small, *_) = exr.bundled().values()
    for path, told in (
        (small, "2 sub-buffers, rendered in 4 and merged"),
        (DATA / small.name, "4 sub-buffers"),
    ):
        _, said, _ = jscomb("info", path)
        assert f"samples a pixel in {told}\n" in said
        assert "sub-buffers rendered = 4" in said
