"""The table of layer names: what renderers and denoisers call their images.

Names are compared without case, spaces and punctuation, by the whole name or by its
last component: `ViewLayer.Denoising Albedo` and `denoise_albedo` are both an albedo.

    beauty     the image itself, noisy unless an image called noisy is beside it
    noisy      what a renderer keeps of the noise beside its denoised beauty
    denoised   denoised by the renderer or by another program
    variance   of the beauty; `VARIANCES` says of what
"""

import re

BEAUTIES = (
    *("", "rgba", "rgb", "beauty", "c", "ci", "image", "combined", "color", "colour"),
    *("rgbcolor", "default", "main", "final", "master", "primary", "radiance", "hdr"),
    *("finalimage", "finalimagergba", "rendered"),
)
WITHIN_GROUPS = ("combined", "beauty", "rgba", "rgb", "c", "ci")  # of view layers
NOISY = ("noisyimage", "noisy", "noisybeauty", "denoisingimage", "rgbanoisy")
DENOISED = (
    *("denoised", "denoise", "effectsresult", "denoiser", "vraydenoiser", "optix"),
    *("oidn", "denoisedimage", "filtered", "dn", "denoiseoidn", "denoiseoptix"),
)
FEATURES = {
    "albedo": (
        *("denoisingalbedo", "denoisealbedo", "albedo", "diffusealbedo", "alb"),
        *("diffcol", "diffusecolor", "diffusefilter", "vraydiffusefilter"),
        *("rawdiffusefilter", "basecolor", "oidnalbedo", "visiblealbedo"),
    ),
    "normal": (
        *("denoisingnormal", "denoisenormal", "ns", "normal", "normals", "n", "nrm"),
        *("shadingnormal", "shadingnormals", "avgshadingnormal", "bumpnormals"),
        *("vraynormals", "vraybumpnormals", "worldnormal", "worldnormals", "nn"),
        *("normalworld", "geometricnormal", "geometrynormal", "oidnnormal"),
    ),
    "depth": (
        *("denoisingdepth", "denoisedepth", "depth", "z", "zdepth", "vrayzdepth"),
        *("zfiltered", "depthz", "zbuffer", "distance", "hitpz"),
    ),
    "visibility": ("visibility",),
}
ALPHAS = ("alpha", "a", "opacity")
# Of the mean, of one sample (the unbiased estimate), or the mean squared deviation.
VARIANCES = {
    **dict.fromkeys(("mse", "cimse", "beautymse", "colorvariance"), "mean"),
    **dict.fromkeys(("colourvariance", "meanvariance"), "mean"),
    **dict.fromkeys(("denoisingvariance", "denoisingimagevariance"), "deviation"),
    **dict.fromkeys(("variance", "rgbvariance", "rgbavariance"), "sample"),
    **dict.fromkeys(("beautyvariance", "cvariance"), "sample"),
}
_DENOISED = re.compile(r"(?:denoised?|dn)(.+)|(.+?)(?:denoised?|dn)(?:oidn|optix)?")


def plain(name: str) -> str:
    """Return a name as the table has it; one of other letters stays itself."""
    return re.sub(r"[^0-9a-z]+", "", name.lower()) or name


def rank(role: str, name: str) -> int | None:
    """Return how far down the list of a role a plain name is; None if it is not."""
    names = _ROLES[role]
    if name in names:
        return names.index(name)
    if role == "denoised" and (match := _DENOISED.fullmatch(name)):
        image = match[1] or match[2]
        return len(names) if image in BEAUTIES[1:] else None
    return None


_ROLES: dict[str, tuple[str, ...]] = {
    "beauty": BEAUTIES,
    "noisy": NOISY,
    "denoised": DENOISED,
    **FEATURES,
    "alpha": ALPHAS,
    "variance": tuple(VARIANCES),
}
