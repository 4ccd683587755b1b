"""The command: every subcommand for real, and one line with status 2 for bad input."""

import importlib.util
import json
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest

import jscomb as package
from jscomb import exr, metrics
from jscomb.cli import _demo
from jscomb.exr._files import read_parts
from jscomb.frame import Estimate
from jscomb.methods import BASES, METHODS, TIERS
from jscomb.numerics.guards import finite
from tests.conftest import DATA
from tests.test_exr import layer, noise, write

GLASS = DATA / "cornell-glass-64.exr"


def errors_in(text, column=0):
    """A column of the printed table, by method."""
    rows = re.findall(r"^ {2}(\S.*?) {2,}((?:[\d.]+ *)+)$", text, re.M)
    return {name: float(values.split()[column]) for name, values in rows}


def test_demo_of_a_small_frame(jscomb, tmp_path, monkeypatch, glass_frame):
    """A corner of a crop of the bundled frame, by a method of each process."""
    corner = lambda i: i[..., :24, :24, :] if i.ndim > 2 else i
    small, out = tmp_path / "small.exr", tmp_path / "demo"
    exr.write_frame(small, jax.tree.map(corner, glass_frame))
    monkeypatch.setattr(exr, "bundled", lambda: {_demo.NAME: small})
    monkeypatch.setattr(_demo, "PAPERS", ("whitened",))
    monkeypatch.setattr(_demo, "_APART", ("whitened",))
    monkeypatch.setattr(_demo, "TIERS", ("fast",))
    status, said, _ = jscomb("demo", "--out", out)
    assert status == 0
    rows = dict(re.findall(r"^ {2}(\S.*?) {2,}(0\.\d+)", said, re.M))
    assert [*rows] == ["path tracing", "denoised", "whitened", "fast"]
    assert re.search(r"^  fast +0\.\d+ +\d", said, re.M)
    frame = exr.read_frame(small)
    files = {path.name for path in out.iterdir()}
    assert files == {
        "comparison.png",
        f"{_demo.NAME}-whitened.exr",
        f"{_demo.NAME}-fast.exr",
    }
    r, noise = frame.reference
    for name in ("whitened", "fast"):
        image = exr.read_image(out / f"{_demo.NAME}-{name}.exr")
        found = float(metrics.rel_l2(image, r, half_difference=noise))
        np.testing.assert_allclose(float(rows[name]), found, atol=6e-6)


def test_demo_needs_no_extra(glass_frame, monkeypatch):
    """It says what is left out, and what to install."""
    there = importlib.util.find_spec
    gone = lambda name: None if name == "pyoidn" else there(name)
    monkeypatch.setattr(importlib.util, "find_spec", gone)
    made = _demo._made(glass_frame, ["pd", "denoised"])
    assert made["pd"] == 'needs the package pyoidn: pip install "jscomb[oidn]"'
    assert made["denoised"].shape == (64, 64, 3)


@pytest.mark.parametrize(
    "method", ["auto", "fast", "denoised", *_demo.PAPERS, "bilateral", "ensemble"]
)
def test_combine_writes_what_it_reports(jscomb, tmp_path, method, glass_frame):
    path = tmp_path / "out.exr"
    status, out, _ = jscomb("combine", GLASS, "-o", path, "--method", method)
    assert status == 0
    if method == "auto":
        method = "best"
        count = len(TIERS["best"].bases)
        said = f"best: ensemble of {count} estimates; estimated relative L2 0."
        assert said in out
    image = exr.read_image(path)
    r, noise = glass_frame.reference
    error = float(metrics.rel_l2(image, r, half_difference=noise))
    np.testing.assert_allclose(errors_in(out)[method], error, atol=6e-6)
    about = exr.read_provenance(path)
    bases = {"bilateral": [], "ensemble": [*BASES], "best": [*TIERS["best"].bases]}
    assert (about["method"], about["biased"]) == (method, bases.get(method, ["oidn"]))
    assert about["input"]["scene"] == "cornell-glass"


