"""What of uncorrelated kernels is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

_ERROR = "experiments.uncorrelated.error"
_BIAS = "experiments.uncorrelated.bias"
_WINDOWS = "experiments.uncorrelated.windows"
_NO_COMBINER = (
    "The deep combiner is not here: it is another paper's network, with its own "
    "weights and training."
)

CLAIMS = (
    Claim(
        "eq. 1",
        "a pixel as the weighted mean of its own y and of y_i + D_ci z of its "
        "neighbours, weights of sum one",
        where=("uncorrelated.combine_with",),
        note="Computed as eq. 5, which is the same; windows are clipped to the image.",
    ),
    Claim(
        "eq. 2",
        "weights uncorrelated with y and z leave the result unbiased; equal weights "
        "1 / (N + 1), N the number of neighbours, are one case",
        where=("uncorrelated.combine_uniform",),
        measured=(_BIAS, _ERROR),
        note="No bias is found on three frames. Its error is above path tracing's "
        "wherever common numbers are noisier than independent ones.",
    ),
    Claim(
        "eq. 3, 4",
        "Hogg's theorem: an odd statistic that follows a shift and an even one that "
        "does not change with it are uncorrelated under symmetric noise",
        where=("uncorrelated.admissibility",),
        note="The conditions of g are tested numerically; f is always the mean.",
    ),
    Claim(
        "eq. 5",
        "the same with the centre's weight eliminated: y_c + sum k_i (D_ci z - D_ci y)",
        where=("uncorrelated.combine", "uncorrelated.combine_with"),
        note="Tests hold it against loops written from the paper.",
    ),
    Claim(
        "eq. 6",
        "D_ci z is the mean of B sub-averages of equally many samples",
        where=("uncorrelated.combine_with",),
        measured=(_ERROR,),
        note="Any B of at least one; `combine` needs two. Two, four and eight are "
        "measured: of path tracing's relative L2 they have 0.60, 0.53 and 0.54 "
        "(worst of 8 frames 2.62, 1.18 and 1.21).",
    ),
    Claim(
        "eq. 7",
        "theorem 2: a bounded kernel that ignores a common constant and a common sign "
        "of the D_ci z^j gives an unbiased result where they are symmetric",
        where=("uncorrelated.admissibility",),
        note="A test of many realisations finds no bias under symmetric noise, and "
        "under skewed noise the one that is computed by hand.",
    ),
    Claim(
        "section 4.1, variations",
        "the kernel may depend on D_ci y instead, or on both",
        where=("uncorrelated.combine",),
        measured=(_ERROR,),
        note="`guides`; of both, one constant for z and another for y. Unbiased in "
        "tests under symmetric noise. Of path tracing's "
        "relative L2 kernels of z have 0.60, of y 1.55, of both 1.14.",
    ),
    Claim(
        "section 4.1, consistency",
        "the differences' distribution becomes normal as samples grow, so the bias "
        "vanishes",
        where=("uncorrelated.combine",),
        measured=(_BIAS,),
        note="A test, and the bias at 4 and at 16 samples in each sub-average. The "
        "squared bias falls faster than the variance only where every sub-average has "
        "sampled the tail of the noise: 14 times to 3.4 times on a synthetic frame of "
        "bounded skewness, where theory has 16 and 4; on cornell-glass, whose caustics "
        "most sub-averages miss, 3.4 times each, and on cornell-glossy 1.7 to 3.2 "
        "times, with a standard error of a third.",
    ),
    Claim(
        "eq. 8",
        "k = exp(-gamma n (D_ci z^1 - D_ci z^2)^2) / N, B = 2, windows of 15x15",
        where=("uncorrelated.variance_kernel", "uncorrelated.combine"),
        measured=(_ERROR, _WINDOWS),
        note="For more sub-averages the square is the mean over all pairs; of two it "
        "is the paper's. Ours beside it: `median_kernel`, `combine_median`. On four "
        "scenes at 16 and 128 samples of each kind the paper's has 0.60 of path "
        "tracing's relative L2 (worst 2.62) and 1.15 of its squared error; "
        "`combine_median` of eight sub-averages 0.25 (worst 1.58) and 0.84; "
        "`median_kernel` is worse than the paper's, 1.25, and far slower. "
        "Windows of 7 pixels, the smallest measured, have less error than 15 or 31, on "
        "films of 192 and of 96 pixels alike: 15 are a larger share of these films "
        "than of the paper's.",
    ),
    Claim(
        "section 4.2, gamma",
        "of ten candidates from 0.01 to 2.5 the one with the least relative variance, "
        "estimated from four pairs, the first two against the other two",
        where=("uncorrelated.select_gamma", "uncorrelated.PAPER_MULTIPLES"),
        measured=(_ERROR,),
        note="By default four smaller candidates from 0.0005 are added, pairs 1, 3 "
        "stand against 2, 4 (the same in distribution), and every fourth row is "
        "judged (`stride=1` for all). `select_gamma_map` chooses by region, ours. "
        "The paper's least candidate, 0.01, is selected in 3 of 8 frames, its greatest "
        "in none; the extended ones change the error to 0.92 of that of the paper's "
        "(0.64 to 1.00), and their ends are never selected. Regions of 33 pixels have "
        "0.575 of path tracing's error, one gamma 0.599.",
    ),
    Claim(
        "fig. 1",
        "a frame and a close-up: the kernel keeps edges; relative L2",
        where=(_ERROR,),
        measured=(_ERROR,),
        note="Errors only, not shown as images. At equal "
        "samples 0.60 of path tracing's relative L2; 2.62, worse than it, on "
        "veach-bidir at 16 samples, where z has 12 times path tracing's error.",
    ),
    Claim(
        "fig. 2",
        "the uniform kernel leaves the structured noise of common random numbers, the "
        "input-dependent one lowers it",
        where=("uncorrelated.combine_uniform", _ERROR),
        measured=(_ERROR,),
        note="Errors only, not shown as images. Of path "
        "tracing's relative L2 the uniform kernel has 2.63, the input-dependent one "
        "0.60; z alone has 2.43, of half the samples.",
    ),
    Claim(
        "fig. 3",
        "Pearson's median skewness of 600 images of 128 samples: that of differences "
        "is 3.6 times less than that of pixels",
        where=(_BIAS,),
        measured=(_BIAS,),
        note="Ours has 150 realisations at 96x96, of 16 and of 64 samples. Differences "
        "are less skewed by less than in the paper: 1.7 and 1.8 times on "
        "cornell-glass, 1.3 and 1.3 on cornell-glossy, 2.7 and 1.5 on the synthetic "
        "frame. The paper's scene is not here. Chance alone makes a size of about 1.8 "
        "/ sqrt(images), so the root mean square without it is given beside: it is "
        "1.8 and 1.9, 0.9 and 1.1, 2.3 and 1.9 times less.",
    ),
    Claim(
        "fig. 4",
        "squared bias over 300 realisations: 21 times below the deep combiner's",
        where=(_BIAS,),
        measured=(_BIAS,),
        note=_NO_COMBINER + " Open Image Denoise, the bilateral filter and James-Stein "
        "stand in its place, which is another comparison, over 150 realisations. The "
        "paper's plain squared bias is 206 and 833 times below Open Image Denoise's on "
        "cornell-glass (4 and 16 samples in each sub-average), 7.0 and 5.5 times on "
        "cornell-glossy, 280 and 1730 times on the synthetic frame. Relative to "
        "squared radiance it is 2.5 and 1.9, and 30 and 150 times below on the latter "
        "two, but 3.4 and 2.1 times *above* on cornell-glass: its bias lies in dark "
        "pixels, the denoiser's in bright ones.",
    ),
    Claim(
        "section 5, cross-weighting",
        "the kernel of pairs 1, 2 applied to pairs 3, 4 and the other way round, "
        "averaged: unbiased",
        where=("uncorrelated.combine_crosswise",),
        measured=(_BIAS, _ERROR),
        note="No bias is found on three frames. gamma by "
        "the same rule, `select_gamma(crosswise=True)`.",
    ),
    Claim(
        "section 5, L2 reconstruction",
        "z by L2 reconstruction depends on y; so y^1, y^2 are combined with z^3, z^4 "
        "and the other way round, and both averaged",
        where=("uncorrelated.combine_decorrelated", "numerics.poisson.reconstruct"),
        measured=(_BIAS, _ERROR),
        note="The screened Poisson equation is solved by cosine transforms.",
    ),
    Claim(
        "fig. 5",
        "beside the uniform and the cross-weighted kernel: both leave noise that the "
        "input-dependent one removes",
        where=(_ERROR, _BIAS),
        measured=(_ERROR, _BIAS),
        note="As in the paper: of path tracing's relative L2 uniform 2.63, "
        "crosswise 1.37, input-dependent 0.60, which is the best of the three on each "
        "of 8 frames. The squared bias of the others is not told from none, that of "
        "ours is.",
    ),
    Claim(
        "fig. 6",
        "beside the deep combiner: its relative L2 is 1.9 to 3.6 times less, its "
        "squared bias 18.2 to 39.3 times more",
        where=(_ERROR, _BIAS),
        measured=(_ERROR, _BIAS),
        note=_NO_COMBINER + " Beside it Open Image "
        "Denoise has 0.05 of path tracing's relative L2 and uncorrelated kernels 0.60, "
        "13 times more: a larger gap than the paper's, with fewer samples and a "
        "denoiser that has albedo and normals. Of path tracing's squared error they "
        "have 0.59 and 1.15. Squared bias: see fig. 4.",
    ),
    Claim(
        "section 5, AFGSA",
        "beside a recent biased denoiser at equal total samples",
        where=(_ERROR,),
        measured=(_ERROR,),
        note="AFGSA is not here: it is a network with its own weights and training. "
        "Open Image Denoise has the same total of samples. Its relative L2 is below "
        "ours on all 8 frames, 2 to 1700 times; an ensemble with the uncorrelated "
        "result as a base has 1.5 times the error of one of independent samples alone, "
        "since half of its samples are common ones. More than 128 samples of each "
        "kind, where a consistent method should gain, are not measured.",
    ),
    Claim(
        "section 5, gradient-domain rendering",
        "the kernel improves the unbiased L2 reconstruction of gradient-domain path "
        "tracing",
        where=(_ERROR, _BIAS),
        measured=(_ERROR, _BIAS),
        note="Gradients are differences of pixels under common random numbers: a pixel "
        "replays its neighbour's random numbers, a shift whose Jacobian is one. "
        "Gradient-domain path tracing with shift mapping is not here: no integrator of "
        "Mitsuba 3.9 traces offset paths (it has path, volpath, volpathmis, direct, "
        "ptracer, and those of derivatives by scene parameters, prb and projective, "
        "which are not differences of pixels), and a reconnection shift with its "
        "Jacobian would be a path tracer of our own. The kernel "
        "improves the reconstruction from 2.38 to 0.50 of path tracing's relative L2 "
        "(worst 11.2 and 1.12), which is below the kernel on z itself.",
    ),
    Claim(
        "section 5, time",
        "135 ms of overhead at 1280x720 on a GeForce RTX 3090",
        where=(_ERROR, _WINDOWS),
        measured=(_ERROR, _WINDOWS),
        note="Selecting and combining take 0.07 s at 192x192 on two busy cores, Open "
        "Image Denoise 0.21 s; no graphics card was at hand. Selecting takes 7 times "
        "as long as combining; every row judged, as in the paper, 2.5 times longer.",
    ),
    Claim(
        "section 5, inputs",
        "y by independent numbers, z by common random numbers, five scenes in Mitsuba",
        where=("rendering.Settings", "experiments.uncorrelated.correlation"),
        measured=("experiments.uncorrelated.correlation",),
        note="`numbers=` is independent or common, also in tiles. The variance of "
        "neighbours' difference under common numbers is 0.01 to 0.41 of the sum of "
        "both variances in the median of pixels, but 0.14 to 0.89 over whole frames, "
        "where the noisiest decide. The paper's five scenes are not here.",
    ),
)


def run(options: Options) -> tuple[Claim, ...]:
    """Return all claims.

    Args:
        options: of no effect.

    Returns:
        the claims.
    """
    del options
    return CLAIMS


if __name__ == "__main__":
    main(Options, run, report)
