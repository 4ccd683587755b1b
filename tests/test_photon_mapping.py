"""Photon mapping is right: against path tracing, and against itself."""

import dataclasses

import numpy as np
import pytest

from jscomb import exr, rendering
from jscomb.rendering import PHOTONS, Launcher, Pass, Settings
from jscomb.rendering import _photon_mapping as photon_mapping
from tests.statistics import assert_mean

SCENE, SIZE = "cornell-box", 24
LAMP = 18.387, 13.9873, 6.75357  # radiance in Mitsuba's Cornell box
# Radii far below what the box's walls would notice.
SETTINGS = Settings(size=SIZE, spp=4, passes=4, photons=20_000, radius=0.05)


def passes(settings=SETTINGS):
    """The photon passes."""
    return [p for p in rendering.plan_passes(settings) if p.integrator == PHOTONS]


@pytest.fixture(scope="module")
def launch(vectorised):
    """Launches of the scene with these settings."""
    return Launcher(SCENE, SETTINGS)


def test_radii_shrink_in_pairs():
    radii = [p.radius for p in passes(dataclasses.replace(SETTINGS, passes=6))]
    assert radii[0] == radii[1] == 1
    np.testing.assert_allclose(radii[2], ((1 + 2 / 3) / 2) ** 0.5)
    np.testing.assert_allclose(radii[4] / radii[2], ((2 + 2 / 3) / 3) ** 0.5)
    assert radii[4] == radii[5]


def radii_by_statistics(photons, passes=100, alpha=2 / 3):
    """Each pixel's radius by Hachisuka and Jensen; `photons` of an area of one."""
    square, counted, radii = 1.0, 0.0, []
    for _ in range(passes):
        radii.append(np.sqrt(square))
        found = photons(square)
        total = counted + found
        shrunk = (counted + alpha * found) / np.where(total > 0, total, 1)
        square = square * np.where(total > 0, shrunk, 1)
        counted = counted + alpha * found
    return radii


@pytest.mark.parametrize("density", [1e-3, 1.0, 1e6])
def test_radii_are_those_of_each_pixels_own_statistics(density):
    """However many photons there are, in proportion to the area (from pass 2)."""
    radii = np.array(radii_by_statistics(lambda area: density * area))
    ours = [photon_mapping.relative_radius(2 * number) for number in range(99)]
    np.testing.assert_allclose(radii[1:] / radii[1], ours, rtol=1e-12)


def test_radii_of_pixels_that_photons_seldom_reach_are_larger():
    """They wait for a photon; of 20 photons a pass the noise is all that is left."""
    rng, size = np.random.default_rng(0), 4000
    exact = radii_by_statistics(lambda area: area)[-1]
    at = lambda density: radii_by_statistics(
        lambda area: rng.poisson(density * area * np.ones(size))
    )[-1]
    many, few = at(20.0) / exact, at(0.05) / exact
    np.testing.assert_allclose(many.mean(), 1, atol=0.005)
    assert 0.02 < many.std() < 0.03
    assert 1.65 < few.mean() < 1.75


def test_the_photons_have_streams_of_their_own():
    every = rendering.plan_passes(dataclasses.replace(SETTINGS, reference_spp=64))
    assert len({p.seed for p in every}) == len(every)
    assert [p.target for p in passes()] == ["photons0", "photons1"] * 2


def test_agrees_with_path_tracing(vectorised):
    """Means of regions of the walls, of each pass and of as many path-traced ones."""
    many = dataclasses.replace(SETTINGS, passes=40, photons=30_000)
    launch = Launcher(SCENE, many)
    photons = [launch(p)[..., :3] for p in passes(many)]
    traced = [launch(Pass("", 16, k, "path")) for k in range(40)]
    regions = {
        "back wall": (slice(5, 11), slice(7, 17)),
        "red wall": (slice(8, 18), slice(1, 4)),
        "ceiling": (slice(1, 3), slice(3, 7)),
        "floor": (slice(21, 23), slice(2, 10)),
    }
    for rows, columns in regions.values():
        means = [np.stack(i)[:, rows, columns].mean((1, 2)) for i in (photons, traced)]
        difference = means[0] - means[1]
        for channel in range(2):
            assert_mean(difference[:, channel], 0.0)
            error = difference[:, channel].std(ddof=1) / 40**0.5
            assert error < 0.05 * means[1][:, channel].mean()  # and it would be seen


CORNER = """<scene version="3.0.0">
  <sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 3, 4" target="0, .6, 0" up="0, 1, 0"/>
    </transform>
    <film type="hdrfilm"/>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
    <bsdf type="twosided">FLOOR</bsdf>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><translate z="-1"/><scale value="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value=".8"/></bsdf>
  </shape>
  LIGHT
</scene>"""
FLOORS = {
    "diffuse": '<bsdf type="diffuse"/>',
    "sharp": '<bsdf type="roughplastic"><float name="alpha" value="0.02"/></bsdf>',
    "metal": '<bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf>',
    "principled": '<bsdf type="principled"/>',
}
AREA = """<shape type="rectangle">
    <transform name="to_world"><scale value=".5"/><rotate x="1" angle="90"/>
      <translate y="2.5"/></transform>
    <emitter type="area"><rgb name="radiance" value="9"/></emitter>
  </shape>"""
