"""`jscomb combine` among other programs: what it refuses, keeps, matches and says."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from jscomb import exr
from jscomb.cli import _matching, _outputs
from tests.exr_corpus.public_images import corners
from tests.test_exr import layer, noise, write
from tests.test_exr_layouts import assert_kept, whole, write_parts

H, W, SPP = 24, 20, 16
Y, X = np.mgrid[0:H, 0:W].astype(np.float32)
TRUTH = np.stack([0.2 + X / W, 0.3 + Y / H, 0.5 + 0 * X], axis=-1)
SEEDS = [np.random.default_rng(seed).gamma(4, 1 / 4, TRUTH.shape) for seed in (0, 1)]
NOISY, OTHER = (np.float32(TRUTH * gain) for gain in SEEDS)
SMOOTH = np.float32(1.02 * TRUTH)
VARIANCE = np.float32(TRUTH**2 / 4 * SPP)  # of one sample


def pbrt(color=NOISY):
    """Channels of a frame with a variance."""
    up = np.broadcast_to(np.float32([0, 0, 1]), TRUTH.shape)
    features = layer("Albedo", np.float32(TRUTH.clip(0, 1))) | layer("Ns", up, "XYZ")
    return layer("", color) | features | layer("Variance", VARIANCE)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a frame and its denoised image, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "f.exr", pbrt(), samplesPerPixel=SPP)
    write(tmp_path / "d.exr", layer("", SMOOTH))
    return tmp_path


@pytest.fixture
def combine(jscomb, here):
    """Run `jscomb combine` by a method that compiles nothing."""

    def run(*arguments, method="denoised"):
        return jscomb("combine", *arguments, "--method", method)

    return run


def red(path):
    """The red channel of an image."""
    return np.asarray(exr.read_image(path))[..., 0]


BIASED = ("--biased", "d.exr")


# Never destroy


@pytest.mark.parametrize("out", ["f.exr", "d.exr", "link.exr", "hard.exr", ".", "./"])
def test_an_input_is_never_replaced(out, combine, here):
    (here / "link.exr").symlink_to("f.exr")
    os.link("f.exr", "hard.exr")
    before = {each: each.read_bytes() for each in here.iterdir()}
    status, _, error = combine("f.exr", *BIASED, "-o", out, "--force")
    assert status == 2
    assert "is never replaced" in error
    assert {each: each.read_bytes() for each in here.iterdir()} == before


def test_an_input_of_another_frame_is_never_replaced(combine, here):
    """Not even a file that the other frame takes from beside it."""
    (here / "in").mkdir()
    write(here / "in" / "a.exr", layer("", NOISY))
    status, _, error = combine("in/a.exr", "f.exr", "-o", "./in", "--force")
    assert (status, "is the input in/a.exr" in error) == (2, True)
    write(here / "s_000064spp.exr", pbrt() | layer("Normal", TRUTH, "XYZ"))
    write(here / "s_000064spp.den.exr", layer("", SMOOTH))
    command = ("s_000064spp.exr", "-o", "s_000064spp.den.exr", "--force")
    status, _, error = combine(*command)
    assert (status, "is never replaced" in error) == (2, True)


def test_what_exists_is_replaced_only_if_it_is_an_older_result(combine, here):
    assert combine("f.exr", *BIASED, "-o", "o.exr")[0] == 0
    assert "there already" in combine("f.exr", *BIASED, "-o", "o.exr")[1]
    write(here / "d.exr", layer("", 2 * SMOOTH))
    assert "wrote o.exr" in combine("f.exr", *BIASED, "-o", "o.exr")[1]
    np.testing.assert_array_equal(red("o.exr"), 2 * SMOOTH[..., 0])
    (here / "x").mkdir()
    write(here / "x" / "f.exr", pbrt(OTHER), samplesPerPixel=SPP)
    status, _, error = combine("x/f.exr", *BIASED, "-o", "o.exr")
    assert (status, "made it of f.exr: --force" in error) == (2, True)
    ((_, attributes, channels),) = whole("o.exr")  # as another program would edit it
    edited = {n: np.ascontiguousarray(c + 1) for n, c in channels.items()}
    write("o.exr", edited, **{k: v for k, v in attributes.items() if k != "channels"})
    before = (here / "o.exr").read_bytes()
    status, _, error = combine("f.exr", *BIASED, "-o", "o.exr")
    assert (status, "did not make it, or it was changed" in error) == (2, True)
    assert (here / "o.exr").read_bytes() == before
    assert combine("f.exr", *BIASED, "-o", "o.exr", "--force")[0] == 0


def test_a_result_is_no_frame(combine):
    assert combine("f.exr", *BIASED, "-o", "o.exr")[0] == 0
    status, _, error = combine("o.exr", *BIASED, "-o", "p.exr")
    assert (status, "is a result of jscomb combine" in error) == (2, True)
    assert combine("f.exr", "--biased", "o.exr", "-o", "p.exr")[0] == 0


def test_a_noisy_image_in_place_of_a_denoised_one_is_told(combine, here):
    write(here / "n.exr", layer("", NOISY))
    status, said, _ = combine("f.exr", "--biased", "n.exr", "-o", "o.exr")
    assert (status, "n.exr: is the same image as the noisy one" in said) == (0, True)


def test_links_stay_links(combine, here):
    (here / "o.exr").symlink_to("store.exr")
    for _ in range(2):
        assert combine("f.exr", *BIASED, "-o", "o.exr")[0] == 0
        assert (here / "o.exr").is_symlink()
    np.testing.assert_array_equal(red("store.exr"), SMOOTH[..., 0])


WRONG = {
    "no frame": ([], "o.exr", "no frame is given"),
    "no suffix": (["f.exr"], "o", r"ends in \.exr, or a folder: o/"),
    "another suffix": (["f.exr"], "o.png", r"ends in \.exr"),
    "no folder": (["f.exr"], "no/o.exr", "no does not exist"),
    "a file for two": (["f.exr", "d.exr"], "o.exr", "2 frames need a folder"),
    "one image for two": (["f.exr", "g.exr", *BIASED], "o/", "one image for 2 frames"),
    "negative": (["f.exr", "--budget", "-1"], "o.exr", "at least 0"),
    "no number": (["f.exr", "--budget", "nan"], "o.exr", "at least 0"),
    "memory": (["f.exr", "--memory", "-1"], "o.exr", "expected at least 1"),
    "little memory": (["f.exr", "--max-memory", "0"], "o.exr", "the budget is 0 MiB"),
    "no layer": (["f.exr", "--layer", "x"], "o.exr", r"f\.exr: .*no layer 'x'"),
    "no half": (["f.exr", "--halves", "x.exr"], "o.exr", "x.exr: no such file"),
    "no files": (["f.exr", "--biased", "x.##.exr"], "o.exr", "no such files"),
    "same half": (["f.exr", "--halves", "g.exr"], "o.exr", "with another seed"),
    "no mean": (["f.exr", "--halves", "d.exr", "h.exr"], "o.exr", "nor their mean"),
    "a noisy one": (["f.exr", "--biased", "n.exr"], "o.exr", "has only a noisy image"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_makes_no_sense_is_refused(case, combine, here):
    arguments, out, message = WRONG[case]
    (here / "g.exr").write_bytes((here / "f.exr").read_bytes())
    write(here / "h.exr", pbrt(OTHER), samplesPerPixel=SPP)
    write(here / "n.exr", layer("Noisy Image", NOISY))
    before = sorted(os.listdir())
    status, said, error = combine(*arguments, "-o", out)
    assert (status, said) == (2, "")
    assert re.fullmatch(rf"jscomb: .*{message}.*\n", error)
    assert sorted(os.listdir()) == before


@pytest.mark.parametrize(
    ("frames", "out", "expected"),
    [
        (["a/f.exr"], "o.exr", ["o.exr"]),
        (["a/f.exr"], "o/", ["o/f.exr"]),
        (["a/s.v2.0001.exr"], "o/", ["o/s.v2.0001.exr"]),
        (["a.EXR", "b.2"], "o.d", ["o.d/a.exr", "o.d/b.2.exr"]),
        (["scene.v1/"], "o/", ["o/scene.v1.exr"]),
    ],
)
def test_names_of_results(frames, out, expected, here):
    (here / "scene.v1").mkdir()
    assert _outputs.targets(frames, out) == expected


# Sequences


def test_files_of_a_sequence_belong_to_their_frames(combine, here):
    for n in (1, 2, 10):
        for folder, image in {"a": NOISY, "b": OTHER}.items():
            (here / folder).mkdir(exist_ok=True)
            write(here / folder / f"s_v2.{n:04}.exr", layer("", n * image))
        (here / "den").mkdir(exist_ok=True)
        write(here / "den" / f"s_v2.{n:04}_denoised.exr", layer("", n * SMOOTH))
    patterns = ("den", "den/s_v2.####_denoised.exr", "den/s_v2.%04d_denoised.exr")
    for number, biased in enumerate((*patterns, "den/*_denoised.exr")):
        out, halves = f"out{number}", ("a/s_v2.#.exr", "b")
        status, said, _ = combine("--halves", *halves, "--biased", biased, "-o", out)
        assert (status, said.count("wrote")) == (0, 3)
        np.testing.assert_array_equal(red(f"{out}/s_v2.0010.exr"), 10 * SMOOTH[..., 0])
    os.remove("den/s_v2.0002_denoised.exr")
    frames = sorted(f"a/{name}" for name in os.listdir("a"))
    status, said, error = combine(*frames, "--biased", "den", "-o", "last")
    assert (status, said.count("wrote")) == (2, 2)
    assert "needs one file of frame 2, has none" in error
    assert "1 of 3 frames failed: s_v2.0002.exr" in error


def test_one_file_for_two_frames_is_refused(here):
    """Frames of two shots with the same numbers, and one shot's denoised images."""
    (here / "den").mkdir()
    write(here / "den" / "x.0001.exr", layer("", SMOOTH))
    with pytest.raises(ValueError, match=r"x\.0001\.exr would be taken for both"):
        _matching.match("--biased", "den", ["a.0001.exr", "b.0001.exr"])
    for name in "ab":
        write(here / "den" / f"{name}.0001.exr", layer("", SMOOTH))
    found = _matching.match("--biased", "den", ["a.0001.exr", "b.0001.exr"])
    assert found == ["den/a.0001.exr", "den/b.0001.exr"]


