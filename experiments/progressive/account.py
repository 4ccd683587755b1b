"""What of progressive denoising is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

_LEARNED = "experiments.training.learned"
_SURE = "experiments.progressive.sure"
_SAMPLES = "experiments.progressive.progressive"

CLAIMS = (
    Claim(
        "eq. 1",
        "SURE: the mean squared error of a denoised image without the truth, for "
        "normal noise of known covariance",
        where=("numerics.sure.monte_carlo_sure", "numerics.sure.exact_sure"),
        measured=("experiments.oidn.sure", _SURE),
        note="An estimate for each element. Where the noise is normal and known it is "
        "1.00 of Open Image Denoise's error at 1, 5 and 20 % noise. Of rendered frames "
        "its mean is within 25 % of the error in 12 of 20: their noise has heavy "
        "tails and an estimated variance.",
    ),
    Claim(
        "eq. 2",
        "the trace by K random vectors and a difference of step 1e-4, K of 1 or 4",
        where=("numerics.sure.monte_carlo_sure",),
        measured=("experiments.oidn.sure", _SURE),
        note="Ours takes one exact forward derivative a probe, by default of random "
        "signs (`probe='gaussian'` is the paper's). In float32 a step of 1e-4 is off "
        "by 0.102 for a bilateral filter; for Open Image Denoise a step of 0.0003 is "
        "right, one of 0.03 gives 0.84 of the error at 5 % noise.",
    ),
    Claim(
        "fig. 2",
        "RMSE and SMAPE against samples, true and estimated: the denoised image is "
        "better at few samples, the rendering in the end; SURE is accurate",
        where=(_SAMPLES, "metrics.rmse", "metrics.smape"),
        measured=(
            "experiments.progressive.progressive",
            "experiments.comparison.forms",
        ),
        note="In relative L2, on a Cornell box with glass, 8 to 2048 samples: the "
        "estimate of the error of the rendering is right within a factor of 1.03, of "
        "the denoised image within 2.3. At 2048 the rendering still has 0.0379, the "
        "denoised image 0.00835. RMSE, SMAPE and FLIP of path tracing, denoised image "
        "and mix are not drawn against samples; their ratios are at table 3.",
    ),
    Claim(
        "fig. 3",
        "maps of SURE and of the squared error: single pixels are noise, local means "
        "agree",
        where=("numerics.sure.pooled",),
        measured=("experiments.oidn.variants",),
        note="As a number in place of maps: over blocks of 7x7 pixels SURE has a mean "
        "rank correlation of 0.34 with the true squared error; the variance over eight "
        "turns of the denoiser has 0.79.",
    ),
    Claim(
        "eq. 3, 4",
        "a mixing at each pixel that minimises a loss, with z to the truth as samples "
        "grow",
        where=("progressive.combine",),
        note="The limit is a test of the bound, for a biased denoiser.",
    ),
    Claim(
        "eq. 5-8",
        "the expected squared error of a mix, by Stein's lemma without the truth",
        where=("progressive.risk",),
        note="Unbiased for a mixing that does not follow the noise, as a test shows.",
    ),
    Claim(
        "eq. 9, 10",
        "the mixing of least error, alpha and beta; not used, since single pixels are "
        "too noisy",
        where=("progressive.mixing",),
        measured=(_SURE,),
        note="Summed over windows, which the paper does not do, it works without a "
        "network: relative L2 over Open Image Denoise's, 20 frames, 1.07 as it is and "
        "0.90 whitened in 7x7 windows (worst 1.52 and 1.06).",
    ),
    Claim(
        "eq. 11",
        "z = x + alpha (y - x) with a network's alpha",
        where=("progressive.neural_combine", "progressive.combine_inputs"),
        measured=(_LEARNED,),
        note="Written as a blend, so that 0 and 1 are exact.",
    ),
    Claim(
        "eq. 12, 14",
        "weighted sums over 11x11 pixels of x and of the mix, each with the pixel of "
        "largest variance added",
        where=("progressive.bound_mixing",),
        note="Only their difference is computed, of the channels' means.",
    ),
    Claim(
        "eq. 13",
        "the variance of that sum of x",
        where=("progressive.bound_mixing", "progressive.channel_variance"),
        measured=("experiments.comparison.forms",),
        note="The paper takes the noise of channels as independent; grey noise has up "
        "to three times that variance. Functions of frames estimate the factor from "
        "the halves; without `noise` it is that of the paper. On 29 test frames pd "
        "has 0.971 of the better input with the estimate and 0.983 with that of the "
        "paper; without the bound 0.971.",
    ),
    Claim(
        "eq. 15",
        "Gaussian weights, of width 100 min(sqrt(Var[x-]), 1), x- the image mean",
        where=("progressive.bound_sigma",),
        note="'Image mean' has two readings: `width='absolute'`, by the mean of the "
        "pixels' variances, and 'image mean', by the variance of the mean of all. The "
        "default is the first relative to the mean radiance, so in any unit. At least "
        "0.001 pixels. Errors by reading were not measured.",
    ),
    Claim(
        "eq. 16",
        "the pixel of largest variance in the window",
        where=("progressive.bound_mixing",),
    ),
    Claim(
        "eq. 17",
        "the t-statistic of both sums",
        where=("progressive.bound_mixing",),
        note="No epsilon: where there is no variance a change counts as certain, so "
        "that scaling the image changes nothing.",
    ),
    Claim(
        "eq. 18",
        "alpha' = (1 - S[a (abs(t) - c)]) alpha, S the normal distribution, a = 2, "
        "c = 4.2",
        where=("progressive.bound_mixing",),
        measured=(_SURE,),
        note="Consistent by a test. At 16 to 1024 samples it costs a little: the "
        "whitened mix has 0.915 of the denoised error with it, 0.904 without; the "
        "denoised image alone 0.974, worst 1.14 (channels as independent).",
    ),
    Claim(
        "fig. 4",
        "the scaling of alpha as a function of t",
        where=("progressive.bound_mixing",),
        note="Not plotted; the example of the function has three of its values.",
    ),
    Claim(
        "fig. 5",
        "maps of alpha' for two scenes",
        where=("progressive.bound_mixing",),
        note="Not drawn as maps; the default bound changes the error of pd by less "
        "than 1 in 1000 (experiments.comparison.forms). Which pixels the mix makes "
        "better or worse is in experiments.comparison.pixels.",
    ),
    Claim(
        "section 4.3, fig. 6",
        "six convolutions of 48 features, two residual blocks; x, y, VAR, SURE, "
        "sigma^2 f' and (y - x)^2 as inputs, the last four by arctan; x, VAR and y, "
        "SURE exchanged at random",
        where=("learning.networks.MixingNetwork", "learning.recipes.exchanged"),
        measured=(_LEARNED,),
        note="Twice sigma^2 f'; x and y by a logarithm. Exchanged inputs are among the "
        "variants of each frame that training draws from.",
    ),
    Claim(
        "eq. 19",
        "alpha = (xi_1 - xi_2) / max(xi_3, 1e-6)",
        where=("progressive.activation", "learning.recipes.RECIPES"),
        note="Clipped to [0, 1], but not in training, where clipped pixels have no "
        "derivative. The network that ships does not have this form: its alpha is a "
        "logistic function of one output (`direct_activation`).",
    ),
    Claim(
        "section 5.1",
        "U-Net denoisers trained on colour, albedo, normal and variance",
        where=("denoisers.oidn.VARIANTS", "denoisers.kernel_predicting.denoise"),
        note="Not trained here: Open Image Denoise's own weights, with derivatives, "
        "take their place. One kernel-predicting network is trained in "
        "experiments.training.joint, for another combiner.",
    ),
    Claim(
        "section 5.2, fig. 7, 8",
        "1348 crops of pbrt scenes and of random ones, 2 to 4096 samples; ten test "
        "scenes, 32 to 8192 samples",
        where=("experiments.data.dataset",),
        note="Views of real and of random scenes in Mitsuba 3, split by scene. The "
        "shipped network learned from 263 frames; the test split has 35, 4 to 4096 "
        "samples.",
    ),
    Claim(
        "section 5.3",
        "batches of 12, SMAPE, one cycle with a peak of 2e-5; 2500 epochs",
        where=("learning.training.Schedule", "experiments.training.ablations"),
        note="What ships was trained for 5000 steps of 8 crops at a peak of 1e-3 with "
        "relative L2; its card says so. `pd-smape` is the paper's loss and form.",
    ),
    Claim(
        "table 1",
        "over U-Nets of four input sets the mix lowers RMSE, SMAPE and FLIP: with "
        "colour alone 0.1964 to 0.0784, with all inputs 0.0971 to 0.0536 (RMSE)",
        note="Needs denoisers trained on each input set, which are not here.",
    ),
    Claim(
        "table 2",
        "over a kernel-predicting denoiser: RMSE 0.1342 to 0.0640, SMAPE 0.0362 to "
        "0.0285, FLIP 0.0990 to 0.0788",
        where=("progressive.neural_combine_frame", "learning.networks.KernelPredictor"),
        note="The parts are here; the mix takes any denoiser with derivatives. Not "
        "measured together.",
    ),
    Claim(
        "table 3",
        "over Open Image Denoise: RMSE 0.0499 to 0.0394 by colour alone, 0.0586 to "
        "0.0489 with features; SMAPE and FLIP fall as well",
        where=("progressive.neural_combine_frame", "metrics.flip"),
        measured=(
            "experiments.training.learned",
            "experiments.oidn.variants",
            "experiments.comparison.tiers",
            "experiments.comparison.forms",
        ),
        note="Over Open Image Denoise with features, 29 test frames, geometric mean "
        "of ratios (worst): RMSE 0.987 (1.65), SMAPE 1.04 (1.63), FLIP 1.02 (1.47); "
        "by colour alone 0.978, 1.03, 1.01. Of frames RMSE falls in 21, FLIP in 18, "
        "SMAPE in 15. The paper has 0.83 in RMSE, and all fall: what ships is trained "
        "on relative L2, of few scenes; it loses at 4 and 16 samples (relative L2 "
        "1.14, 1.11) and gains from 64 on (0.963 to 0.827). Development frames 0.765 "
        "of the better input (worst 11.5).",
    ),
    Claim(
        "fig. 1, 9, 10",
        "close-ups: details that denoising blurs come back",
        where=("experiments.comparison.page",),
        note="The page shows such images, of our scenes; it is not kept here.",
    ),
    Claim(
        "section 6, deep combiner",
        "better than the mix at few samples, but its error exceeds the rendering's at "
        "many",
        note="The deep combiner is not here: it is another paper's network, with its "
        "own weights and training.",
    ),
    Claim(
        "fig. 11",
        "RMSE against samples up to 8192: the mix converges with the rendering, the "
        "denoised image and the deep combiner do not",
        where=("experiments.progressive.consistency",),
        measured=("experiments.progressive.consistency",),
        note="One scene of 64x64 pixels. From 4 to 16384 samples the mix has at most "
        "0.53 times path tracing's relative L2, with the paper's bound 0.55, without "
        "any 0.53; the denoised image ends at 0.98.",
    ),
    Claim(
        "table 4",
        "RMSE rises where SURE, the quotient of eq. 19 or the bound is left out",
        where=("experiments.training.ablations",),
        measured=("experiments.comparison.forms",),
        note="The bound, which needs no training: relative L2 over the better input "
        "of 29 test frames 0.971 with it, 0.983 as the paper has it, 0.971 without, "
        "so that it costs little and wins nothing up to 4096 samples, where the paper "
        "has a gain in RMSE. SURE and the quotient are `pd-no-sure` and "
        "`pd-quotient`, networks to train, not measured. What ships is the form "
        "without the quotient.",
    ),
    Claim(
        "section 6.1, time",
        "seconds of the method on a GeForce RTX 3090",
        measured=(_SURE,),
        where=("experiments.progressive.sure",),
        note="On two CPU cores, estimating Open Image Denoise's error with one probe "
        "takes 2.5 times the time of denoising, with four 7.1, by a difference 2.2 and "
        "5.2. Of the whole method not measured.",
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
