"""Files of every layout: what is taken for what, and that nothing is lost."""

import os

import numpy as np
import OpenEXR
import pytest

from jscomb import exr
from jscomb.exr import _files
from jscomb.exr._files import read_headers, read_pixels
from tests.exr_corpus import public_images
from tests.test_exr import H, W, layer, noise, write

LOSSY = ("B44", "DWA")  # of 16 bits
PUBLIC = [*public_images.images()]
X = noise(0, H, W)
COLOR, SMOOTH, ALBEDO, NORMAL = (noise(n, H, W, 3) for n in range(1, 5))
TYPE = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}


def write_parts(path, parts):
    """Write parts (name, channels, attributes) as a renderer would."""
    contiguous = lambda c: {n: np.ascontiguousarray(plane) for n, plane in c.items()}
    made = [OpenEXR.Part(TYPE | h, contiguous(c), name) for name, c, h in parts]
    OpenEXR.File(made).write(os.fspath(path))
    return path


def whole(path):
    """Names, attributes and channels of all parts."""
    file = OpenEXR.File(os.fspath(path), separate_channels=True)
    return [
        (
            part.name(),
            dict(part.header),
            {n: c.pixels for n, c in part.channels.items()},
        )
        for part in file.parts
    ]


def same(a, b):
    """Whether two planes, flat or deep, are the same bit by bit."""
    if a.dtype != object:
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    empty = np.float32([])
    pairs = zip(a.flat, b.flat, strict=True)
    none = lambda each: empty if each is None else each
    return all(np.array_equal(none(x), none(y)) for x, y in pairs)


OURS = {"jscombResult", "provenance"}


def assert_kept(before, after, *, but=(), part=0):
    """All of a file is in another one, but for some channels of a part."""
    for number, (one, other) in enumerate(
        zip(whole(before), whole(after), strict=True)
    ):
        name, attributes, channels = one
        assert other[0] == name
        changed = OURS if number == 0 else set()
        assert other[1].keys() - OURS == attributes.keys() - OURS
        assert other[1].keys() - attributes.keys() <= changed
        for key in attributes.keys() - OURS - {"channels", "tiles"}:
            assert repr(other[1][key]) == repr(attributes[key]), key
        assert other[2].keys() == channels.keys()
        for channel, pixels in channels.items():
            kept = same(pixels, other[2][channel])
            assert kept != (number == part and channel in but), (name, channel)


@pytest.mark.parametrize("public", PUBLIC, ids=lambda public: public.name)
def test_public_images(public, tmp_path):
    """Read and written again with another colour; or one line that says why not."""
    path, out = tmp_path / "image.exr", tmp_path / "out.exr"
    path.write_bytes(public_images.data_of(public))
    if isinstance(public.color, str):
        with pytest.raises(ValueError, match=public.color) as error:
            exr.read_contents(path)
        assert str(error.value).startswith(os.fspath(path))
        assert "\n" not in str(error.value)
        return
    contents = exr.read_contents(path, everything=True)
    assert contents.color.color == public.color
    assert contents.color.part == public.part
    new = np.full((*contents.size, 3), 2.0, np.float32)
    lost = exr.write_contents(out, contents, new)
    lossless = not any(word in public.name for word in ("maps", *LOSSY))
    assert (lost == []) == lossless
    if "UTF-8" not in public.name:  # such text is escaped
        assert_kept(path, out, but=public.color, part=public.part)
    np.testing.assert_allclose(exr.read_image(out), 2, rtol=1e-3)
    again = exr.read_contents(out)
    assert (again.window, again.display) == (contents.window, contents.display)