def test_ten_frames(combine, here):
    """One is broken, one rendered again, one newly denoised."""
    (here / "in").mkdir()
    (here / "den").mkdir()
    names = [f"f.{n:04}.exr" for n in range(10)]
    for n, name in enumerate(names):
        write(here / "in" / name, layer("", (n + 1) * NOISY))
        write(here / "den" / name, layer("", (n + 1) * SMOOTH))
    good = (here / "in" / names[3]).read_bytes()
    (here / "in" / names[3]).write_bytes(good[:900])
    command = [*(f"in/{name}" for name in names), "--biased", "den", "-o", "out/"]
    status, said, error = combine(*command)
    assert (status, said.count("wrote")) == (2, 9)
    assert error.endswith("1 of 10 frames failed: f.0003.exr\n")
    (here / "in" / names[3]).write_bytes(good)
    write(here / "in" / names[5], layer("", OTHER))
    write(here / "den" / names[7], layer("", 3 * SMOOTH))
    status, said, error = combine(*command)
    assert (status, said.count("there already"), error) == (0, 7, "")
    wrote = re.findall(r"wrote out/(\S+):", said)
    assert wrote == [names[3], names[5], names[7]]
    np.testing.assert_array_equal(red(f"out/{names[7]}"), 3 * SMOOTH[..., 0])


