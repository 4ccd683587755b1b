"""`jscomb combine` of many frames and of large ones."""

import os

import jax
import numpy as np
import pytest

from jscomb import exr, methods
from jscomb.cli import _combining
from jscomb.numerics import tiles
from tests.conftest import DATA

GLASS, BOX = (DATA / f"cornell-{name}-64.exr" for name in ("glass", "box"))


LOCAL = [name for name, method in methods.METHODS.items() if method.plan is not None]


@pytest.mark.slow
@pytest.mark.parametrize("method", LOCAL)
def test_methods_are_local(method, glass_frame):
    """By crops, and on a device as one of several, what they are as a whole."""
    found = methods.plan(jax.random.key(0), glass_frame, method=method)
    whole = np.asarray(found.whole())
    made = np.empty_like(whole)
    for where, part in tiles.stream_crops(**found._asdict(), tile=17):
        made[where] = part
    shards = tiles.map_shards(**found._asdict())
    for parts in (made, shards):
        np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-6)


@pytest.fixture
def small_crops(monkeypatch):
    """Every frame is a large one."""
    monkeypatch.setattr(_combining, "LARGE", 1000)


@pytest.mark.slow
def test_large_frames_are_the_same(jscomb, small_crops, monkeypatch, tmp_path):
    wide = tmp_path / "wide.exr"
    status, said, _ = jscomb("combine", GLASS, "-o", wide, "--method", "whitened")
    assert status == 0
    seen = []
    within = _combining.tile_within
    keep = lambda *args, **options: seen.append(within(*args, **options)) or 20
    monkeypatch.setattr(_combining, "tile_within", keep)
    crops = tmp_path / "crops.exr"
    assert jscomb("combine", GLASS, "-o", crops, "--method", "whitened")[0] == 0
    assert seen == [64]
    np.testing.assert_allclose(
        exr.read_image(crops), exr.read_image(wide), rtol=1e-5, atol=1e-7
    )
    command = "combine", GLASS, "-o", crops, "--method", "whitened", "--memory", "0"
    status, _, said = jscomb(*command)
    assert status == 2
    assert "the budget is 0 MiB" in said


def test_sequences_go_on(jscomb, tmp_path):
    """Past a bad frame, and after an interruption."""
    bad, out = tmp_path / "bad.exr", tmp_path / "out"
    bad.write_bytes(GLASS.read_bytes()[:5000])
    command = ["combine", GLASS, bad, BOX, "-o", out, "--method", "whitened"]
    status, said, wrong = jscomb(*command)
    assert status == 2
    assert wrong.strip().endswith("1 of 3 frames failed: bad.exr")
    assert str(bad) in wrong
    made = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert made.keys() == {GLASS.name, BOX.name}
    (out / BOX.name).unlink()
    bad.write_bytes(BOX.read_bytes())
    status, said, _ = jscomb(*command)
    assert status == 0
    assert said.count("is there already") == 1
    again = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert again[GLASS.name] == made[GLASS.name]
    assert again.keys() == {GLASS.name, BOX.name, "bad.exr"}
    np.testing.assert_array_equal(
        exr.read_image(out / "bad.exr"), exr.read_image(out / BOX.name)
    )


def test_what_has_changed_is_made_anew(jscomb, tmp_path):
    """By contents, not by dates; only by --force what is no result of the frame."""
    frame, out = tmp_path / "f.exr", tmp_path / "out"
    out.mkdir()
    frame.write_bytes(GLASS.read_bytes())
    command = ["combine", frame, "-o", out, "--method"]
    assert "there already" not in jscomb(*command, "whitened")[1]
    assert "there already" in jscomb(*command, "whitened")[1]
    assert "there already" not in jscomb(*command, "denoised")[1]
    os.utime(frame, ns=(0, 0))
    assert "there already" in jscomb(*command, "denoised")[1]
    frame.write_bytes(BOX.read_bytes())
    assert "wrote" in jscomb(*command, "denoised")[1]
    (out / "f.exr").write_bytes(b"no image")
    status, _, said = jscomb(*command, "denoised")
    assert status == 2
    assert "--force replaces it" in said
    assert (out / "f.exr").read_bytes() == b"no image"
    assert "wrote" in jscomb(*command, "denoised", "--force")[1]


def test_names_must_differ(jscomb, tmp_path):
    other = tmp_path / GLASS.name
    other.write_bytes(b"")
    status, _, said = jscomb("combine", GLASS, other, "-o", tmp_path / "out")
    assert status == 2
    assert f"several frames would be written as {GLASS.name}" in said