# What programs call their layers; the letters are those of the channels.
BEAUTIES = {
    **dict.fromkeys(("", "RGBA", "rgba", "beauty", "C", "Image", "ViewLayer.Combined")),
    "Ci": "rgb",
}
PROGRAMS = {
    "Arnold": ("RGBA", "denoise_albedo", "N", "Z", "variance", None),
    "Karma": ("C", "albedo", "N", "depth.Z", None, "C_denoised"),
    "RenderMan": ("Ci", "albedo", "normal", "z", "mse", None),
    "V-Ray": ("", "diffuseFilter", "normals", "zDepth.Z", None, "effectsResult"),
    "Redshift": ("", "DiffuseFilter", "BumpNormals", "Z", None, "Beauty_denoised"),
    "LuxCore": ("V.Combined", "V.ALBEDO", "V.AVG_SHADING_NORMAL", "V.DEPTH.Z", None,
                "V.DENOISED"),
    "Cycles": ("V.Noisy Image", "V.Denoising Albedo", "V.Denoising Normal",
               "V.Denoising Depth.Z", "V.Denoising Variance", "V.Combined"),
    "pbrt": ("", "Albedo", "Ns", None, "Variance", None),
    "pbrt, other name": ("", "Albedo", "N", None, "rgbVariance", None),
    "OIDN style": ("", "alb", "nrm", "depth.Z", None, "denoised"),
}  # fmt: skip


def channels_of(names):
    """The channels of a program's file."""
    color, albedo, normal, depth, variance, denoised = names
    letters = "rgb" if color == "Ci" else "RGB"
    found = layer(color, COLOR, letters) | layer(albedo, ALBEDO, letters)
    found |= layer(normal, NORMAL, "XYZ") | layer("specular", SMOOTH, "RGB")
    if depth:
        found[depth] = X
    if variance:
        found |= layer(variance, SMOOTH)
    return found | (layer(denoised, SMOOTH) if denoised else {})


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("in_parts", [False, True])
def test_layers_have_the_names_of_programs(program, in_parts, tmp_path):
    path, names = tmp_path / "f.exr", PROGRAMS[program]
    channels = channels_of(names)
    if in_parts:
        groups = {}
        for name in reversed(channels):  # the beauty is the last part
            groups.setdefault(name.rpartition(".")[0], {})[name] = channels[name]
        named = {key or "rgba": found for key, found in groups.items()}
        write_parts(path, [(key, found, {}) for key, found in named.items()])
    else:
        write(path, channels)
    contents = exr.read_contents(path, samples=16)
    *_, depth, variance, denoised = names
    frame = contents.frame
    np.testing.assert_array_equal(frame.color, COLOR)
    np.testing.assert_array_equal(frame.albedo, ALBEDO)
    np.testing.assert_array_equal(frame.normal, NORMAL)
    assert (frame.depth is not None) == (depth is not None)
    assert (frame.buffers.variance is not None) == (variance is not None)
    assert list(frame.estimates) == (["denoised"] if denoised else [])
    best = SMOOTH if denoised else COLOR
    np.testing.assert_array_equal(exr.read_image(path), best)
    listed = [name for found in contents.layers for name in found.names]
    assert sorted(listed) == sorted(channels)
    assert any("denoised" in note for note in contents.notes) == bool(denoised)


def test_units_of_variances(tmp_path):
    """Of the mean, of a sample, or a mean squared deviation; or as a user says."""
    for name, option, expected in (
        ("mse", None, SMOOTH),
        ("variance", None, SMOOTH / 16),
        ("Denoising Variance", None, SMOOTH / 15),
        ("other", "other", SMOOTH),
        ("other", "other:sample", SMOOTH / 16),
        ("variance", "variance:mean", SMOOTH),
    ):
        path = write(tmp_path / "f.exr", layer("", COLOR) | layer(name, SMOOTH))
        contents = exr.read_contents(path, samples=16, variance=option)
        np.testing.assert_allclose(contents.frame.variance, expected, rtol=1e-6)
    contents = exr.read_contents(
        write(path, layer("", COLOR) | layer("variance", X[..., None], "Y"))
    )
    assert "--samples" in contents.missing
    assert contents.frame.buffers.variance is None


@pytest.mark.parametrize("name", ["right", "fg", "fg.Combined", "right.Combined"])
def test_a_layer_is_named(name, tmp_path):
    """A view, a view layer, or the layer itself."""
    if name.startswith("right"):
        own = {"multiView": ["left", "right"]}
        channels = layer("Combined", COLOR) | layer("Combined.right", SMOOTH)
    else:
        own, channels = {}, layer("bg.Combined", COLOR) | layer("fg.Combined", SMOOTH)
    path = write(tmp_path / "f.exr", channels, **own)
    contents = exr.read_contents(path)
    np.testing.assert_array_equal(contents.image, COLOR)
    assert any("--layer" in note for note in contents.notes)
    contents = exr.read_contents(path, layer=name)
    np.testing.assert_array_equal(contents.image, SMOOTH)
    assert contents.notes == []
    with pytest.raises(ValueError, match=r"no layer 'none'; there are .*Combined"):
        exr.read_contents(path, layer="none")