def test_files_beside_and_in_directories_count(combine, here):
    """A denoised file beside the frame, and any of a directory's, made anew."""
    (here / "t").mkdir()
    for name, image in {"color": NOISY, "colorA": NOISY, "colorB": OTHER}.items():
        write(here / "t" / f"{name}.exr", layer("", image))
    pd = pbrt() | layer("Normal", TRUTH, "XYZ")
    write(here / "s_000064spp.exr", pd)
    for frame, file, gain in (
        ("t", "t/colorB.exr", OTHER),
        ("s_000064spp.exr", "s_000064spp.den.exr", SMOOTH),
    ):
        command = (frame, "-o", "out/", *(BIASED if frame == "t" else ()))
        if frame != "t":
            write(here / file, layer("", gain))
        assert "wrote" in combine(*command)[1]
        assert "there already" in combine(*command)[1]
        write(here / file, layer("", 3 * gain))
        assert "wrote" in combine(*command)[1]


# Keep what the input had


def windows(data, display):
    """The attributes of a crop, or of overscan."""
    return {"dataWindow": corners(*data), "displayWindow": corners(*display)}


@pytest.mark.parametrize("method", ["denoised", "whitened"])
@pytest.mark.parametrize(
    "at",
    [
        {},
        windows((7, 5, W + 6, H + 4), (0, 0, 99, 79)),
        windows((-9, -9, W - 10, H - 10), (0, 0, 4, 4)),
    ],
)
def test_all_else_is_kept(method, at, combine, here):
    about = {"cryptomatte/1/manifest": "{}", "owner": "me", "pixelAspectRatio": 2.0}
    channels = pbrt() | layer("crypto00", OTHER) | {"A": 1 + 0 * X, "Z": 1 + X}
    write(here / "f.exr", channels, samplesPerPixel=SPP, **about, **at)
    write(here / "d.exr", layer("", SMOOTH), **at)
    status, said, _ = combine("f.exr", *BIASED, "-o", "o.exr", method=method)
    assert (status, said) == (0, f"wrote o.exr: {W}x{H}, {method} of d.exr\n")
    assert_kept("f.exr", "o.exr", but=list("RGB"))
    assert np.isfinite(red("o.exr")).all()