def test_combine_keeps_a_perfect_image(jscomb, tmp_path, glass_frame):
    """A biased image that is the truth can only be harmed, and the halves tell."""
    truth = glass_frame.reference.image
    frame = glass_frame._replace(estimates={})
    perfect = frame.with_estimate("perfect", Estimate(truth, np.stack([truth, truth])))
    exr.write_frame(tmp_path / "f.exr", perfect)
    out = tmp_path / "o.exr"
    command = ("combine", tmp_path / "f.exr", "-o", out, "--biased", "perfect")
    status, said, _ = jscomb(*command)
    assert status == 0
    assert "best of perfect, path-tracing" in said
    error = lambda image: float(metrics.rel_l2(image, truth))
    assert error(exr.read_image(out)) < 0.03 * error(frame.color)
    about = exr.read_provenance(out)
    assert about["method"] == "best"
    mean, deviation = about["estimated relative L2"]
    assert abs(mean) < 0.03 * error(frame.color) + 3 * deviation
    (part,) = read_parts(os.fspath(out))
    assert part.channels["error.Y"].shape == (64, 64)
    np.testing.assert_allclose(part.channels["error.Y"].mean(), max(mean, 0), rtol=1e-3)


def test_combine_with_a_file(jscomb, tmp_path, glass_frame):
    biased = tmp_path / "flat.exr"
    exr.write_image(biased, np.zeros((64, 64, 3)))
    status, out, _ = jscomb(
        "combine", GLASS, "--biased", biased, "--out", tmp_path / "out.exr"
    )
    assert status == 0
    assert "fast of flat.exr" in out
    assert "fast: multi-scale with flat.exr; best: no estimate has halves" in out
    named = jscomb("combine", GLASS, "--biased", "oidn", "-o", tmp_path / "named.exr")
    assert named[0] == 0


def test_combine_denoises_what_is_not(jscomb, tmp_path, glass_frame):
    """A pbrt-style file without a denoised image, as an artist would have it."""
    f = glass_frame
    channels = {
        **layer("", np.asarray(f.color)),
        **layer("Albedo", np.asarray(f.albedo)),
        **layer("Ns", np.asarray(f.normal), "XYZ"),
        **layer("Variance", 64 * np.asarray(f.variance)),
    }
    frame = write(tmp_path / "pbrt.exr", channels, samplesPerPixel=64)
    status, out, _ = jscomb("combine", frame, "-o", tmp_path / "out.exr")
    assert status == 0
    assert "fast of oidn" in out
    r, noise = f.reference
    status, out, _ = jscomb("compare", tmp_path / "out.exr", GLASS)
    expected = float(
        metrics.rel_l2(exr.read_image(tmp_path / "out.exr"), r, half_difference=noise)
    )
    found = float(re.search(r"less the reference's noise +([\d.e-]+)", out)[1])
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert found < float(metrics.rel_l2(f.color, r)) / 5


def test_compare(jscomb, tmp_path):
    image = noise(0, 20, 20, 3)
    image[3, 4] = np.nan
    a = write(tmp_path / "a.exr", layer("", image))
    b = write(tmp_path / "b.exr", layer("", np.nan_to_num(image, nan=1.0)))
    status, out, _ = jscomb("compare", a, b)
    assert status == 0
    assert "1 of 400 pixels are not finite and were excluded" in out
    assert re.search(r"relative L2 +0$", out, re.M)
    assert "FLIP of a, HDR-FLIP of a skipped: image must have pixels and be" in out
    status, out, _ = jscomb("compare", b, b)
    assert re.search(r"HDR-FLIP +0$", out, re.M)
    assert re.search(r"PSNR in dB +inf$", out, re.M)


