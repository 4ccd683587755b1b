"""`jscomb render`: a scene to a frame's file."""

import os
from pathlib import Path
from typing import Annotated

import jax
import tyro

from jscomb import exr, methods, rendering
from jscomb.cli import _tables as tables
from jscomb.cli._outputs import Force, check_inputs_stay, check_is_new
from jscomb.denoisers import oidn
from jscomb.frame import Frame

_Scene = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
_File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
_Settings = Annotated[rendering.Settings, tyro.conf.arg(name="")]
_DEFAULT = rendering.Settings()
_SLOW = (
    "without LLVM 17 or newer Mitsuba renders two to three times slower; on Debian: "
    "apt install libllvm19"
)


def render(
    scene: _Scene,
    /,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    settings: _Settings = _DEFAULT,
    reference_from: _File = None,
    denoise: bool = True,
    force: Force = False,
) -> None:
    """Render a frame with everything that a combiner may ask for, by Mitsuba 3.

    Sub-buffers with variances, features and, if asked for, a reference and a
    photon-mapped image. Work done so far is kept in OUT.partial.npz, from which the
    same command resumes.

    Scenes: {scenes}, random-SEED, or a Mitsuba XML file.

    Args:
        scene: one of the scenes, or a file.
        out: EXR file to write.
        settings: what is rendered.
        reference_from: frame file of the scene whose reference to take.
        denoise: add the image by Open Image Denoise, where that is installed.
        force: replace a file that is there.
    """
    check_is_new(os.fspath(out), force=force)
    if reference_from is not None:
        check_inputs_stay([os.fspath(out)], [os.fspath(reference_from)])
    frame = render_file(
        scene, out, settings, reference_from=reference_from, denoise=denoise
    )
    if denoise and "oidn" not in frame.estimates:
        print(f"oidn: skipped: needs {oidn.NEEDS.missing_package()}")
    also = [*frame.estimates, *(["reference"] if frame.reference else [])]
    print(
        f"wrote {out}: {tables.size(frame)}, {tables.samples(frame)}"
        f"{''.join(f', {name}' for name in also)}"
    )
    if rendering.mitsuba().variant().startswith("scalar"):
        print(_SLOW)


def render_file(
    scene: str,
    out: Path,
    settings: rendering.Settings,
    *,
    reference_from: Path | None = None,
    denoise: bool = True,
) -> Frame:
    """Render a frame and write it; resumes what an interrupted run has left.

    Args:
        scene: one of `rendering.SCENES`, random-SEED, or a Mitsuba XML file.
        out: EXR file to write; the work so far is kept beside it.
        settings: what is rendered.
        reference_from: frame file of the scene whose reference to take.
        denoise: add the image by Open Image Denoise, where that is installed.

    Returns:
        the frame that was written.

    Raises:
        ImportError: if Mitsuba is not installed.
        ValueError: if the scene, the reference or the unfinished work is wrong.
        OSError: if a file cannot be read or written.
    """
    if out.is_dir() or not out.parent.is_dir():  # found out now, not after rendering
        wrong = "is a folder" if out.is_dir() else "is in a folder that does not exist"
        raise ValueError(f"{out} {wrong}")
    reference, borrowed = None, {}
    if reference_from is not None:
        reference = exr.read_frame(reference_from, statistics=False).reference
        if reference is None:
            raise ValueError(f"{reference_from} holds no reference")
        told = exr.read_provenance(reference_from).get("reference_spp")
        borrowed = {"reference_from": reference_from.name, "reference_spp": told}
    partial = out.with_name(f"{out.name}.partial.npz")
    frame = rendering.render(scene, settings, reference=reference, partial=partial)
    if denoise and oidn.available():
        denoised = methods.combine(jax.random.key(0), frame, method="oidn")
        frame = frame.with_estimate("oidn", denoised)
    about = rendering.provenance(scene, settings) | borrowed
    exr.write_frame(out, frame, provenance=about)
    partial.unlink(missing_ok=True)
    return frame
