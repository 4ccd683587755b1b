"""What other renderers write: each dialect's channels, statistics and traps."""

import numpy as np
import pytest

from jscomb import exr
from tests.test_exr import H, W, layer, noise, write


def test_rgb_and_grey(tmp_path):
    image = noise(0, H, W, 3)
    path = write(tmp_path / "i.exr", layer("", image) | {"A": image[..., 0]})
    np.testing.assert_array_equal(exr.read_frame(path).color, image)
    grey = write(tmp_path / "y.exr", {"Y": image[..., 0]})
    np.testing.assert_array_equal(exr.read_frame(grey).color[..., 2], image[..., 0])


def test_half_and_float_in_one_image(tmp_path):
    image = noise(0, H, W, 3)
    channels = layer("", image)
    channels["G"] = channels["G"].astype(np.float16)
    color = exr.read_frame(write(tmp_path / "i.exr", channels)).color
    assert color.dtype == np.float32
    np.testing.assert_allclose(color, image, rtol=1e-3)


def test_mitsuba_layout(tmp_path):
    mean, second = noise(0, H, W, 3), 1 + noise(1, H, W, 3)
    up = np.broadcast_to(np.float32([0, 0.6, 0.8]), (H, W, 3))
    far = 7 * noise(2, H, W, 3)
    channels = {
        **layer("", noise(3, H, W, 3)),
        **layer("nested", noise(4, H, W, 3), "XYZ"),
        **layer("nested.img", np.concatenate([mean, mean[..., :1]], -1), "RGBA"),
        **layer("m2_nested.img", np.concatenate([second, mean[..., :1]], -1), "RGBA"),
        **layer("nested.alb", 3 * noise(5, H, W, 3)),
        **layer("nested.position", far, "XYZ"),
        **layer("nested.sh", up, "XYZ"),
        **layer("nested.dd.y", far[..., :1], "T"),
        **layer("nested.uv", far[..., :2], "UV"),
    }
    path = write(tmp_path / "m.exr", channels, generatedBy="Mitsuba version 3.9.1")
    frame = exr.read_frame(path, samples=17)
    np.testing.assert_array_equal(frame.color, mean)
    np.testing.assert_allclose(frame.variance, (second - mean**2) / 16, rtol=1e-6)
    np.testing.assert_array_equal(frame.albedo, np.minimum(3 * noise(5, H, W, 3), 1))
    np.testing.assert_array_equal(frame.normal, up)
    np.testing.assert_array_equal(frame.depth, far[..., :1])
    with pytest.raises(ValueError, match=r"m\.exr: read as mitsuba: .*give the sampl"):
        exr.read_frame(path)
    np.testing.assert_array_equal(exr.read_image(path), mean)


def test_mitsuba_with_the_names_of_pbrt(tmp_path):
    """Users of `aov` choose the names; who wrote the file decides."""
    image = np.concatenate([noise(0, H, W, 3), noise(1, H, W, 1)], -1)
    channels = {
        **layer("img", image, "RGBA"),
        **layer("Albedo", noise(2, H, W, 3)),
        **layer("P", noise(3, H, W, 3), "XYZ"),
        **layer("depth", noise(4, H, W, 1), "T"),
    }
    frame = exr.read_frame(write(tmp_path / "m.exr", channels, generatedBy="Mitsuba"))
    np.testing.assert_array_equal(frame.color, image[..., :3])
    np.testing.assert_array_equal(frame.depth, noise(4, H, W, 1))


def test_mitsuba_xyz_moments_are_not_taken_for_rgb(tmp_path):
    channels = {
        **layer("", noise(0, H, W, 3)),
        **layer("nested", noise(1, H, W, 3), "XYZ"),
        **layer("m2_nested", noise(2, H, W, 3), "XYZ"),
    }
    frame = exr.read_frame(write(tmp_path / "m.exr", channels))
    np.testing.assert_array_equal(frame.color, noise(0, H, W, 3))
    assert frame.buffers.variance is None