def test_doubts_are_told(tmp_path):
    channels = layer("V.Combined", SMOOTH) | layer("V.Noisy Image", COLOR)
    path = write(tmp_path / "f.exr", channels)
    contents = exr.read_contents(path, layer="V.Combined")
    np.testing.assert_array_equal(contents.image, SMOOTH)
    assert contents.notes == ["V.Combined may be denoised: V.Noisy Image is beside it"]
    both = layer("", COLOR) | layer("variance", SMOOTH) | layer("mse", ALBEDO)
    contents = exr.read_contents(write(path, both))
    np.testing.assert_array_equal(contents.frame.variance, ALBEDO)  # needs no samples
    assert contents.rivals == {"variance": ["variance"]}
    with pytest.raises(ValueError, match="no colour channels"):
        exr.read_contents(write(path, layer("C", NORMAL, "XYZ")))


def test_sides_are_views_without_attributes(tmp_path):
    channels = layer("left", COLOR) | layer("right", SMOOTH)
    channels |= layer("right.albedo", ALBEDO)
    path = write(tmp_path / "f.exr", channels)
    assert exr.read_frame(path).albedo is None
    frame = exr.read_frame(path, layer="right")
    np.testing.assert_array_equal(frame.color, SMOOTH)
    np.testing.assert_array_equal(frame.albedo, ALBEDO)


def test_only_a_denoised_image_is_no_frame(tmp_path):
    path = write(tmp_path / "f.exr", layer("DENOISED", SMOOTH))
    np.testing.assert_array_equal(exr.read_image(path), SMOOTH)
    with pytest.raises(ValueError, match=r"f\.exr: has only a denoised image"):
        exr.read_frame(path)


def test_texture_coordinates_make_no_renderer(tmp_path):
    """A channel that ends in .T, and a layer with alpha, are no nested integrator."""
    channels = layer("", COLOR) | {"A": X, "uv.S": X, "uv.T": X}
    channels |= layer("specular", noise(9, H, W, 4), "RGBA")
    path = write(tmp_path / "f.exr", channels)
    np.testing.assert_array_equal(exr.read_frame(path).color, COLOR)


@pytest.mark.parametrize("pixels", ["same", "half", "float"])
def test_pixel_types(pixels, tmp_path):
    """The colour's are as asked for; all others are kept."""
    path, out = tmp_path / "f.exr", tmp_path / "o.exr"
    channels = {n: c.astype(np.float16) for n, c in layer("", COLOR).items()}
    channels |= {"id": np.full((H, W), 4_000_000_001, np.uint32), "Z": X}
    contents = exr.read_contents(write(path, channels), everything=True)
    exr.write_contents(out, contents, SMOOTH, pixels=pixels)
    ((_, _, found),) = whole(out)
    wanted = np.float32 if pixels == "float" else np.float16
    assert {n: c.dtype.type for n, c in found.items()} == {
        **dict.fromkeys("RGB", wanted),
        "id": np.uint32,
        "Z": np.float32,
    }
    assert same(found["id"], channels["id"])
    np.testing.assert_allclose(exr.read_image(out), SMOOTH, rtol=1e-3)
    lost = exr.write_contents(out, contents, 1e6 * SMOOTH, pixels=pixels)
    assert len(lost) == (pixels != "float")
    np.testing.assert_array_equal(exr.read_image(out), np.float32(1e6) * SMOOTH)


def test_colour_alone(tmp_path):
    path, out = tmp_path / "f.exr", tmp_path / "o.exr"
    channels = layer("V.Combined", COLOR) | {"V.Combined.A": X, "V.Depth.Z": X}
    write(path, channels, **{"cryptomatte/1/name": "c", "owner": "me"})
    contents = exr.read_contents(path)
    exr.write_contents(out, contents, SMOOTH, layers="color", error=X[..., None])
    ((_, attributes, found),) = whole(out)
    assert sorted(found) == ["A", "B", "G", "R"]
    assert same(found["A"], X)
    assert attributes["owner"] == "me"
    assert "cryptomatte/1/name" not in attributes


