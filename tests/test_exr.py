"""EXR: bit-exact round trips, and damaged or hostile files."""

import json
import os

import jax
import numpy as np
import OpenEXR
import pytest

from jscomb import exr
from jscomb.exr import _files, native
from jscomb.exr._files import Part, read_parts, write_parts
from jscomb.frame import Estimate, Reference, make_frame

H, W = 12, 10


def noise(seed, *shape):
    return np.random.default_rng(seed).random(shape, np.float32)


def layer(name, image, suffixes="RGB"):
    """Channels of an image under a prefix."""
    prefix = f"{name}." if name else ""
    return {prefix + s: image[..., c] for c, s in enumerate(suffixes)}


def write(path, channels, **attributes):
    """Write a single-part file as any renderer might."""
    write_parts(os.fspath(path), [Part("", channels, attributes)])
    return path


@pytest.fixture
def frame():
    """Two sub-buffers with every kind of buffer, float32 of any bits."""
    color = noise(0, 2, H, W, 3)
    color[0, 0, 0] = np.nan
    color[0, 0, 1] = np.inf, 1e-30, 1e30
    return make_frame(
        color,
        variance=noise(1, 2, H, W, 3),
        albedo=noise(2, 2, H, W, 3),
        normal=noise(3, H, W, 3),
        depth=noise(4, 2, H, W, 1),
        samples=6,
        estimates={
            "oidn": Estimate(*map(jax.numpy.asarray, (color[0], color))),
            "smooth": color[1],
        },
        reference=Reference(*map(jax.numpy.asarray, noise(5, 2, H, W, 3))),
    )


