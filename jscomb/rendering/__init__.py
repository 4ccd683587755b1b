"""Render frames with Mitsuba 3: everything that a combiner may ask for, in one call.

A frame is a sum of passes, each a launch of the renderer with a random stream of its
own. `render` makes all of them and returns the frame::

    from jscomb import rendering
    frame = rendering.render("cornell-glass", rendering.Settings(spp=64, size=128))

It has K independent sub-buffers with the variance of each mean (from single samples),
albedo, normal, depth and visibility, and, where the settings say so, a reference that
carries the difference of its own halves and a photon-mapped estimate with halves. For
other uses `plan_passes`, `Launcher`, `render_steps` and `assemble` are the steps one by
one. Every scene is rendered with a box filter and the path integrator.

Needs the extra `render` (`pip install "jscomb[render]"`). Common random numbers and
photon mapping need a vectorised variant of Mitsuba, that is LLVM 17 or newer.
"""

from jscomb.rendering._launcher import Launcher
from jscomb.rendering._passes import PHOTONS, Moments, Pass, plan_passes
from jscomb.rendering._render import assemble, provenance, render, render_steps
from jscomb.rendering._scenes import SCENES, available, load_scene, mitsuba
from jscomb.rendering._settings import Settings

__all__ = [
    "PHOTONS",
    "SCENES",
    "Launcher",
    "Moments",
    "Pass",
    "Settings",
    "assemble",
    "available",
    "load_scene",
    "mitsuba",
    "plan_passes",
    "provenance",
    "render",
    "render_steps",
]