TURNED = """<emitter type="envmap"><string name="filename" value="sky.exr"/>
    <transform name="to_world"><rotate y="1" angle="90"/></transform>
  </emitter>"""


def corner(folder, floor, light):
    """Write a scene of a floor and a wall, and return its path."""
    sky = np.ones((8, 16, 3), np.float32)
    rendering.mitsuba().Bitmap(sky).write(str(folder / "sky.exr"))
    path = folder / "corner.xml"
    path.write_text(CORNER.replace("FLOOR", FLOORS[floor]).replace("LIGHT", light))
    return str(path)


@pytest.mark.parametrize(
    ("floor", "light"),
    [("diffuse", TURNED), ("sharp", AREA), ("metal", AREA), ("principled", AREA)],
)
def test_agrees_with_path_tracing_whatever_floor_and_light(
    vectorised, tmp_path, floor, light
):
    """In the distance and nearby, and no pixel stands out."""
    settings = dataclasses.replace(SETTINGS, photons=30_000, radius=0.03)
    launch = Launcher(corner(tmp_path, floor, light), settings)
    first = passes()[0]
    photons = [launch(first._replace(seed=k))[..., :3] for k in range(30)]
    traced = [launch(Pass("", 64, 100 + k, "path")) for k in range(30)]
    for part in (slice(2, 11), slice(13, 22)):
        means = [np.stack(i)[:, part].mean((1, 2, 3)) for i in (photons, traced)]
        difference = means[0] - means[1]
        assert_mean(difference, 0.0)
        assert difference.std(ddof=1) / 30**0.5 < 0.03 * means[1].mean()
    assert np.mean(photons, axis=0).max() < 1.5 * np.mean(traced, axis=0).max()


def test_light_of_lamps_is_seen_directly(launch):
    """The brightest pixel lies within the lamp; what it reflects besides is little."""
    image = launch(passes()[0])
    np.testing.assert_allclose(image[..., :3].max(axis=(0, 1)), LAMP, rtol=0.05)


def test_neither_buckets_nor_room_matter(launch, monkeypatch):
    """All photons in one bucket, or a store that is too small at first: the same."""
    first, second = passes()[:2]
    image = launch(first)
    np.testing.assert_array_equal(launch(first), image)
    assert not np.array_equal(launch(second), image)
    small = dataclasses.replace(SETTINGS, photons=2000)
    launch = Launcher(SCENE, small)
    expected = launch(first)
    monkeypatch.setattr(photon_mapping, "_hash", lambda x, y, z: 0 * x)
    np.testing.assert_allclose(launch(first), expected, rtol=1e-4, atol=1e-5)
    monkeypatch.undo()
    monkeypatch.setattr(photon_mapping, "ROOM", 0.01)
    launch = Launcher(SCENE, small)
    np.testing.assert_allclose(launch(first), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("radius", [0.02, 0.05, 0.1, 1 / 3])
def test_walls_where_cells_meet(launch, radius):
    """At these radii walls, 1 from the middle, are borders of cells: no light lost."""
    first = passes()[0]
    relative = radius / SETTINGS.radius
    images = [launch(first._replace(radius=r * relative)) for r in (1, 1.001)]
    means = [image[..., :3].mean(axis=(0, 1)) for image in images]
    np.testing.assert_allclose(*means, rtol=5e-3)


def test_weighted_by_squared_radius(launch):
    *_, last = passes()
    image = launch(last)
    share = (1 + 2 / 3) / 2
    np.testing.assert_allclose(image[..., 3:], share * image[..., :3], rtol=1e-6)


def test_passes_share_their_kernels(launch):
    """Radii and numbers of photons differ, yet nothing is compiled but once."""
    import drjit as dr

    first, *others = passes(dataclasses.replace(SETTINGS, passes=6))
    launch(first)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for one in others:
            launch(one)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(kernels) >= len(others)
    assert all(k["cache_hit"] for k in kernels)


def test_a_frame_with_photons(jscomb, tmp_path, vectorised):
    out = tmp_path / "f.exr"
    options = "--size", SIZE, "--spp", "4", "--no-denoise"
    photons = "--photons", "20000", "--passes", "4", "--radius", "0.05"
    status, said, _ = jscomb("render", SCENE, "-o", out, *map(str, options + photons))
    assert (status, ", photons" in said) == (0, True)
    read, frame = exr.read_frame(out), rendering.render(SCENE, SETTINGS)
    image, halves = read.estimates[PHOTONS]
    np.testing.assert_allclose(image, np.mean(halves, axis=0), rtol=1e-5)
    assert halves.shape == (2, SIZE, SIZE, 3)
    assert not np.array_equal(*halves)
    np.testing.assert_array_equal(image, frame.estimates[PHOTONS].image)
    assert read.samples == 4
    told = exr.read_provenance(out)
    assert (told["passes"], told["photons"], told["radius"]) == (4, 20_000, 0.05)
    assert list(tmp_path.iterdir()) == [out]