def test_pbrt(tmp_path):
    color, variance = noise(0, H, W, 3), noise(1, H, W, 3)
    normal, albedo = noise(2, H, W, 3), noise(3, H, W, 3)
    for image in (variance, normal, albedo):
        image[0, 0] = 0  # the sky
    variance[1, 1] = 0  # a black surface: exact
    channels = {
        **layer("", color),
        **layer("Albedo", albedo),
        **layer("Ns", normal, "XYZ"),
        **layer("N", 0 * normal, "XYZ"),
        **layer("Variance", variance),
    }
    path = write(tmp_path / "p.exr", channels, samplesPerPixel=16)
    frame = exr.read_frame(path)
    assert frame.samples == 16
    np.testing.assert_array_equal(frame.normal, normal)
    np.testing.assert_array_equal(frame.albedo, albedo)
    assert np.isnan(frame.variance[0, 0]).all()
    np.testing.assert_array_equal(frame.variance[1, 1], 0)
    np.testing.assert_allclose(frame.variance[2:], variance[2:] / 16, rtol=1e-6)
    np.testing.assert_array_equal(np.argwhere(~frame.valid), [[0, 0, 0]])
    np.testing.assert_allclose(
        exr.read_frame(path, samples=4).variance[2:], variance[2:] / 4, rtol=1e-6
    )
    unknown = write(tmp_path / "q.exr", channels)
    with pytest.raises(ValueError, match="samplesPerPixel is missing"):
        exr.read_frame(unknown)


def test_pbrt_old_names(tmp_path):
    channels = layer("", noise(0, H, W, 3)) | {
        "Nsx": noise(1, H, W),
        "Nsy": noise(2, H, W),
        "Nsz": noise(3, H, W),
    }
    frame = exr.read_frame(write(tmp_path / "p.exr", channels))
    np.testing.assert_array_equal(frame.normal[..., 2], noise(3, H, W))


def test_tungsten_directory(tmp_path):
    a, b = noise(0, H, W, 3), noise(1, H, W, 3)
    depth = noise(2, H, W)
    depth[0, 0] = np.inf
    for name, image in {"color": (a + b) / 2, "colorA": a, "colorB": b}.items():
        write(tmp_path / f"{name}.exr", layer("", image))
    write(tmp_path / "colorVariance.exr", layer("", noise(3, H, W, 3)))
    write(tmp_path / "depth.exr", {"Y": depth})
    for half, image in zip("AB", (a, b), strict=True):
        write(tmp_path / f"albedo{half}.exr", layer("", image))
    (tmp_path / "nlm").mkdir()
    for suffix, image in zip(("", "A", "B"), (a + b, a, b), strict=True):
        write(tmp_path / "nlm" / f"nlm{suffix}.exr", layer("", image))
    frame = exr.read_frame(tmp_path, samples=32)
    first, second = frame.halves()
    np.testing.assert_array_equal(first.color, a)
    np.testing.assert_array_equal(second.albedo, b)
    np.testing.assert_allclose(frame.variance, noise(3, H, W, 3), rtol=1e-6)
    assert frame.depth[0, 0, 0] == 0
    np.testing.assert_array_equal(first.depth, frame.depth)
    np.testing.assert_array_equal(second.estimates["nlm"].image, b)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty: .*neither color\.exr nor colorA"):
        exr.read_frame(tmp_path / "empty")


def test_njs_file(tmp_path):
    full, a = noise(0, H, W, 3), noise(1, H, W, 3)
    channels = {
        **layer("default", full),
        **layer("subColorA", a),
        **layer("albedo", full),
        **layer("albedoA", a),
        **layer("depth", full),
        **layer("colorVariance", noise(2, H, W, 3)),
    }
    for name in ("depth", "depthA"):
        channels |= layer(name, np.where(np.arange(W)[:, None] < 2, np.inf, full))
    frame = exr.read_frame(write(tmp_path / "n.exr", channels))
    assert frame.valid.all()
    np.testing.assert_array_equal(frame.buffers.depth[:, :, :2], 0)
    np.testing.assert_allclose(frame.color, full, rtol=1e-6)
    np.testing.assert_array_equal(frame.halves()[0].color, a)
    np.testing.assert_array_equal(frame.halves()[1].color, 2 * full - a)
    np.testing.assert_allclose(frame.variance, noise(2, H, W, 3), rtol=1e-6)
    assert frame.depth.shape == (H, W, 1)