def test_a_view_is_combined_within_its_file(combine, here):
    views = [("left", NOISY), ("right", OTHER)]
    parts = [(f"rgba_{v}", layer("", i), {"view": v}) for v, i in views]
    write_parts(here / "f.exr", [("Z", {"Z": X}, {"view": "left"}), *parts])
    command = ("f.exr", *BIASED, "-o", "o.exr", "--layer", "right")
    status, said, _ = combine(*command)
    assert (status, "as rgba (right)" in said) == (0, True)
    assert_kept("f.exr", "o.exr", but=list("RGB"), part=2)


def test_what_was_not_denoised_stays_as_it_is(combine, here):
    """Overscan that the denoiser has cut off."""
    display = {"displayWindow": corners(0, 0, W - 9, H - 9)}
    at = {"dataWindow": corners(-4, -4, W - 5, H - 5)}
    write(here / "f.exr", pbrt(), samplesPerPixel=SPP, **at, **display)
    write(here / "d.exr", layer("", SMOOTH[4:-4, 4:-4]))
    status, said, _ = combine("f.exr", *BIASED, "-o", "o.exr")
    assert (status, "lacks" in said) == (0, True)
    expected = NOISY.copy()
    expected[4:-4, 4:-4] = SMOOTH[4:-4, 4:-4]
    np.testing.assert_array_equal(exr.read_image("o.exr"), expected)


@pytest.mark.parametrize("method", ["whitened", "denoised", "gaussian"])
def test_no_halo_where_nothing_is(method, combine, here):
    alpha = np.float32((X - 9) ** 2 + (Y - 12) ** 2 < 40)
    cut = lambda image: image * alpha[..., None]
    channels = {**layer("", cut(NOISY)), "A": alpha, **layer("Variance", cut(VARIANCE))}
    glow = channels | layer("", cut(NOISY) + np.float32(0.1))  # light without alpha
    for name, some in {"f": channels, "g": glow}.items():
        write(here / f"{name}.exr", some, samplesPerPixel=SPP)
        biased = () if method == "gaussian" else BIASED
        assert (
            combine(f"{name}.exr", *biased, "-o", f"o{name}.exr", method=method)[0] == 0
        )
    assert np.all(red("of.exr")[alpha == 0] == 0)
    assert np.all(red("of.exr")[alpha == 1] > 0)
    assert np.all(red("og.exr")[alpha == 0] > 0)


def test_chromaticities_are_converted_or_taken_over(combine, here):
    wide = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    write(here / "f.exr", pbrt(), samplesPerPixel=SPP, chromaticities=wide)
    for name, own in {"same": wide, "none": None, "rec709": exr._color.REC_709}.items():
        about = {} if own is None else {"chromaticities": own}
        write(here / "d.exr", layer("", SMOOTH), **about)
        status, said, _ = combine("f.exr", *BIASED, "-o", f"{name}.exr")
        assert status == 0
        assert ("converted" in said) == (name == "rec709")
        assert ("states no" in said) == (name == "none")
        kept = np.array_equal(red(f"{name}.exr"), SMOOTH[..., 0])
        assert kept == (name != "rec709")


# Frames without variance


def test_halves_from_files(combine, here):
    """Two renders, in any of the ways to name them, are the same frame."""
    for name, image in {"a": NOISY, "b": OTHER, "m": (NOISY + OTHER) / 2}.items():
        write(here / f"{name}.exr", layer("", image))
    given = (["a.exr", "--halves", "b.exr"], ["--halves", "a.exr", "b.exr"])
    given += (
        ["a.exr", "--halves", "a.exr", "b.exr"],
        ["m.exr", "--halves", "a.exr", "b.exr"],
    )
    images = []
    for number, arguments in enumerate(given):
        command = (*arguments, *BIASED, "-o", f"{number}.exr")
        assert combine(*command, method="whitened")[0] == 0
        images.append(exr.read_image(f"{number}.exr"))
    assert not np.allclose(images[0], SMOOTH, rtol=1e-3)
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], rtol=1e-4)


