"""What of ensemble denoising is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

_MEMBERS = "experiments.comparison.members"
_TIERS = "experiments.comparison.tiers"
_LEARNED = "experiments.training.learned"
_DEPENDENCE = "experiments.ensemble.dependence"
_SUBSETS = "experiments.ensemble.subsets"
_SOLVERS = "experiments.ensemble.solvers"
_TRUTH = "experiments.ensemble.truth"
_WEIGHTS = "experiments.ensemble.weights"

EQUATIONS = (
    Claim(
        "eq. 1, 2",
        "a base denoiser is a function of the noisy image and the features",
        where=("frame.Estimate", "methods.METHODS"),
        note="An estimate is the image with the same made from each half; any program "
        "can make one.",
    ),
    Claim(
        "eq. 3, 4",
        "the ensemble: at each pixel a sum of the bases with weights of sum one",
        where=("ensemble.average",),
        note="At a pixel where a base is not finite, the first that is.",
    ),
    Claim(
        "eq. 5, 6",
        "weights of least mean squared error: the minimum of w'Mw",
        where=("numerics.simplex.quadratic", "numerics.simplex.affine"),
    ),
    Claim(
        "eq. 7, 8",
        "M_ij = E[(y_i - mu) (y_j - mu)] and its expansion",
        where=("ensemble.true_matrix",),
        note="From many renderings and the true image.",
    ),
    Claim(
        "eq. 9, 10",
        "halves are independent, and taken as uncorrelated after denoising",
        where=("frame.with_halves", _DEPENDENCE),
        measured=(_DEPENDENCE,),
        note="Each half is denoised alone. An estimate that shares what it learned "
        "from both halves violates it: an ensemble with shared weights looks better "
        "than it is by 0.02 of the denoiser's error (worst 0.17), one whose halves "
        "have weights of their own looks worse by 0.01 (mean of 20 frames).",
    ),
    Claim(
        "eq. 11, 12",
        "`<M>` of each half with the other half's x for the truth, and their mean",
        where=("ensemble.mse_matrix",),
    ),
    Claim(
        "eq. 13",
        "minimise w'`<M>`w with weights of sum one, none below zero",
        where=("ensemble.solve_weights", "numerics.simplex.quadratic"),
        note="The paper's, of single pixels and channels, is `solver='hull'`. The "
        "default, 'multi-scale', averages `<M>` over windows and the frame; ours.",
    ),
    Claim(
        "eq. 14",
        "the same objective without a matrix",
        where=("numerics.simplex.hull",),
        note="Solved as the point of a convex hull nearest to (x_b, x_a), exactly. The "
        "paper prints 2 x^A x^B for x^A x^B, which changes no weight.",
    ),
    Claim(
        "eq. 15, 16",
        "M of halves; `<M>` is unbiased for it",
        where=("ensemble.true_matrix", "ensemble.mse_matrix"),
        note="A test of 400 renderings, by standard errors.",
    ),
    Claim(
        "eq. 17-19",
        "optimal weights of either sign: M^+ 1 / 1'M^+ 1",
        where=("numerics.simplex.affine",),
        note="With a ridge in place of the pseudo-inverse, which takes the wrong limit "
        "where a combination without error exists; weights are limited to about 1000.",
    ),
    Claim(
        "eq. 20, 21",
        "with the true M the ensemble has no more error than any base",
        where=("numerics.simplex.affine", "numerics.simplex.quadratic"),
        note="Tests: of `affine` on `<M>` of single pixels, of `quadratic` with the "
        "true M of many renderings.",
    ),
    Claim(
        "eq. 22-26",
        "the ensemble is consistent if one base is, also with estimated `<M>`",
        where=("ensemble.combine",),
        note="A test for both solvers, with x as a base; without it nothing makes an "
        "ensemble of biased bases consistent. Eq. 24 and 25 print a factor 2 before "
        "(x^A - x^B)^2 that eq. 27 does not have.",
    ),
    Claim(
        "eq. 27-29",
        "of two bases in closed form, clipped to [0, 1]",
        where=("numerics.simplex.two",),
        note="One half where both bases are equal.",
    ),
    Claim(
        "eq. 30, 31",
        "the iterative solver: random start, cycles in random order, at most 1024 "
        "steps",
        where=("numerics.simplex.iterative",),
        note="For comparison. All pixels share one order; stops after three cycles "
        "without change. Not exact where three or more bases mix.",
    ),
    Claim(
        "eq. 32",
        "a cross-bilateral filter of the weights: radius 7, sigma 3, 2, 0.25 (albedo) "
        "and 0.15 (normal)",
        where=("ensemble.filter_weights",),
    ),
    Claim(
        "eq. 33",
        "colour distance relative to both variances, Var[z] = (z^A - z^B)^2 / 2",
        where=("ensemble.filter_weights", "ensemble.combine"),
        note="Summed over channels. A blurred variance, clipped weights and "
        "standardised normals, as in the authors' program, are options of `Filter`.",
    ),
    Claim(
        "eq. 34, 35",
        "filtered weights, and the final ensemble with them",
        where=("ensemble.filter_weights", "ensemble.combine"),
        note="`filter=True`; off by default, where weights are multi-scale.",
    ),
    Claim(
        "eq. 36, 37",
        "the error of a base from halves, less both variances, to select one a pixel",
        where=("ensemble.selection_errors", "ensemble.one_hot"),
        note="Var[y_i] is a quarter of the halves' squared difference. Unbiased by a "
        "test.",
    ),
)

FIGURES = (
    Claim(
        "fig. 1",
        "close-ups of KPCN, NFOR, MCGAN and RDFC combined; relMSE against samples",
        where=(_TIERS,),
        measured=(_TIERS,),
        note="Other bases and multi-scale weights; no close-ups. Relative L2 over the "
        "better of path tracing and OIDN: 0.517 (`balanced`) and 0.420 (`best`), "
        "geometric means of 46 frames, 16 to 4096 samples.",
    ),
    Claim(
        "fig. 2",
        "the pipeline: bases of full frame and halves, weights, filter, ensemble",
        where=("ensemble.combine", "ensemble.combine_frame"),
        note="`solver='hull', filter=True` is the paper's.",
    ),
    Claim(
        "fig. 3, section 5.1",
        "30 scenes in Tungsten, references of at least 32768 samples; eight bases: "
        "KPCN, MCGAN, NFOR, OIDN, OptiX, RDFC and deep combiner forms of two",
        where=(
            "experiments.data.development",
            "denoisers.nfor",
            "denoisers.rdfc",
            "denoisers.oidn",
            "denoisers.kernel_predicting",
        ),
        note="Eleven scenes in Mitsuba 3. MCGAN, OptiX and the deep combiner are not "
        "here. RDFC is one filter, or three selected by SURE (`denoise_selected`).",
    ),
    Claim(
        "section 5.1, time",
        "about one second for the solver, tens of milliseconds for the filter on a GPU",
        where=(_SOLVERS,),
        measured=(_SOLVERS,),
        note="On two CPU cores, a megapixel of four bases: the exact solver 0.15 s, "
        "the paper's in JAX 5.1 s (1024 steps), multi-scale weights 0.10 s, the filter "
        "0.45 s, 11 times its exponentials. Not measured on a GPU.",
    ),
    Claim(
        "fig. 4",
        "without the limit at zero, pixels' weights turn into fireflies",
        where=("numerics.simplex.affine", _WEIGHTS),
        measured=(_WEIGHTS,),
        note="29 frames of five scenes, 4 to 4096 samples, six bases: weights of "
        "single pixels of either sign have 88 times the relative L2 of those of "
        "at least zero (56 times filtered) and 2.6 times the DSSIM; 1.2 % of the "
        "pixels are fireflies, 0.007 % with weights of at least zero, 1.5 % of "
        "the noisy image.",
    ),
    Claim(
        "fig. 5",
        "weights of the iterative and of a general solver look alike",
        where=(_SOLVERS, "numerics.simplex.reference"),
        measured=(_SOLVERS, _WEIGHTS),
        note="With jaxopt's OSQP in place of FBstab. Above the least objective, over "
        "the worst base's, four bases: the paper's solver 2e-3 at most, 2e-5 in "
        "the mean, OSQP 5e-10. Images by both have equal errors: 1.00 of "
        "relative L2 and DSSIM over the exact solver's, 29 frames.",
    ),
    Claim(
        "fig. 6",
        "the iterative solver is about ten times as fast as the general one",
        where=(_SOLVERS,),
        measured=(_SOLVERS,),
        note="41 to 111 times as fast as OSQP with two to eight bases (3.2 to 18 s and "
        "131 to 1560 s a megapixel): OSQP in float64, to a tight tolerance, is no fast "
        "general solver. The exact solver takes 0.01 to 0.64 s: with four bases a "
        "35th of the paper's.",
    ),
    Claim(
        "fig. 7",
        "weights of each channel have slightly less error than shared ones",
        where=("ensemble.solve_weights", _WEIGHTS),
        measured=(_WEIGHTS,),
        note="29 frames of five scenes, 4 to 4096 samples, six bases: of each channel "
        "over shared 0.999 filtered (less in a third of the frames), 1.01 "
        "unfiltered (less in a quarter), 0.995 multi-scale (less in three "
        "quarters). The paper's finding holds for our weights, and hardly for "
        "its own. `hull` has each channel's; multi-scale weights are shared "
        "unless `shared=False`.",
    ),
    Claim(
        "fig. 8",
        "filtered weights remove noise and artifacts at edges",
        where=("ensemble.filter_weights", _WEIGHTS),
        measured=(_WEIGHTS,),
        note="29 frames of five scenes, 4 to 4096 samples, six bases: filtered over "
        "unfiltered weights 0.90 of relative L2 (less in 83 %), 0.86 of DSSIM "
        "(less in all). With the authors' program's blur, clip and standardised "
        "normals 0.95 and 0.97 of the paper's filter; standardised normals by "
        "themselves make it worse (1.02). Multi-scale weights gain nothing from "
        "it.",
    ),
    Claim(
        "fig. 9",
        "the plain average has more error than the ensemble at all samples",
        where=(_WEIGHTS, _TIERS),
        measured=(_WEIGHTS, _TIERS),
        note="29 frames of five scenes, 4 to 4096 samples, six bases: the paper's "
        "ensemble has 0.95 of the average's relative L2 (less in 45 %) and 1.06 "
        "of its DSSIM (less in 28 %): contrary to the paper; multi-scale weights "
        "have 0.58 and 0.91. With the bases of `best` equal weights have 4.23 "
        "times the error of multi-scale ones (worst 327): path tracing is among "
        "these bases, so the average keeps its noise.",
    ),
    Claim(
        "fig. 10",
        "one-hot selection, errors filtered before or selection after: seams; the "
        "ensemble has the least relMSE",
        where=("ensemble.combine", _WEIGHTS),
        measured=(_WEIGHTS,),
        note="29 frames of five scenes, 4 to 4096 samples, six bases: the ensemble's "
        "relative L2 over that with errors filtered before, cross-bilateral and "
        "by non-local means, and with the selection filtered after: 1.00, 0.90 "
        "and 0.96; DSSIM 0.97, 0.93 and 0.99. One base of each 31x31 window "
        "beats all these: 0.97 of the best base's error, the paper's ensemble "
        "1.43, multi-scale weights 0.88.",
    ),
    Claim(
        "table 1",
        "the ensemble beats both one-hot forms that filter before in 74.9 % of cases",
        where=(_WEIGHTS, _SUBSETS),
        measured=(_SUBSETS, _WEIGHTS),
        note="29 frames, 57 subsets of six bases, 4 to 4096 samples: in 68.7 % of "
        "1653 cases (by DSSIM 79.9 %), hardly more with more bases; with multi- "
        "scale weights in 82.7 % (94.9 %), of six bases in all.",
    ),
    Claim(
        "table 2",
        "the ensemble beats the one-hot form that filters after in 72.3 % of cases",
        where=(_WEIGHTS, _SUBSETS),
        measured=(_SUBSETS, _WEIGHTS),
        note="29 frames, 57 subsets of six bases, 4 to 4096 samples: in 93.9 % of the "
        "cases (by DSSIM 97.8 %): more than in the paper; multi-scale weights in "
        "84.2 %, of five or six bases in 99 %.",
    ),
    Claim(
        "fig. 11",
        "weights by the true M, of full frames and of halves, one-hot and of either "
        "sign, beside estimated ones: 1024 renderings of 256 samples",
        where=(_TRUTH, "ensemble.true_matrix"),
        measured=(_TRUTH,),
        note="32 renderings of 64 samples of three scenes, 96 pixels wide, over the "
        "best base: by the true M 0.40 to 0.45 of its relative L2, of halves 0.41 to "
        "0.48, one-hot 0.48 to 0.61, of either sign 0.38 to 0.52. Of one rendering's "
        "halves: the paper's weights 0.97 to 1.80, of either sign 9.3 to 424, "
        "multi-scale 0.70 to 0.84.",
    ),
    Claim(
        "section 5.3.1",
        "39 candidates: 8 bases and 31 of their 247 combinations",
        where=(_SUBSETS, _MEMBERS, "ensemble.select_bases"),
        measured=(_SUBSETS, _MEMBERS),
        note="As many kinds: all 57 subsets of six bases. Members of the tiers were "
        "chosen one after the other among 17 estimates, each time without the "
        "scene that is judged. `select_bases` decides by a frame's own halves; "
        "ours.",
    ),
    Claim(
        "section 5.3.2",
        "relMSE in linear radiance, DSSIM after ACES and sRGB",
        where=("metrics.rel_l2", "metrics.dssim", "metrics.tone_map"),
        measured=(_WEIGHTS, _TIERS),
        note="Relative L2 divides by the square of the channels' mean. Results here "
        "are relative L2, DSSIM (experiments.ensemble.weights) and FLIP (tiers).",
    ),
    Claim(
        "fig. 12",
        "at 4 samples `<M>` is too noisy, and the ensemble may fail",
        where=("ensemble.error_matrix", _WEIGHTS),
        measured=(_WEIGHTS, _LEARNED),
        note="29 frames of five scenes, 4 to 4096 samples, six bases: the paper's "
        "weights have 1.93 of the best base's error at 4 samples and 1.50 at 16, "
        "multi-scale ones 0.99 and 0.94, and never more than 1.20: with few "
        "samples they tend to one weight a base.",
    ),
    Claim(
        "fig. 13",
        "error curves of six scenes: ensembles are mostly below their bases",
        where=(_TIERS, _WEIGHTS),
        measured=(_TIERS, _WEIGHTS, _SUBSETS),
        note="By tables. Over the best of its own members `balanced` has 0.846 (worst "
        "1.11), `best` 0.791 (worst 1.17): rarely worse, not never. 29 frames of "
        "five scenes, 4 to 4096 samples, six bases: the paper's weights of "
        "single pixels are below the best base in 28 % of the frames (1.43 in "
        "the mean, 9.78 at worst), multi-scale ones in 72 % (0.88, 1.20). "
        "Constants of ours were set on three of the scenes, on other renderings.",
    ),
    Claim(
        "fig. 14",
        "scores by rank, averaged over scenes and samples, by relMSE and DSSIM",
        where=(_SUBSETS,),
        measured=(_SUBSETS,),
        note="29 frames, 57 subsets of six bases, 4 to 4096 samples: scores of all by "
        "both measures, which agree: with the paper's weights OIDN with and "
        "without features and NFOR are best (60.6 and 59.7), with multi-scale "
        "weights all six (58.8) and five of them without NLM by DSSIM (58.4).",
    ),
    Claim(
        "table 3",
        "scores grow from 19.2 with two bases to 29.0 with five, and fall to 26.8 "
        "with six",
        where=(_SUBSETS, _MEMBERS),
        measured=(_SUBSETS, _MEMBERS),
        note="29 frames, 57 subsets of six bases, 4 to 4096 samples: the paper's kind "
        "of scores (64 candidates) grow with its weights from 29.9 with two "
        "bases to 38.8 with six in the mean of all subsets; the best subset has "
        "three (60.6): more is not better there, as in the paper; with multi- "
        "scale weights the mean grows from 22.2 to 58.8, and all six are the "
        "best. By error, with multi-scale weights and chosen members: 1.04 of "
        "the better of path tracing and OIDN with these two, 0.517 with six "
        "estimates, 0.409 with eleven.",
    ),
    Claim(
        "section 5.3.4",
        "unlike denoisers gain more together than like ones",
        where=("experiments.oidn.variants", _MEMBERS),
        measured=("experiments.oidn.variants", _MEMBERS),
        note="Of one denoiser's variants and progressive denoising an ensemble has "
        "0.597 of its error, with bilateral and RDFC 0.590 (worst 0.837 and 0.987): "
        "variants gain much, other filters little more. Chosen without the scene, "
        "non-local means and some combiners join in 11 of 11 choices, RDFC and NFOR in "
        "none.",
    ),
    Claim(
        "section 5.3.5, 5.3.6",
        "recommended: KPCN, NFOR, OIDN and RDFC; fewer or others by samples",
        where=("methods.TIERS",),
        note="Not our sets: KPCN has no weights that come with the package. Ours "
        "follow experiments.comparison.members, one for all sample counts.",
    ),
    Claim(
        "fig. 15",
        "close-ups of all bases and ensembles",
        where=("experiments.comparison.page",),
        note="The page shows such images, of our scenes; it is not kept here.",
    ),
)

CLAIMS = EQUATIONS + FIGURES


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
