"""Variations of real scenes: other cameras, lights and materials, for training.

A variation is drawn from a seed and written as a scene file of its own, which names the
original's meshes and textures. Materials exchange places, change colour, roughness and
texture; lights change brightness and tint; the camera stands somewhere between the
original one and what that sees. A camera is taken if it sees something: surfaces, not
too near, of several colours or normals, and lit.
"""

import copy
import pathlib
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from jscomb import rendering

PREVIEW = 48  # width of the image that a camera is judged by
PREVIEW_SPP = 16
CAMERAS = 60  # to try
EXCHANGED = 0.25  # probability of a material
RECOLOURED = 0.3
DEPTH_OF_FIELD = 0.2
CLEAR = "dielectric", "thindielectric", "mask", "roughdielectric"


class Camera(NamedTuple):
    """A place to look from.

    Attributes:
        origin: where it stands.
        target: what it looks at.
        fov: field of view in degrees.
        aperture: radius of its lens; 0 for a pinhole.
    """

    origin: np.ndarray
    target: np.ndarray
    fov: float
    aperture: float


def write_variation(scene: pathlib.Path, seed: int, out: pathlib.Path) -> bool:
    """Write a variation of a scene, unless no camera sees something.

    Args:
        scene: Mitsuba XML file.
        seed: of all that is drawn.
        out: XML file to write.

    Returns:
        whether it was written.

    Raises:
        ImportError: if Mitsuba is not installed.
        ValueError: if the scene is not one.
    """
    rng = np.random.default_rng([seed, 0xCA3E])
    tree = ElementTree.parse(scene).getroot()
    for node in tree.iter("string"):
        if node.get("name") == "filename":
            node.set("value", str((scene.parent / node.get("value", "")).resolve()))
    _vary_materials(tree, rng)
    _vary_lights(tree, rng)
    temporary = out.with_suffix(".tmp.xml")
    temporary.write_text(ElementTree.tostring(tree, encoding="unicode"))
    try:
        loaded = rendering.load_scene(str(temporary), width=PREVIEW, height=PREVIEW)
    finally:
        temporary.unlink()
    camera = _draw_camera(loaded, rng)
    if camera is None:
        return False
    _set_camera(tree, camera)
    out.write_text(ElementTree.tostring(tree, encoding="unicode"))
    return True


def sees_something(scene, sensor=None) -> bool:
    """Return whether a camera is worth a frame.

    Args:
        scene: a loaded Mitsuba scene.
        sensor: of `PREVIEW` pixels; None for the scene's own.

    Returns:
        True if most pixels show surfaces, not too near, which differ, and light.
    """
    mi = rendering.mitsuba()
    sensor = sensor or scene.sensors()[0]
    render = lambda integrator, spp: np.array(
        mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=1)
    )
    names = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,depth:depth"}
    aov = render(mi.load_dict(names), 1)
    albedo, normal, depth = aov[..., :3], aov[..., 3:6], aov[..., 6]
    hit = depth > 0
    if hit.mean() < 0.7:
        return False
    box = scene.bbox()
    diagonal = float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
    if np.quantile(depth[hit], 0.25) < 0.01 * diagonal:
        return False
    detail = np.std(normal[hit], axis=0).mean(), np.std(albedo[hit], axis=0).mean()
    if detail[0] < 0.15 and detail[1] < 0.08:
        return False
    light = render(scene.integrator(), PREVIEW_SPP)[hit].mean(axis=-1)
    typical = np.median(light)
    return bool(typical > 1e-3 and (light > 0.02 * typical).mean() > 0.75)


def _draw_camera(scene, rng: np.random.Generator) -> Camera | None:
    """Draw a camera that sees something; None if there was none."""
    mi = rendering.mitsuba()
    at = mi.ScalarTransform4f()
    origin, seen = _seen(scene, rng)
    if len(seen) < 2:
        return None
    for _ in range(CAMERAS):
        towards, target = seen[rng.integers(len(seen), size=2)]
        place = origin + rng.uniform(0, 0.8) * (towards - origin)
        far = np.linalg.norm(target - place)
        if not far > 0:
            continue
        wide = rng.random() < DEPTH_OF_FIELD
        lens = float(rng.uniform(0.004, 0.02) * far) if wide else 0.0
        camera = Camera(place, target, rng.uniform(25, 75), lens)
        film = {"type": "hdrfilm", "width": PREVIEW, "height": PREVIEW}
        film |= {"rfilter": {"type": "box"}, "pixel_format": "rgb"}
        look = at.look_at(origin=list(place), target=list(target), up=[0, 1, 0])
        if not np.all(np.isfinite(np.array(look.matrix))):
            continue
        sensor = {"type": "perspective", "fov": camera.fov, "to_world": look}
        sensor |= {"film": film, "sampler": {"type": "independent"}}
        if sees_something(scene, mi.load_dict(sensor)):
            return camera
    return None