def test_compare_several_by_name(jscomb, tmp_path, glass_frame):
    """In a table, as JSON, and as pictures, over the pixels that all have."""
    r, y = glass_frame.reference.image, glass_frame.estimates["oidn"].image
    exr.write_image(tmp_path / "y.exr", y)
    exr.write_image(tmp_path / "x.exr", y.at[:3].set(np.nan))
    command = ("compare", tmp_path / "y.exr", tmp_path / "x.exr", "--reference", GLASS)
    chosen = ("--metrics", "psnr", "relative-l2", "flip")
    status, out, _ = jscomb(*command, *chosen)
    assert status == 0
    head, psnr, error, flip, *rest = out.splitlines()
    assert head.split() == ["y", "x"]
    assert psnr.startswith("PSNR in dB".rjust(40))
    assert flip.split()[-1] == "-"
    assert rest[0].startswith("FLIP of x skipped: image must")
    assert "192 of 4096 pixels are not finite" in rest[1]
    mask = finite(y.at[:3].set(np.nan))
    expected = float(metrics.rel_l2(y, r, mask=mask))
    np.testing.assert_allclose([float(v) for v in error.split()[2:]], expected, 1e-5)
    folder = tmp_path / "maps"
    status, out, _ = jscomb(*command, *chosen, "--json", "--maps", folder)
    said = json.loads(out)
    np.testing.assert_allclose(said["images"]["x"]["relative-l2"], expected, 1e-5)
    assert list(said["images"]["x"]) == ["psnr", "relative-l2"]
    assert (said["pixels"], said["excluded"]) == (4096, 192)
    names = {"y-relative-l2.png", "y-flip.png", "x-relative-l2.png"}
    assert {path.name for path in folder.iterdir()} == names
    status, out, _ = jscomb("compare", GLASS, GLASS, "--json", "--metrics", "psnr")
    value = json.loads(out)["images"]["cornell-glass-64"]["psnr"]
    np.testing.assert_allclose(value, metrics.psnr(glass_frame.color, r), rtol=1e-5)
    for arguments, message in (
        ([*command, "--metrics", "mse"], "--metrics mse: expected some of relative-l2"),
        (["compare", GLASS], "two files"),
    ):
        status, _, error = jscomb(*arguments)
        assert status == 2
        assert message in error


def test_what_is_missing_is_said_once(jscomb, tmp_path, monkeypatch):
    """For all images and all that needs it."""
    there = importlib.util.find_spec
    gone = lambda name: None if name == "flip_evaluator" else there(name)
    monkeypatch.setattr(importlib.util, "find_spec", gone)
    for name in ("one/a", "two/a", "two/reference"):
        path = write_in(tmp_path / f"{name}.exr", layer("", noise(0, 9, 9, 3)))
    files = [*sorted(tmp_path.glob("*/*.exr")), path]
    status, out, _ = jscomb(
        "compare", *files, "--maps", tmp_path / "m", "--metrics", "flip"
    )
    assert status == 0
    assert out.count('pip install "jscomb[flip]"') == 1
    assert len(list((tmp_path / "m").glob("*one-a-relative-l2.png"))) == 1
    assert len(list((tmp_path / "m").iterdir())) == 3
    page = tmp_path / "p.html"
    status, out, _ = jscomb("view", *files, "--reference", path, "-o", page)
    assert out.count('pip install "jscomb[flip]"') == 1
    assert "two/reference.exr" in page.read_text()


def write_in(path, channels):
    """Write a file, and the folder for it."""
    path.parent.mkdir(exist_ok=True)
    return write(path, channels)


def test_view(jscomb, tmp_path, glass_frame, monkeypatch):
    """The page holds a frame's images; another may be the reference."""
    page = tmp_path / "pages" / "p.html"
    status, out, _ = jscomb("view", GLASS, "-o", page)
    assert status == 0
    assert f"wrote {page}" in out
    held = lambda: json.loads(
        re.search(r"data-scenes>(.*?)</script>", page.read_text())[1]
    )
    (scene,) = held()["scenes"]
    names = ["cornell-glass-64", "oidn", "reference"]
    assert [image["name"] for image in scene["images"]] == names
    assert list(scene["images"][1]["maps"]) == ["flip"]
    error = metrics.rel_l2(
        glass_frame.estimates["oidn"].image,
        glass_frame.reference.image,
        half_difference=glass_frame.reference.half_difference,
    )
    assert scene["images"][1]["note"] == f"relative L2 {float(error):.3g}"
    exr.write_image(tmp_path / "y.exr", glass_frame.estimates["oidn"].image)
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    few = ("--maps", "hdr-flip", "--open", "-o", page)
    files = (tmp_path / "y.exr", GLASS, "--reference", tmp_path / "y.exr")
    assert jscomb("view", *files, *few)[0] == 0
    (scene,) = held()["scenes"]
    names = ["y", "cornell-glass-64", "cornell-glass-64 oidn", "reference"]
    assert [image["name"] for image in scene["images"]] == names
    assert scene["images"][2]["note"] == "relative L2 0"
    assert opened == [page.resolve().as_uri()]
    small = write(tmp_path / "small.exr", layer("", noise(0, 9, 9, 3)))
    for arguments, message in (
        (
            [GLASS, small],
            r"small\.exr is \(9, 9, 3\), .*glass-64\.exr \(64, 64, 3\)",
        ),
        ([small, "--reference", GLASS], r"small\.exr is \(9, 9, 3\)"),
        ([GLASS, "--maps", "ssim"], "--maps ssim: expected some of flip, hdr-flip"),
        ([GLASS, "--tev", "here:there"], "--tev here:there: expected HOST"),
        ([], "view needs an image"),
    ):
        status, _, error = jscomb("view", *arguments, "-o", tmp_path / "no.html")
        assert status == 2
        assert re.search(message, error)
    assert not (tmp_path / "no.html").exists()


