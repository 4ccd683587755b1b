"""What of uncorrelated kernels is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

_NOT_YET = "Not measured yet: the experiment's results do not stand here."
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
        note="Any B of at least one; `combine` needs two.",
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
        note="`guides`; of both, one constant for z and another for y. Unbiased in "
        "tests under symmetric noise. Their errors: experiments.uncorrelated.error. "
        + _NOT_YET,
    ),
    Claim(
        "section 4.1, consistency",
        "the differences' distribution becomes normal as samples grow, so the bias "
        "vanishes",
        where=("uncorrelated.combine",),
        note="A test. The squared bias falls faster than the variance only where every "
        "sub-average has sampled the tail of the noise.",
    ),
    Claim(
        "eq. 8",
        "k = exp(-gamma n (D_ci z^1 - D_ci z^2)^2) / N, B = 2, windows of 15x15",
        where=("uncorrelated.variance_kernel", "uncorrelated.combine"),
        note="For more sub-averages the square is the mean over all pairs; of two it "
        "is the paper's. Ours beside it: `median_kernel`, `combine_median`.",
    ),
    Claim(
        "section 4.2, gamma",
        "of ten candidates from 0.01 to 2.5 the one with the least relative variance, "
        "estimated from four pairs, the first two against the other two",
        where=("uncorrelated.select_gamma", "uncorrelated.PAPER_MULTIPLES"),
        note="By default four smaller candidates from 0.0005 are added, pairs 1, 3 "
        "stand against 2, 4 (the same in distribution), and every fourth row is "
        "judged (`stride=1` for all). `select_gamma_map` chooses by region, ours.",
    ),
    Claim(
        "fig. 1",
        "a frame and a close-up: the kernel keeps edges; relative L2",
        where=("experiments.uncorrelated.error",),
        note=_NOT_YET + " Not shown as images.",
    ),
    Claim(
        "fig. 2",
        "the uniform kernel leaves the structured noise of common random numbers, the "
        "input-dependent one lowers it",
        where=("uncorrelated.combine_uniform", "experiments.uncorrelated.error"),
        note=_NOT_YET + " Not shown as images.",
    ),
    Claim(
        "fig. 3",
        "Pearson's median skewness of 600 images of 128 samples: that of differences "
        "is 3.6 times less than that of pixels",
        where=("experiments.uncorrelated.bias",),
        note="Ours has 300 realisations of four sub-averages of 16 samples by default, "
        "at 96x96. " + _NOT_YET,
    ),
    Claim(
        "fig. 4",
        "squared bias over 300 realisations: 21 times below the deep combiner's",
        where=("experiments.uncorrelated.bias",),
        note=_NO_COMBINER + " Open Image Denoise, the bilateral filter and James-Stein "
        "stand in its place, which is another comparison. " + _NOT_YET,
    ),
    Claim(
        "section 5, cross-weighting",
        "the kernel of pairs 1, 2 applied to pairs 3, 4 and the other way round, "
        "averaged: unbiased",
        where=("uncorrelated.combine_crosswise",),
        note="gamma by the same rule, `select_gamma(crosswise=True)`.",
    ),
    Claim(
        "section 5, L2 reconstruction",
        "z by L2 reconstruction depends on y; so y^1, y^2 are combined with z^3, z^4 "
        "and the other way round, and both averaged",
        where=("uncorrelated.combine_decorrelated", "numerics.poisson.reconstruct"),
        note="The screened Poisson equation is solved by cosine transforms.",
    ),
    Claim(
        "fig. 5",
        "beside the uniform and the cross-weighted kernel: both leave noise that the "
        "input-dependent one removes",
        where=("experiments.uncorrelated.error", "experiments.uncorrelated.bias"),
        note=_NOT_YET,
    ),
    Claim(
        "fig. 6",
        "beside the deep combiner: its relative L2 is 1.9 to 3.6 times less, its "
        "squared bias 18.2 to 39.3 times more",
        note=_NO_COMBINER + " Relative L2 and squared bias of ours beside Open Image "
        "Denoise: experiments.uncorrelated.error and bias, not measured yet.",
    ),
    Claim(
        "section 5, AFGSA",
        "beside a recent biased denoiser at equal total samples",
        where=("experiments.uncorrelated.error",),
        note="AFGSA is not here. The experiment gives Open Image Denoise the same "
        "total of samples. " + _NOT_YET,
    ),
    Claim(
        "section 5, gradient-domain rendering",
        "the kernel improves the unbiased L2 reconstruction of gradient-domain path "
        "tracing",
        where=("experiments.uncorrelated.error", "experiments.uncorrelated.bias"),
        note="Gradients are differences of pixels under common random numbers, not by "
        "shift mapping. " + _NOT_YET,
    ),
    Claim(
        "section 5, time",
        "135 ms of overhead at 1280x720 on a GeForce RTX 3090",
        where=("experiments.uncorrelated.error",),
        note="The experiment times selecting and combining beside the exponentials "
        "that they take. " + _NOT_YET,
    ),
    Claim(
        "section 5, inputs",
        "y by independent numbers, z by common random numbers, five scenes in Mitsuba",
        where=("rendering.Settings", "experiments.uncorrelated.correlation"),
        note="`numbers=` is independent or common, also in tiles. How alike the noise "
        "of neighbours is under each: experiments.uncorrelated.correlation. "
        + _NOT_YET,
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