def test_the_error_is_a_layer(tmp_path):
    path, out = tmp_path / "f.exr", tmp_path / "o.exr"
    write_parts(path, [("Z", {"Z": X}, {}), ("rgba", layer("", COLOR), {})])
    contents = exr.read_contents(path, everything=True)
    exr.write_contents(out, contents, SMOOTH, error=X[..., None])
    assert same(whole(out)[1][2]["error.Y"], X)
    own = write(tmp_path / "own.exr", layer("", COLOR) | {"error.Y": X})
    for error in (None, 2 * X[..., None]):  # another program's stays
        exr.write_contents(
            out, exr.read_contents(own, everything=True), SMOOTH, error=error
        )
        ((_, _, channels),) = whole(out)
        assert same(channels["error.Y"], X)
        assert ("jscomb.error.Y" in channels) == (error is not None)
    exr.write_contents(out, contents, SMOOTH, error=X[..., None])
    assert exr.read_result(out) == {}
    exr.write_contents(out, contents, SMOOTH, provenance={"made": "today"})
    assert exr.read_result(out) == {"made": "today"}
    data = bytearray(out.read_bytes())
    data[-40] ^= 1
    out.write_bytes(data)
    assert exr.read_result(out) == {}


def test_chromaticities(tmp_path):
    """Of another file they are converted; luminances are by a file's own."""
    ap1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    plain = exr.read_contents(write(tmp_path / "p.exr", layer("", COLOR)))
    wide = write(tmp_path / "w.exr", layer("", COLOR), chromaticities=ap1)
    wide = exr.read_contents(wide)
    back, notes = exr.convert(COLOR, wide, plain)
    assert "converted" in notes[0]
    white = np.ones((H, W, 3), np.float32)
    np.testing.assert_allclose(exr.convert(white, wide, plain)[0], white, rtol=1e-5)
    # Y of Rec. 709 is the same in both, to the accuracy of the published numbers,
    # for colours without adaptation; here white points differ by a little.
    rec_709, own = (0.2126, 0.7152, 0.0722), (0.2722, 0.6741, 0.0537)
    np.testing.assert_allclose(np.asarray(back) @ rec_709, COLOR @ own, rtol=0.1)
    for contents, weights in ((plain, rec_709), (wide, own)):
        expected = np.median(COLOR @ weights)
        np.testing.assert_allclose(contents.median_luminance, expected, rtol=1e-3)
    name = write(tmp_path / "n.exr", layer("", COLOR), colorInteropID="lin_ap1_scene")
    named = exr.read_contents(name)
    np.testing.assert_allclose(named.chromaticities, ap1, rtol=1e-6)
    assert exr.convert(COLOR, wide, named)[1] == []
    unstated, notes = exr.convert(COLOR, plain, wide)
    np.testing.assert_array_equal(unstated, COLOR)
    assert "states no chromaticities" in notes[0]


def test_windows_of_other_files(tmp_path):
    """Placed within the same display; the same pixels if there is no better guess."""
    corners = public_images.corners
    display = {"displayWindow": corners(0, 0, W - 1, H - 1)}
    whole_ = exr.read_contents(write(tmp_path / "a.exr", layer("", COLOR)))
    part = COLOR[2:7, 3:9]
    at = {"dataWindow": corners(3, 2, 8, 6)}
    crop = exr.read_contents(
        write(tmp_path / "b.exr", layer("", part), **display, **at)
    )
    found, notes = exr.convert(crop.image, crop, whole_)
    np.testing.assert_array_equal(found[2:7, 3:9], part)
    assert np.isnan(found).sum() == 3 * (H * W - 30)
    assert notes == []
    found, _ = exr.convert(whole_.image, whole_, crop)
    np.testing.assert_array_equal(found, part)
    moved = exr.read_contents(write(tmp_path / "c.exr", layer("", part)))
    found, notes = exr.convert(moved.image, moved, crop)
    np.testing.assert_array_equal(found, part)
    assert "another" in notes[0]
    with pytest.raises(ValueError, match=r"c\.exr is \(5, 6, 3\), .*a\.exr \(12, 10"):
        exr.convert(moved.image, moved, whole_)