def test_a_frame_without_noise_statistics_says_what_helps(combine, here):
    write(here / "p.exr", layer("", NOISY))
    status, said, error = combine("p.exr", *BIASED, "-o", "o.exr", method="auto")
    assert (status, error) == (0, "")
    assert "second render with another seed (--halves)" in said
    status, _, error = combine("p.exr", *BIASED, "-o", "q.exr", method="whitened")
    assert (status, "--halves" in error) == (2, True)


def test_variances_of_single_samples_without_their_number(combine, here):
    """Needed where a method takes them; two renders make up for it."""
    write(here / "p.exr", layer("beauty", NOISY) | layer("variance", VARIANCE))
    write(here / "q.exr", layer("beauty", OTHER) | layer("variance", VARIANCE))
    status, said, _ = combine("p.exr", *BIASED, "-o", "a.exr", method="auto")
    assert (status, "no variance: p.exr: it stores" in said) == (0, True)
    status, _, error = combine("p.exr", *BIASED, "-o", "b.exr", method="whitened")
    assert (status, "(--samples)" in error) == (2, True)
    halves = ("--halves", "q.exr", *BIASED)
    for number, more in enumerate(((), ("--samples", str(SPP)))):
        out = f"{number}.exr"
        assert combine("p.exr", *halves, *more, "-o", out, method="whitened")[0] == 0
    assert not np.allclose(red("0.exr"), red("1.exr"))


def test_features_and_variances_from_files(combine, here):
    write(here / "p.exr", layer("", NOISY))
    write(here / "v.exr", layer("", VARIANCE / SPP))
    write(here / "w.exr", layer("variance", VARIANCE))
    for name in ("f", "p"):
        given = {"f": (), "p": ("--variance", "v.exr")}[name]
        command = (f"{name}.exr", *given, *BIASED, "-o", f"o{name}.exr")
        assert combine(*command, method="whitened")[0] == 0
    np.testing.assert_allclose(red("op.exr"), red("of.exr"), rtol=1e-5)
    command = ("p.exr", *BIASED, "--variance", "w.exr", "--samples", str(SPP))
    assert combine(*command, "-o", "ow.exr", method="whitened")[0] == 0
    np.testing.assert_allclose(red("ow.exr"), red("of.exr"), rtol=1e-5)


def test_the_options_of_a_denoiser_are_understood(jscomb, here):
    for name in ("a", "n"):
        write(here / f"{name}.exr", layer("", noise(0, H, W, 3)))
    command = ("--hdr", "f.exr", "--alb", "a.exr", "--nrm", "n.exr", "-o", "o.exr")
    assert jscomb(*command, *BIASED, "--method", "denoised")[0] == 0
    np.testing.assert_array_equal(red("o.exr"), SMOOTH[..., 0])
    status, _, error = jscomb("f.exr", "-o", "p.exr")
    assert status == 2
    assert error == "jscomb: did you mean: jscomb combine f.exr -o p.exr\n"


def test_info_says_what_was_taken_for_what(jscomb, here):
    write(here / "x.exr", pbrt() | layer("denoised", SMOOTH) | layer("N", TRUTH, "XYZ"))
    _, said, _ = jscomb("info", "x.exr")
    for name in ("Albedo.B, Albedo.G, Albedo.R (float): albedo", "(float): denoised"):
        assert name in said
    assert "could be normal, too: N (--normal)" in said
    assert "the noisy image is R, G, B, a denoised one is denoised" in said
    assert "no variance" in said
    _, said, _ = jscomb("info", "x.exr", "--samples", "16", "--normal", "N")
    assert "N.X, N.Y, N.Z (float): normal" in said
    assert "no variance" not in said


# Ctrl-C


@pytest.mark.skipif(
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN,
    reason="a shell's background job, and what it starts, ignores Ctrl-C",
)
@pytest.mark.parametrize("seconds", [0.3, 6.0])
def test_an_interrupted_command_ends_at_once(seconds, here):
    """While it is imported, and at work; nothing is left half written."""
    large = {n: np.tile(plane, (60, 60)) for n, plane in pbrt().items()}
    write(here / "f.exr", large, samplesPerPixel=SPP)
    command = [sys.executable, "-m", "jscomb", "combine", "f.exr", "-o", "o.exr"]
    command += ["--method", "bilateral"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    time.sleep(seconds)
    before = time.perf_counter()
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (130, "jscomb: interrupted\n")
    assert time.perf_counter() - before < 5
    assert not [name for name in os.listdir() if name.startswith(".jscomb")]