def test_blender_layers(tmp_path):
    """Cycles with denoising data, of a denoised render with the compositor's output."""
    depth = 9 * noise(4, H, W, 1)
    depth[0] = 1e10  # background
    rgba = lambda seed: noise(seed, H, W, 4)
    channels = {
        **layer("Composite.Combined", rgba(0), "RGBA"),
        **layer("View Layer.Combined", rgba(1), "RGBA"),
        **layer("View Layer.Noisy Image", rgba(2), "RGBA"),
        **layer("View Layer.Denoising Albedo", 3 * noise(3, H, W, 3)),
        **layer("View Layer.Denoising Normal", noise(5, H, W, 3), "XYZ"),
        **layer("View Layer.Denoising Depth", depth, "Z"),
        **layer("View Layer.Depth", noise(6, H, W, 1), "Z"),
        **layer("View Layer.Denoising Shadowing", noise(7, H, W, 1), "X"),
        **layer("Z second.Combined", rgba(8), "RGBA"),
    }
    attributes = {"cycles.View Layer.samples": "128", "cycles.Z second.samples": "1"}
    frame = exr.read_frame(write(tmp_path / "b.exr", channels, **attributes))
    assert frame.samples == 128
    np.testing.assert_array_equal(frame.color, rgba(2)[..., :3])
    np.testing.assert_array_equal(frame.estimates["denoised"].image, rgba(1)[..., :3])
    np.testing.assert_array_equal(frame.albedo, np.minimum(3 * noise(3, H, W, 3), 1))
    np.testing.assert_array_equal(frame.normal, noise(5, H, W, 3))
    np.testing.assert_array_equal(frame.depth[0], 0)
    np.testing.assert_array_equal(frame.depth[1:], depth[1:])


def test_blender_without_denoising(tmp_path):
    color, spread = noise(0, H, W, 3), noise(1, H, W, 3)
    channels = {
        **layer("ViewLayer.Combined", color),
        **layer("ViewLayer.Normal", noise(2, H, W, 3), "XYZ"),
        **layer("ViewLayer.DiffCol", noise(3, H, W, 3)),
        **layer("ViewLayer.Denoising Variance", spread),
    }
    path = write(tmp_path / "b.exr", channels)
    with pytest.raises(ValueError, match=r"b\.exr: read as blender: .*give the sampl"):
        exr.read_frame(path)
    frame = exr.read_frame(path, samples=33)
    np.testing.assert_array_equal(frame.color, color)
    np.testing.assert_allclose(frame.variance, spread / 32, rtol=1e-6)
    np.testing.assert_array_equal(frame.albedo, noise(3, H, W, 3))
    np.testing.assert_array_equal(frame.normal, noise(2, H, W, 3))
    assert not frame.estimates


def test_pd_files(tmp_path):
    color, variance = noise(0, H, W, 3), noise(1, H, W, 3)
    channels = {
        **layer("", color),
        **layer("Albedo", noise(2, H, W, 3)),
        **layer("Normal", noise(3, H, W, 3), "XYZ"),
        **layer("Variance", variance),
    }
    path = write(tmp_path / "scene_000064spp.exr", channels)
    write(tmp_path / "scene_000064spp.den.exr", layer("", noise(4, H, W, 3)))
    write(tmp_path / "scene_000064spp.sure.exr", layer("", noise(5, H, W, 3)))
    frame = exr.read_frame(path)
    assert frame.samples == 64
    np.testing.assert_array_equal(frame.variance, variance)
    np.testing.assert_array_equal(frame.albedo, noise(2, H, W, 3))
    np.testing.assert_array_equal(frame.normal, noise(3, H, W, 3))
    np.testing.assert_array_equal(frame.estimates["denoised"].image, noise(4, H, W, 3))
    assert exr.read_frame(path, samples=8).samples == 8
    np.testing.assert_array_equal(exr.read_image(path), color)  # not the file beside