def test_info(jscomb, tmp_path):
    status, out, _ = jscomb("info", GLASS)
    assert status == 0
    for expected in (
        "jscomb",
        "64x64",
        "64 samples a pixel in 4 sub-buffers\n",
        "invalid pixels  0",
        "albedo",
        "biased oidn",
        "scene = cornell-glass",
    ):
        assert expected in out
    bad = noise(0, 4, 4, 3)
    bad[1, 2] = np.inf
    status, out, _ = jscomb("info", write(tmp_path / "b.exr", layer("", bad)))
    assert "invalid pixels  1" in out
    assert "samples         unknown" in out


def test_info_of_moments_without_their_number(jscomb, tmp_path):
    """The file is described all the same, and says what it lacks."""
    path = moments(tmp_path)
    status, out, _ = jscomb("info", path)
    assert status == 0
    assert re.search(r"no variance .*moments\.exr: .*give the samples a pixel", out)
    status, out, _ = jscomb("info", path, "--samples", "9")
    assert "no variance" not in out
    assert re.search(r"^ {2}variance ", out, re.M)


def test_errors_are_over_the_same_pixels(jscomb, tmp_path, glass_frame):
    """Else a method would look good for the pixels that it lacks."""
    color = glass_frame.buffers.color.at[:, 10:15, 10:15].set(np.nan)
    buffers = glass_frame.buffers._replace(color=color)
    exr.write_frame(tmp_path / "f.exr", glass_frame._replace(buffers=buffers))
    status, out, _ = jscomb(
        "combine", tmp_path / "f.exr", "-o", tmp_path / "o.exr", "--method", "whitened"
    )
    assert status == 0
    assert "25 of 4096 pixels are not finite and were excluded" in out
    r, noise = glass_frame.reference
    mask = finite(color[0])
    y = glass_frame.estimates["oidn"].image
    error = metrics.rel_l2(y, r, half_difference=noise, mask=mask)
    np.testing.assert_allclose(errors_in(out)["oidn"], float(error), atol=6e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["combine", "f.exr"], "-o PATH"),
        (
            ["combine", "f.exr", "-o", "o.exr", "--method", "median"],
            "--method median: exp",
        ),
        (["demo", "--nope"], "--nope"),
        (["frobnicate"], "frobnicate"),
        ([], "demo, render, combine, compare, view, info"),
    ],
)
def test_a_wrong_command_line_is_one_line_too(jscomb, arguments, message):
    status, out, error = jscomb(*arguments)
    assert (status, out) == (2, "")
    assert re.fullmatch(r"jscomb: [ -~]+\n", error)
    assert message in error


def test_a_wrong_option_is_said_once(jscomb):
    _, _, error = jscomb("demo", "--nope")
    assert error.count("--nope") == 1
    assert error.lower().count("unrecognized options") == 1


def test_version(jscomb):
    status, out, _ = jscomb("--version")
    assert (status, out) == (
        0,
        f"jscomb {package.__version__}, JAX {jax.__version__}\n",
    )
    assert "--version" in jscomb("--help")[1]