def _seen(scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The place of a scene's camera, and points that it sees, [N,3]."""
    mi = rendering.mitsuba()
    sensor = scene.sensors()[0]
    origin, points = np.zeros(3), []
    for across, down in rng.uniform(0.05, 0.95, (64, 2)):
        place = mi.Point2f(float(across), float(down))
        ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
        hit = scene.ray_intersect(ray)
        origin = np.array(ray.o, np.float64).reshape(3)
        if np.all(np.array(hit.is_valid())):
            points.append(np.array(hit.p, np.float64).reshape(3))
    return origin, np.array(points)


def _set_camera(tree: ElementTree.Element, camera: Camera) -> None:
    """Replace what the sensor looks at."""
    sensor = tree.find("sensor")
    assert sensor is not None
    for node in list(sensor):
        if node.tag == "transform" or node.get("name", "").startswith(("fov", "focal")):
            sensor.remove(node)
    text = lambda vector: ", ".join(f"{v:.9g}" for v in vector)
    transform = ElementTree.SubElement(sensor, "transform", name="to_world")
    where = {"origin": text(camera.origin), "target": text(camera.target)}
    ElementTree.SubElement(transform, "lookat", {**where, "up": "0, 1, 0"})
    numbers = {"fov": camera.fov}
    if camera.aperture:
        sensor.set("type", "thinlens")
        far = float(np.linalg.norm(camera.target - camera.origin))
        numbers |= {"aperture_radius": camera.aperture, "focus_distance": far}
    for name, value in numbers.items():
        ElementTree.SubElement(sensor, "float", name=name, value=f"{value:.9g}")


def _vary_lights(tree: ElementTree.Element, rng: np.random.Generator) -> None:
    """Scale every light, with a tint."""
    for light in tree.iter("emitter"):
        scale = np.exp(rng.normal(0, 0.8)) * (1 + rng.uniform(-0.3, 0.3, 3))
        for node in light.iter("rgb"):
            if node.get("name") in ("radiance", "irradiance"):
                node.set("value", _numbers(scale * _vector(node)))
        for node in light.findall("float"):
            if node.get("name") in ("scale", "sky_scale", "sun_scale"):
                value = float(node.get("value", "1"))
                node.set("value", f"{value * np.exp(rng.normal(0, 0.8)):.6g}")


def _vary_materials(tree: ElementTree.Element, rng: np.random.Generator) -> None:
    """Exchange materials, colours, textures and roughness."""
    named = [b for b in tree.findall("bsdf") if b.get("id")]
    opaque = [b for b in named if not any(n.get("type") in CLEAR for n in b.iter())]
    originals = [copy.deepcopy(b) for b in opaque]
    for material in opaque:
        if rng.random() < EXCHANGED:
            other = originals[rng.integers(len(originals))]
            own = material.get("id", "")
            material.clear()
            material.attrib.update(other.attrib, id=own)
            material.extend(copy.deepcopy(list(other)))
    files = sorted({f.get("value", "") for b in originals for f in _textures(b)})
    for material in opaque:
        for node in _textures(material):
            if rng.random() < RECOLOURED:
                node.set("value", str(rng.choice(files)))
        for node in material.iter("rgb"):
            if "reflectance" in node.get("name", "") and rng.random() < RECOLOURED:
                colour = rng.uniform(0.1, 0.8) + rng.uniform(-0.25, 0.25, 3)
                node.set("value", _numbers(colour.clip(0.03, 0.9)))
        for node in material.iter("float"):
            if node.get("name") == "alpha":
                rough = float(node.get("value", "0.1")) * np.exp(rng.normal(0, 0.7))
                node.set("value", f"{np.clip(rough, 0.01, 0.6):.4f}")


def _textures(material: ElementTree.Element) -> list[ElementTree.Element]:
    """The file names of a material's reflectances."""
    return [
        name
        for texture in material.iter("texture")
        if "reflectance" in texture.get("name", "")
        for name in texture.findall("string")
        if name.get("name") == "filename"
    ]


def _vector(node: ElementTree.Element) -> np.ndarray:
    """The numbers of an rgb node."""
    return np.array([float(v) for v in node.get("value", "").replace(",", " ").split()])


def _numbers(values: np.ndarray) -> str:
    """Three numbers as an rgb node has them."""
    return ", ".join(f"{v:.6g}" for v in values)