def test_idu_files(tmp_path):
    images = noise(0, 4, H, W, 3)
    for number, image in enumerate(images):
        write(tmp_path / f"box[1]_128spp_randImg_{number}.exr", layer("", image))
        write(tmp_path / f"box[1]_128spp_corrImg_{number}.exr", layer("", 2 * image))
    frame = exr.read_frame(tmp_path / "box[1]_128spp_randImg_0.exr")
    np.testing.assert_array_equal(frame.buffers.color, images)
    assert frame.samples is None
    frame = exr.read_frame(tmp_path / "box[1]_128spp_corrImg_2.exr", samples=128)
    np.testing.assert_array_equal(frame.buffers.color, 2 * images)
    with pytest.raises(ValueError, match=r"f\.exr: read as idu: its name does not end"):
        exr.read_frame(write(tmp_path / "f.exr", layer("", image)), dialect="idu")


@pytest.mark.parametrize("reference", ["ref", "reference", "GT", "target", "4096spp"])
def test_oidn_training_files(tmp_path, reference):
    color, truth = noise(0, H, W, 3), noise(1, H, W, 3)
    normal = 2 * noise(3, H, W, 3) - 1  # not encoded
    path = write(tmp_path / "a_view_0064spp.hdr.exr", layer("", color))
    write(tmp_path / "a_view_0064spp.alb.exr", layer("", 2 * noise(2, H, W, 3)))
    write(tmp_path / "a_view_0064spp.nrm.exr", layer("", normal))
    write(tmp_path / "a_view_0016spp.hdr.exr", layer("", color))
    best = write(tmp_path / f"a_view_{reference}.hdr.exr", layer("", truth))
    write(tmp_path / "a_view_left_8192spp.hdr.exr", layer("", color))  # another scene
    frame = exr.read_frame(path)
    assert frame.samples == 64
    np.testing.assert_array_equal(frame.color, color)
    np.testing.assert_array_equal(frame.albedo, np.minimum(2 * noise(2, H, W, 3), 1))
    np.testing.assert_array_equal(frame.normal, normal)
    np.testing.assert_array_equal(frame.reference.image, truth)
    assert exr.read_frame(best).reference is None
    alone = write(tmp_path / "alone.hdr.exr", layer("", color))
    assert exr.read_frame(alone).samples is None
    (tmp_path / "a_view_0064spp.nrm.exr").write_text("not an image")
    with pytest.raises(ValueError, match=r"a_view_0064spp\.nrm\.exr: not a readable"):
        exr.read_frame(path)


@pytest.mark.parametrize(
    ("data", "display"),
    [
        ((2, 3, 11, 14), (0, 0, 19, 29)),  # a crop
        ((-2, -1, 7, 10), (0, 0, 4, 6)),  # overscan
        ((5, 5, 14, 16), (0, 0, 3, 3)),  # nothing in common
    ],
)
def test_a_frame_is_its_data_window(tmp_path, data, display):
    """All that was rendered, and nothing else; the contents know where it is."""
    x0, y0, x1, y1 = data
    pixels = noise(0, y1 - y0 + 1, x1 - x0 + 1)
    corners = lambda w: (np.int32(w[:2]), np.int32(w[2:]))
    header = {"dataWindow": corners(data), "displayWindow": corners(display)}
    path = write(tmp_path / "c.exr", {"Y": pixels}, **header)
    contents = exr.read_contents(path)
    np.testing.assert_array_equal(contents.image[..., 0], pixels)
    assert contents.window == (x0, y0, x1 - x0 + 1, y1 - y0 + 1)
    assert contents.display == (0, 0, display[2] + 1, display[3] + 1)