def test_features_of_other_files(tmp_path):
    """The layer of that name, else the main image."""
    named = write(tmp_path / "n.exr", layer("", COLOR) | layer("albedo", ALBEDO))
    np.testing.assert_array_equal(exr.read_feature(named, "albedo").image, ALBEDO)
    plain = write(tmp_path / "p.exr", layer("", NORMAL, "XYZ"))
    np.testing.assert_array_equal(exr.read_feature(plain, "normal").image, NORMAL)
    variance = write(tmp_path / "v.exr", layer("variance", SMOOTH))
    found = exr.read_feature(variance, "variance", samples=4).image
    np.testing.assert_array_equal(found, SMOOTH / 4)
    with pytest.raises(ValueError, match=r"v\.exr: .*give the samples"):
        exr.read_feature(variance, "variance")
    with pytest.raises(ValueError, match=r"z\.exr: has no albedo"):
        exr.read_feature(write(tmp_path / "z.exr", {"Z": X}), "albedo")


def test_memory_is_counted_by_what_is_read(tmp_path):
    """Not by the display window, nor by channels that nobody wants, nor as 32 bits."""
    half = {f"aov{n}.R": X.astype(np.float16) for n in range(70)}
    color = {n: c.astype(np.float16) for n, c in layer("", COLOR).items()}
    display = public_images.corners(0, 0, 7679, 4319)
    data = public_images.corners(0, 0, W - 1, H - 1)
    windows = {"displayWindow": display, "dataWindow": data}
    path = write(tmp_path / "f.exr", color | half, **windows)
    size = H * W * 2
    exr.read_contents(path, max_bytes=3 * size)
    with pytest.raises(ValueError, match="max_bytes"):
        exr.read_contents(path, max_bytes=3 * size - 1)
    exr.read_contents(path, max_bytes=73 * size, everything=True)
    with pytest.raises(ValueError, match="--max-memory"):
        exr.read_contents(path, max_bytes=73 * size - 1, everything=True)


@pytest.mark.parametrize("alone", [True, False])
def test_some_channels_are_read_alone(alone, tmp_path, monkeypatch):
    """The same with the binding's older class, and where it has none."""
    if not alone:
        monkeypatch.delattr(_files.OpenEXR, "InputFile")
    path = write(tmp_path / "f.exr", layer("", COLOR) | {"Z": X})
    (part,) = read_pixels(read_headers(os.fspath(path)), {0: ["G", "Z"]})
    assert list(part.channels) == ["G", "Z"]
    assert same(part.channels["G"], np.ascontiguousarray(COLOR[..., 1]))
    assert same(part.channels["Z"], X)


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "store").mkdir()
    link, real = tmp_path / "link.exr", tmp_path / "store" / "real.exr"
    link.symlink_to(real)
    for value in (1, 2):  # not there yet, and there
        exr.write_image(link, np.full((2, 2, 3), value))
        assert link.is_symlink()
        np.testing.assert_array_equal(exr.read_image(real), value)
    assert [each.name for each in real.parent.iterdir()] == ["real.exr"]


def test_layers_are_named_where_a_dialect_chooses(tmp_path):
    """In Mitsuba's files too; a frame of our own has none."""
    channels = layer("img", noise(5, H, W, 4), "RGBA") | layer("alb", ALBEDO)
    channels |= layer("other", SMOOTH) | layer("mse", SMOOTH)
    path = write(tmp_path / "m.exr", channels, generatedBy="Mitsuba")
    np.testing.assert_array_equal(exr.read_frame(path).albedo, ALBEDO)
    contents = exr.read_contents(path, albedo="other", variance="mse")
    np.testing.assert_array_equal(contents.frame.albedo, SMOOTH)
    np.testing.assert_array_equal(contents.frame.variance, SMOOTH)
    own = exr.bundled()["cornell-glass-64"]
    with pytest.raises(ValueError, match=r"its layers cannot be chosen \(--albedo\)"):
        exr.read_contents(own, albedo="other")
