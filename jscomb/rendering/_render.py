"""A frame with everything that a combiner may ask for."""

import dataclasses
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jscomb.frame import Estimate, Frame, Reference, make_frame
from jscomb.rendering._launcher import Launcher
from jscomb.rendering._partial import Partial
from jscomb.rendering._passes import PHOTONS, SAMPLES, Moments, Pass, plan_passes
from jscomb.rendering._scenes import mitsuba
from jscomb.rendering._settings import Settings

# Of the settings, what a file tells.
TOLD = "spp", "buffers", "feature_spp", "reference_spp", "seed", "numbers", "tile"
TOLD_PHOTONS = "passes", "photons", "radius"


def render(
    scene: str,
    settings: Settings,
    *,
    reference: Reference | None = None,
    partial: pathlib.Path | None = None,
) -> Frame:
    """Render a frame.

    Args:
        scene: one of `SCENES`, random-SEED, or the path of a Mitsuba XML file.
        settings: what is rendered of it.
        reference: of another frame of the scene, in place of one of its own.
        partial: .npz file for the work so far, from which the same call resumes; to be
            removed by the caller once the frame is stored.

    Returns:
        the frame in float32: sub-buffers with variances and features, the reference,
        and the estimate `photons`, with halves, of settings that have photons.

    Raises:
        ImportError: if Mitsuba is not installed; says how to install it.
        ValueError: if the scene is unknown or needs a vectorised variant of Mitsuba,
            the reference has another shape, or `partial` is of another frame.

    Example:
        >>> from jscomb import rendering
        >>> if rendering.available():
        ...     frame = render("cornell-box", Settings(spp=4, size=8, feature_spp=1))
        ...     assert (frame.samples, frame.color.shape) == (4, (8, 8, 3))
    """
    launch = Launcher(scene, settings)
    if reference is not None:  # found out now, not after the last pass
        if settings.reference_spp:
            raise ValueError("give reference_spp or another frame's reference")
        if reference.image.shape != launch.shape:
            raise ValueError(
                f"the reference is {reference.image.shape}, the film {launch.shape}"
            )
    *_, (_, moments) = render_steps(scene, settings, launch=launch, partial=partial)
    frame = assemble(settings, moments)
    return frame if reference is None else frame._replace(reference=reference)


def render_steps(
    scene: str,
    settings: Settings,
    *,
    todo: Sequence[Pass] | None = None,
    launch: Callable[[Pass], np.ndarray] | None = None,
    partial: pathlib.Path | None = None,
) -> Iterator[tuple[int, dict[str, Moments]]]:
    """Render pass by pass, from where an interrupted run stopped.

    Args:
        scene: one of `SCENES`, random-SEED, or the path of a Mitsuba XML file.
        settings: what is rendered of it.
        todo: the passes in their order; None for `plan_passes`.
        launch: renders a pass; None for a new `Launcher`.
        partial: .npz file for the work so far, as of `render`.

    Yields:
        after each pass (and first what an interrupted run has left, if anything) how
        many are done, and the moments of every target so far.

    Raises:
        ImportError: if Mitsuba is not installed.
        ValueError: as `render`.

    Example:
        >>> from jscomb import rendering
        >>> if rendering.available():
        ...     settings = Settings(spp=4, size=8, buffers=1)
        ...     for done, moments in render_steps("cornell-box", settings):
        ...         if done == 1:
        ...             break
        ...     assert moments["color0"].number == 4
    """
    launch = launch or Launcher(scene, settings)
    kept = Partial(partial, scene, settings)
    done, moments = kept.load()
    todo = plan_passes(settings) if todo is None else todo
    spp = sum(p.spp for p in todo)
    with tqdm(total=spp, unit="spp", desc=scene, leave=False, disable=None) as bar:
        bar.update(sum(p.spp for p in todo[:done]))
        if done:
            yield done, moments
        for number, p in enumerate(todo[done:], done + 1):
            found = moments.get(p.target, Moments())
            image = launch(p)
            for each in image if p.integrator == SAMPLES else [image]:
                found = found.add(each)
            moments[p.target] = found
            bar.update(p.spp)
            kept.save(number, moments, last=number == len(todo))
            yield number, moments


def assemble(settings: Settings, moments: Mapping[str, Moments]) -> Frame:
    """Return the frame that moments describe.

    Args:
        settings: what was rendered.
        moments: of every target, from `render_steps`.

    Returns:
        the frame in float32, as of `render`.

    Example:
        >>> settings = Settings(spp=2, buffers=1)
        >>> image = np.ones((4, 5, 7))
        >>> targets = {"color0": image[..., :3], "aov0": image, "visibility0": image}
        >>> assemble(
        ...     settings, {k: Moments().add(i).add(i) for k, i in targets.items()}
        ... ).color.shape
        (4, 5, 3)
    """

    def stack(name: str, value: Callable[[Moments], np.ndarray]) -> np.ndarray:
        each = [value(moments[f"{name}{k}"]) for k in range(settings.buffers)]
        return np.stack(each).astype(np.float32)

    reference = None
    if settings.reference_spp:
        a, b = moments["reference0"].mean, moments["reference1"].mean
        both = (a + b) / 2, a - b
        reference = Reference(*(jnp.asarray(i, jnp.float32) for i in both))
    single = settings.spp == settings.buffers
    aov = stack("aov", lambda m: m.mean)
    frame = make_frame(
        stack("color", lambda m: m.mean),
        variance=None if single else stack("color", lambda m: m.variance_of_mean),
        albedo=aov[..., :3].clip(0, 1),  # metals report up to 10
        normal=aov[..., 3:6],
        depth=aov[..., 6:7],
        visibility=stack("visibility", lambda m: m.mean[..., :1]),
        samples=settings.spp,
        reference=reference,
    )
    if not settings.photons:
        return frame
    halves = np.stack([moments[f"{PHOTONS}{k}"].mean[..., :3] for k in range(2)])
    both = jnp.asarray(halves, jnp.float32)
    return frame.with_estimate(PHOTONS, Estimate(jnp.mean(both, axis=0), both))


def provenance(scene: str, settings: Settings) -> dict[str, Any]:
    """Return where a frame came from, to be written with it.

    Args:
        scene: that was rendered.
        settings: what was rendered of it.

    Returns:
        renderer, its variant, scene, and the settings that an image depends on.

    Raises:
        ImportError: if Mitsuba is not installed.

    Example:
        >>> from jscomb import rendering
        >>> if rendering.available():
        ...     about = provenance("cornell-box", Settings(spp=16))
        ...     assert (about["scene"], about["spp"]) == ("cornell-box", 16)
    """
    mi, fields = mitsuba(), dataclasses.asdict(settings)
    told = TOLD + (TOLD_PHOTONS if settings.photons else ())
    return {
        "renderer": f"Mitsuba {mi.__version__}",
        "variant": mi.variant(),
        "scene": scene,
        **{name: fields[name] for name in told},
    }