def assert_same(a, b):
    """Compare bit by bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(
            np.asarray(one).view(np.uint32), np.asarray(other).view(np.uint32)
        )


def test_round_trip_is_exact(frame, tmp_path):
    path = tmp_path / "größe 木.exr"
    provenance = {"seed": 2**40, "list": [1, None, True], "name": "木"}
    exr.write_frame(path, frame, provenance=provenance)
    assert_same(exr.read_frame(path), frame)
    assert exr.read_provenance(path) == provenance
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    exr.write_frame(path, exr.read_frame(path), provenance=exr.read_provenance(path))
    assert_same(exr.read_frame(path), frame)


def test_round_trip_of_little(tmp_path):
    path = tmp_path / "plain.exr"
    plain = make_frame(noise(0, 1, 1, 3))
    exr.write_frame(path, plain)
    assert_same(exr.read_frame(path), plain)
    assert exr.read_provenance(path) == {}


def test_sixteen_bits_on_request(frame, tmp_path):
    path = tmp_path / "half.exr"
    exr.write_frame(path, frame, half=("albedo", "half_difference"))
    back = exr.read_frame(path)
    np.testing.assert_allclose(back.albedo, frame.albedo, rtol=1e-3)
    assert not np.array_equal(back.albedo, frame.albedo)
    np.testing.assert_array_equal(back.color, frame.color)
    with pytest.raises(ValueError, match="values of color do not fit"):
        exr.write_frame(path, frame, half=("color",))
    with pytest.raises(ValueError, match=r"half has unknown names \['colour'\]"):
        exr.write_frame(path, frame, half=("colour",))


@pytest.mark.parametrize("name", ["a", "reference", "x.y", ""])
def test_reserved_names(frame, tmp_path, name):
    with pytest.raises(ValueError, match="cannot be called"):
        exr.write_frame(tmp_path / "x.exr", frame.with_estimate(name, frame.color))
    assert not list(tmp_path.iterdir())


def test_arrays_that_are_not_contiguous(tmp_path):
    """The binding alone would write wrong pixels without an error."""
    image = noise(0, W, H, 4).transpose(1, 0, 2)[::-1, :, :3]
    assert not image.flags.c_contiguous
    exr.write_image(tmp_path / "i.exr", image)
    np.testing.assert_array_equal(exr.read_image(tmp_path / "i.exr"), image)
    with pytest.raises(ValueError, match=r"image must have shape \[H,W,3\]"):
        exr.write_image(tmp_path / "i.exr", image[..., :1])


def test_names_of_channels_and_attributes_have_checksums(frame, tmp_path):
    """A flipped bit there would lose a buffer, or change the sample count."""
    path = tmp_path / "f.exr"
    exr.write_frame(path, frame, provenance={"scene": "box"})
    data = path.read_bytes()
    for old, new in (
        (b"normal.Z", b"normal.Y"),
        (b"albedo.R", b"albedo.Q"),
        (b'"samples": 6', b'"samples": 7'),
        (b'"scene"', b'"scenf"'),
        (b"jscomb\0", b"jscomc\0"),
    ):
        assert old in data
        path.write_bytes(data.replace(old, new, 1))
        with pytest.raises(ValueError, match=r"f\.exr: "):
            exr.read_frame(path)


@pytest.mark.parametrize("name", exr.bundled())
def test_bundled_files_are_written_again(name):
    """With the same parts, pixels and provenance."""
    path = exr.bundled()[name]
    before = read_parts(os.fspath(path))
    after = native.to_parts(exr.read_frame(path), exr.read_provenance(path), HALF)
    assert [part.name for part in after] == [part.name for part in before]
    for old, new in zip(before, after, strict=True):
        assert old.channels.keys() == new.channels.keys()
        for channel, pixels in old.channels.items():
            assert pixels.dtype == new.channels[channel].dtype
            assert pixels.tobytes() == new.channels[channel].tobytes()
    provenance = native.PROVENANCE
    assert after[0].attributes[provenance] == before[0].attributes[provenance]


@pytest.mark.parametrize(
    ("half", "checksum"),
    [((), 1376683411), (("albedo", "estimates", "half_difference"), 163607115)],
)
def test_the_format_is_stable(half, checksum):
    """One checksum covers the names of parts and channels, pixels and attributes."""
    halves = jax.numpy.arange(24, dtype=np.float32).reshape(2, 2, 2, 3) / 7
    full, shared = halves[0] + 1, halves[1] - 1
    frame = make_frame(
        halves,
        variance=halves,
        albedo=halves,
        normal=shared,
        depth=halves[..., :1],
        visibility=shared[..., :1],
        samples=6,
        estimates={"oidn": Estimate(full, halves), "nfor": full},
        reference=Reference(full, shared),
    )
    first, *_ = native.to_parts(frame, {"seed": 1}, half)
    about = json.loads(first.attributes[native.ATTRIBUTE])
    assert about["header crc32"] == checksum


def test_version_1_is_read(frame, tmp_path):
    plain = frame._replace(estimates={}, reference=None)
    exr.write_frame(tmp_path / "f.exr", plain)
    parts = read_parts(os.fspath(tmp_path / "f.exr"))
    path = native_file(tmp_path / "old.exr", parts, samples=6)
    assert_same(exr.read_frame(path), plain)
    parts[0].channels["R"][0, 0] += 1
    with pytest.raises(ValueError, match="part a is corrupt"):
        exr.read_frame(native_file(path, parts, crc32={"a": 0, "b": 0}))


def test_parts_may_be_in_any_order(frame, tmp_path):
    path = tmp_path / "f.exr"
    exr.write_frame(path, frame, provenance={"seed": 1})
    keep = lambda part: {k: v for k, v in part.attributes.items() if k in OURS}
    parts = [p._replace(attributes=keep(p)) for p in read_parts(os.fspath(path))]
    write_parts(os.fspath(path), parts[::-1])
    assert_same(exr.read_frame(path), frame)
    assert exr.read_provenance(path) == {"seed": 1}


OURS = (native.ATTRIBUTE, native.PROVENANCE)
# What the bundled files store in 16 bits.
HALF = ("albedo", "normal", "depth", "visibility", "estimate_halves", "half_difference")


def test_samples_override(frame, tmp_path):
    exr.write_frame(tmp_path / "f.exr", frame)
    assert exr.read_frame(tmp_path / "f.exr", samples=9).samples == 9


# Damaged and hostile files


@pytest.fixture
def good(frame, tmp_path):
    path = tmp_path / "good.exr"
    exr.write_frame(path, frame)
    return path


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.3, 0.7, 0.999])
def test_truncated_files_are_refused(good, tmp_path, share, capfd):
    cut = tmp_path / "cut.exr"
    data = good.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=r"cut\.exr: ") as error:
        exr.read_frame(cut)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_bit_flips_are_detected(good, tmp_path):
    """Noise is stored uncompressed, so ZIP's own checksum would miss most of these."""
    data, bad = good.read_bytes(), tmp_path / "bad.exr"
    original = exr.read_frame(good)
    refused = 0
    for place in np.linspace(len(data) // 3, len(data) - 9, 25).astype(int):
        flipped = bytearray(data)
        flipped[place] ^= 0x10
        bad.write_bytes(flipped)
        try:
            assert_same(exr.read_frame(bad), original)
        except ValueError:
            refused += 1
    assert refused >= 20


def test_text_and_nothing(tmp_path):
    text = tmp_path / "text.exr"
    text.write_text("not an image\n" * 50)
    with pytest.raises(ValueError, match=r"text\.exr: .* has other content"):
        exr.read_frame(text)
    text.write_bytes(b"")
    with pytest.raises(ValueError, match=r"text\.exr: .*is empty"):
        exr.read_frame(text)
    with pytest.raises(FileNotFoundError, match=r"none\.exr: no such file"):
        exr.read_frame(tmp_path / "none.exr")
    with pytest.raises(ValueError, match="unknown dialect 'maya'"):
        exr.read_frame(text, dialect="maya")


def test_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.exr")
    with pytest.raises(ValueError, match=r"pipe\.exr: is not a file"):
        exr.read_frame(tmp_path / "pipe.exr")


def test_missing_channels_are_named(tmp_path):
    path = write(tmp_path / "f.exr", {"R": noise(0, H, W), "Z": noise(1, H, W)})
    with pytest.raises(ValueError, match=r"f\.exr: no colour channels .* among R, Z"):
        exr.read_frame(path)
    with pytest.raises(ValueError, match=r"f\.exr: .*no colour channels R, G, B"):
        exr.read_frame(path, dialect="pbrt")


def parts_of(path):
    return {part.name: part for part in read_parts(os.fspath(path))}


def native_file(path, parts, **about):
    """Write a file of our own with these parts; `about` overrides its attribute."""
    crc = {part.name: native.checksum(part.channels, names=False) for part in parts}
    about = {"version": 1, "sub_buffers": 2, "crc32": crc} | about
    first, *others = (Part(part.name, part.channels, {}) for part in parts)
    first = first._replace(attributes={"jscomb": json.dumps(about)})
    write_parts(os.fspath(path), [first, *others])
    return path


def test_native_file_with_something_missing(good, tmp_path):
    path = tmp_path / "broken.exr"
    parts = parts_of(good)
    half = parts["b"]._replace(channels={"R": parts["b"].channels["R"]})
    native_file(path, [parts["a"], half])
    with pytest.raises(ValueError, match=r"broken\.exr: .*part b lacks channels R, G"):
        exr.read_frame(path)
    crc = {"a": 0, "b": 0}
    for about, message in (
        ({"crc32": crc}, "expected the parts a, b, found a$"),
        ({"version": 99}, "unknown format version 99"),
        ({"crc32": []}, "expected the parts"),
        ({"crc32": 5}, "attribute jscomb is malformed"),
        ({"sub_buffers": None, "crc32": {"a": 1}}, "part a is corrupt"),
    ):
        native_file(path, [parts["a"]], **about)
        with pytest.raises(ValueError, match=rf"broken\.exr: .*{message}"):
            exr.read_frame(path)


def test_attributes_of_other_programs(tmp_path):
    channels = layer("", noise(0, H, W, 3)) | layer("Albedo", noise(1, H, W, 3))
    path = write(tmp_path / "p.exr", channels, provenance="Rendered by hand")
    assert exr.read_provenance(path) == {"provenance": "Rendered by hand"}
    write(path, channels, samplesPerPixel="64")
    with pytest.raises(ValueError, match=r"p\.exr: .*samplesPerPixel is '64', not a"):
        exr.read_frame(path)
    write(path, channels, samplesPerPixel=0)
    with pytest.raises(ValueError, match=r"p\.exr: .*samples must be positive, got 0"):
        exr.read_frame(path)
    with pytest.raises(ValueError, match=r"p\.exr: samples must be at least 1, got -5"):
        exr.read_frame(path, samples=-5)


def test_flipped_headers_are_refused_in_one_way(good, tmp_path):
    data, bad = good.read_bytes(), tmp_path / "bad.exr"
    for place in range(8, 900, 7):
        flipped = bytearray(data)
        flipped[place] ^= 0x24
        bad.write_bytes(flipped)
        message = os.fspath(bad)  # if the flip is harmless
        try:
            exr.read_frame(bad)
        except ValueError as error:
            message = str(error)
        assert os.fspath(bad) in message


def test_sizes_that_differ(tmp_path):
    write(tmp_path / "colorA.exr", layer("", noise(0, H, W, 3)))
    write(tmp_path / "colorB.exr", layer("", noise(0, H, W, 3)))
    write(tmp_path / "depth.exr", {"Y": noise(0, H, W + 1)})
    with pytest.raises(ValueError, match=r"depth has shape \(1, 12, 11, 1\)"):
        exr.read_frame(tmp_path)
    write(tmp_path / "colorB.exr", layer("", noise(0, H, W - 1, 3)))
    with pytest.raises(ValueError, match=r"colorA is \(12, 10\), colorB is \(12, 9\)"):
        exr.read_frame(tmp_path)


@pytest.mark.parametrize("read", [exr.read_frame, exr.read_image])
def test_claims_are_checked_before_pixels_are_read(tmp_path, read):
    path = write(tmp_path / "f.exr", layer("", noise(0, 512, 1024, 3)))
    read(path, max_bytes=6 * 2**20)
    message = r"f\.exr: claims 6\.0 MiB of pixels, max_bytes allows 5\.0 MiB"
    with pytest.raises(ValueError, match=message):
        read(path, max_bytes=5 * 2**20)


def test_claimed_tiles_are_checked(tmp_path):
    path = os.fspath(tmp_path / "tiles.exr")
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 16384, 16384
    header = {"type": OpenEXR.tiledimage, "tiles": tiles}
    OpenEXR.File(header, {"Y": noise(0, H, W)}).write(path)
    assert os.path.getsize(path) < 100_000
    with pytest.raises(ValueError, match=r"tiles\.exr: claims tiles of 1024.0 MiB"):
        exr.read_frame(path)


def test_a_failed_write_loses_nothing(good, frame, tmp_path, monkeypatch):
    before = good.read_bytes()

    def fail(*_):
        raise RuntimeError("No space left on device.")

    monkeypatch.setattr(_files.OpenEXR.File, "write", fail)
    with pytest.raises(OSError, match=r"good\.exr: cannot be written: No space left"):
        exr.write_frame(good, frame)
    assert good.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["good.exr"]


def test_places_that_cannot_be_written(frame, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"x\.exr: the folder .*none does not exist"
    ):
        exr.write_frame(tmp_path / "none" / "x.exr", frame)
    with pytest.raises(IsADirectoryError, match="is a folder"):
        exr.write_frame(tmp_path, frame)
    with pytest.raises(OSError, match=r"^/proc/x\.exr: cannot be written: "):
        exr.write_frame("/proc/x.exr", frame)