def test_help_reads_well(jscomb):
    for command in (
        (),
        ("demo",),
        ("render",),
        ("combine",),
        ("compare",),
        ("view",),
        ("info",),
    ):
        status, out, _ = jscomb(*command, "--help")
        assert status == 0
        assert "usage: jscomb" in out
        assert "{None}" not in out
    shown = " ".join(jscomb("combine", "--help")[1].split())
    for name, method in METHODS.items():
        assert f"{name} ({method.summary})" in shown


def truncated(folder):
    path = folder / "cut.exr"
    path.write_bytes(GLASS.read_bytes()[:300_000])
    return path


def without_statistics(folder):
    return write(folder / "plain.exr", layer("", noise(0, 9, 9, 3)))


def moments(folder):
    image = noise(0, 9, 9, 4)
    channels = layer("n.img", image, "RGBA") | layer("m2_n.img", image, "RGBA")
    return write(folder / "moments.exr", channels, generatedBy="Mitsuba")


def several(folder):
    frame = exr.read_frame(GLASS)
    exr.write_frame(folder / "two.exr", frame.with_estimate("other", frame.color))
    return folder / "two.exr"


BAD = {
    "truncated": (truncated, [], r"cut\.exr: truncated or corrupt"),
    "missing": (lambda d: d / "no.exr", [], r"no\.exr: no such file"),
    "directory": (lambda d: d, [], "has neither color.exr nor colorA.exr"),
    "no variance": (
        without_statistics,
        ["--method", "whitened"],
        r"plain\.exr: whitened needs the variance: render with variances, or",
    ),
    "no samples": (moments, [], r"moments\.exr: .*give the samples a pixel"),
    "several": (
        several,
        ["--method", "whitened"],
        r"two\.exr: which biased image\? this frame has oidn, other",
    ),
    "count": (lambda d: GLASS, ["--samples", "-5"], "samples must be at least 1"),
    "biased": (
        lambda d: GLASS,
        ["--biased", "nlm"],
        "neither a file, nor a denoiser, nor a biased",
    ),
    "itself": (lambda d: GLASS, ["--biased", os.fspath(DATA)], "is the frame itself"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_status_2(jscomb, tmp_path, case):
    make, arguments, message = BAD[case]
    folder = tmp_path / "in"
    folder.mkdir()
    frame = make(folder)
    if case in ("no variance", "no samples"):
        biased = write(folder / "biased.exr", layer("", noise(1, 9, 9, 3)))
        arguments = [*arguments, "--biased", biased]
    status, out, error = jscomb("combine", frame, "-o", tmp_path / "x.exr", *arguments)
    assert status == 2
    assert out == ""
    assert error.count("\n") == 1
    assert error.startswith("jscomb: ")
    assert re.search(message, error)
    assert not (tmp_path / "x.exr").exists()


def test_sizes_must_agree(jscomb, tmp_path):
    small = write(tmp_path / "small.exr", layer("", noise(0, 9, 9, 3)))
    for arguments in (
        ("combine", GLASS, "--biased", small, "-o", tmp_path / "x.exr"),
        ("compare", small, GLASS),
    ):
        status, _, error = jscomb(*arguments)
        assert status == 2
        assert re.search(r"small\.exr is \(9, 9, 3\)", error)


def test_a_reader_that_stops_early_is_no_error():
    command = f"{sys.executable} -m jscomb info {GLASS} | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.stdout == f"{GLASS}: jscomb\n"
    assert done.stderr == ""


def test_programs_that_are_kept_are_no_error(tmp_path):
    """Twice, from a process that has imported JAX, which sets what is logged."""
    words = [sys.executable, "-m", "jscomb", "info", GLASS]
    kept = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "TF_CPP_MIN_LOG_LEVEL": "1"}
    for _ in range(2):
        done = subprocess.run(
            words, capture_output=True, text=True, check=True, env=os.environ | kept
        )
        assert done.stderr == ""
    assert [*tmp_path.iterdir()]


def test_from_the_shell(tmp_path):
    """As a process: exit status, streams, no traceback."""
    done = subprocess.run(
        [sys.executable, "-m", "jscomb", "info", truncated(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"jscomb: .*cut\.exr: truncated.*\n", done.stderr)
