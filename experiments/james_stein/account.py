"""What of the neural James-Stein combiner is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

_FORMS = "experiments.comparison.forms"
_LEARNED = "experiments.training.learned"
_CONVERGENCE = "experiments.comparison.convergence"
_EQUAL_TIME = "experiments.comparison.equal_time"

CLAIMS = (
    Claim(
        "eq. 1",
        "James-Stein estimate: x shrunk towards any fixed y, p at least 3",
        where=("james_stein.combine",),
        note="Only with the positive part of eq. 2; fewer than three pixels keep x.",
    ),
    Claim(
        "eq. 2",
        "positive part: the share of x - y that is kept is at least zero",
        where=("james_stein.combine",),
        note="As in the paper.",
    ),
    Claim(
        "eq. 3",
        "x of a window: Gaussian about the truth, one variance for all its pixels",
        where=("james_stein.combine",),
        note="An assumption; whiten=True gives each pixel its own variance (ours).",
    ),
    Claim(
        "eq. 4",
        "y of a window: Gaussian about truth plus bias, one variance",
        where=("james_stein.risk_bound",),
        note="Only the bound needs it; the rule knows neither bias nor variance of y.",
    ),
    Claim(
        "eq. 5",
        "eq. 1 in each 15x15 window, each channel by itself",
        where=("james_stein.combine",),
        measured=("experiments.james_stein.error",),
        note="Windows are clipped at the border, and p counts the pixels that are "
        "left. Over the better of path tracing and OIDN, 20 frames: 0.949; whitened "
        "(ours, 7x7) 0.904.",
    ),
    Claim(
        "eq. 6",
        "variance of a window: mean of sample variances with predicted weights",
        where=("james_stein.smooth_variance", "learning.networks.JamesSteinNetwork"),
        measured=(_LEARNED,),
        note="The network adds 1e-4 to its weights. The one that ships is trained for "
        "the whitened 7x7 rule, whose variance is the greater of a pixel's own and "
        "this mean.",
    ),
    Claim(
        "eq. 7",
        "a pixel is the mean over all windows that contain it",
        where=("james_stein.combine",),
        measured=("experiments.james_stein.error",),
        note="x and y leave the sum, so that only the shares are averaged: equal but "
        "for rounding.",
    ),
    Claim(
        "eq. 8",
        "expected squared error of a window: p s2 - (p-2)^2 s2^2 / S, S the sum of "
        "(x-y)^2",
        where=("james_stein.risk",),
        note="The paper prints no expectation on the right, its appendix does: we "
        "return the term inside, whose mean is the error. Where the positive part "
        "cuts in it is S - p s2.",
    ),
    Claim(
        "eq. 9",
        "upper bound of that error, by bias and variance of y; below p s2",
        where=("james_stein.risk_bound",),
        note="Needs bias and variance of y, which a renderer does not know. A test "
        "holds both the bound and its value.",
    ),
    Claim(
        "eq. 10",
        "weighted linear fit of x_a to features of half b, 51x51, epsilon 0.01",
        where=("james_stein.cross_regression", "numerics.regression.local_linear"),
        measured=("experiments.james_stein.regression",),
        note="Features are divided by their largest difference from the centre plus "
        "0.1, with a ridge of 0.1 on the slopes alone. kappa is a median over pixels: "
        "the paper's mean (guide_noise with robust=False) is dominated by lamps: "
        "cornell-box, OIDN, 64 samples: y* has 0.127 in place of 0.00280.",
    ),
    Claim(
        "eq. 11",
        "a pixel's y^_a: weighted mean of the predictions of all windows",
        where=("james_stein.cross_regression",),
        measured=("experiments.james_stein.regression",),
        note="Where the weights are small a pixel fades to y, in place of no rule in "
        "the paper. A stride of 2 takes 0.42 of the time for 1.011 times the error.",
    ),
    Claim(
        "eq. 12",
        "y* = alpha y^_a + (1-alpha) y^_b, alpha predicted",
        where=("james_stein.neural_combine", "james_stein.regress"),
        measured=(_LEARNED,),
        note="Without a network alpha is 1/2.",
    ),
    Claim(
        "eq. 13",
        "final estimate: eq. 7 with the positive part, towards y*",
        where=("james_stein.combine", "james_stein.neural_combine_frame"),
        measured=(_LEARNED,),
        note="On frames y* stands for y only where the halves show that it helps "
        "(james_stein.worth_regressing, ours).",
    ),
    Claim(
        "eq. 14",
        "loss: relative squared error of signed logarithms, epsilon 0.01",
        where=("learning.losses.log_l2",),
        note="Mean over channels where the paper has a sum. The network that ships "
        "has relative L2 over halves of the reference, which its noise does not bias; "
        "njs-paper in experiments.training.ablations has this loss, without a result "
        "here.",
    ),
    Claim(
        "appendix A",
        "eq. 8 by Stein's lemma, eq. 9 by Jensen's inequality",
        where=("james_stein.risk", "james_stein.risk_bound"),
        note="Both are tested by standard errors on Gaussian noise; there is no "
        "derivation in the code.",
    ),
    Claim(
        "table 1",
        "notation",
        where=("james_stein",),
        note="The package's docstring has ours.",
    ),
    Claim(
        "section 3",
        "the rule has a lower expected error than x whatever y is, for p >= 3",
        where=("james_stein.combine",),
        measured=(
            "experiments.james_stein.error",
            _LEARNED,
            "experiments.double_shrinkage.photons",
        ),
        note="Tests hold it under Gaussian noise and a y apart from x. Below path "
        "tracing with OIDN: without a network in 20 of 20 frames, with it in 34 of 35 "
        "(worst 1.40 times); with photon mapping both in 29 of 29. No guarantee: "
        "path-traced noise is not Gaussian, a denoised y follows x, and relative L2 "
        "weighs dark pixels more. The whitened form dominates in units of the "
        "variance only.",
    ),
    Claim(
        "section 4.1",
        "consistent: with more samples the variance, and so the shrinkage, vanishes",
        where=("james_stein.combine",),
        measured=("experiments.james_stein.weak_denoisers",),
        note="As the paper argues; a test holds that no variance gives x. At 4096 "
        "samples njs has 0.752 of OIDN's error and 0.530 of the bilateral filter's.",
    ),
    Claim(
        "section 4.2",
        "not surely below y, but the lower y's error the lower the result's, and in "
        "practice below y too",
        where=("james_stein.risk_bound",),
        measured=("experiments.james_stein.error", _LEARNED),
        note="Below OIDN: james-stein in 10 of 20 frames, whitened in 15 (worst "
        "1.00), the trained njs in 23 of 35.",
    ),
    Claim(
        "section 4.3",
        "without a network: a Gaussian of variances and alpha 1/2; better than x, but "
        "not robust to fireflies",
        where=("james_stein.combine_frame", "james_stein.robust_variance"),
        measured=("experiments.james_stein.error", "experiments.comparison.stability"),
        note="The box (method james-stein) has 1.1e8 times the error of the better "
        "input on fireflies of 1e6, whitened with robust variances 1.0, njs 1.1. "
        "Fireflies of which the variance says nothing pass all three.",
    ),
    Claim(
        "section 4.4",
        "U-Net of x, its variance, y^_a, y^_b; 226 outputs; 0.54 million parameters",
        where=("learning.networks.JamesSteinNetwork", "learning.unet.UNet"),
        measured=(_LEARNED,),
        note="Size full has the paper's width, light half of it; light is what ships. "
        "Radiance enters as a signed logarithm. Over the better input 0.967 trained, "
        "0.956 untrained, 0.958 without a network: on these frames, with OIDN, "
        "training gains nothing.",
    ),
    Claim(
        "section 5, training",
        "1284 image sets, 50 epochs, batch 4 of 128x128, Adam 1e-4, eight hours",
        where=("learning.training.Schedule", "experiments.training.train"),
        measured=(_LEARNED,),
        note="Ours: 263 frames, 1500 steps of 8 crops of 64x64, one-cycle Adam to "
        "5e-4, by the network's card; far less. Validation chose the step, as there.",
    ),
    Claim(
        "section 5, overhead",
        "at 1024x1024 on a GPU 0.40 s for regression, 0.02 s for the rest",
        where=("james_stein.cross_regression", "james_stein.combine"),
        measured=(
            "experiments.james_stein.regression",
            "experiments.james_stein.error",
        ),
        note="On 2 CPU cores regression takes 11.4 s a megapixel, 4.82 with a stride "
        "of 2; the rule takes 1.39 times two bare window sums.",
    ),
    Claim(
        "section 5, limitations",
        "single pixels may lose; one variance a window; no use of time",
        where=("james_stein.combine",),
        measured=(
            "experiments.comparison.pixels",
            "experiments.james_stein.lights",
        ),
        note="Tests show pixels that lose. Whitening lifts the second; beside a light "
        "the robust variance is 24 times the squared error of a dark pixel (others "
        "1.9), which has 0.84 of the error of OIDN (others 0.99). Frames of a "
        "sequence are combined one by one.",
    ),
    Claim(
        "fig. 1",
        "KPCN and AFGSA with and without, 16 to 2K samples: denoisers fall behind "
        "path tracing, combined they do not",
        where=(_CONVERGENCE,),
        measured=("experiments.james_stein.weak_denoisers",),
        note="KPCN and AFGSA are not here. With OIDN njs has 1.04, 0.934, 0.953, "
        "0.659, 0.797, 0.752 of the denoiser at 4 to 4096 samples; path tracing has "
        "1.85 times it at the end, so that there is less to gain than in the paper.",
    ),
    Claim(
        "fig. 2",
        "MSE-based mixing (PD) against ours: KPCN 0.0021 becomes 0.0036 and 0.0013, "
        "AFGSA 0.0088 becomes 0.0103 and 0.0054",
        where=("progressive.combine_frame", "james_stein.combine_frame"),
        measured=(_LEARNED,),
        note="With OIDN the trained pd has 0.910 of the better input (worst 2.25), "
        "njs 0.967 (1.41): PD gains more in the mean and harms more at worst.",
    ),
    Claim(
        "fig. 3",
        "overview of inputs, network and combiner",
        where=("james_stein.neural_combine",),
        note="As drawn, but for the notes at eq. 6, 13 and section 4.4.",
    ),
    Claim(
        "fig. 4",
        "denoisers no better than path tracing: 0.0095 and 0.0143 become 0.0053, "
        "0.0142 and 0.0144 become 0.0046",
        where=("james_stein.combine_frame",),
        measured=("experiments.james_stein.weak_denoisers",),
        note="Where path tracing comes close to the denoiser (bilateral, 4096 "
        "samples: 1.19 times it) multi-scale (ours) has 0.449 of it, njs 0.530.",
    ),
    Claim(
        "fig. 5",
        "y of a 15x15 box: 0.0062 and 0.0739 become 0.0026, 0.0142 and 0.974 become "
        "0.0065",
        where=("denoisers.smoothing.box", "james_stein.combine"),
        measured=("experiments.comparison.stability", _FORMS),
        note="A box for y, 5.7 times the error of path tracing, 29 test frames: "
        "james-stein is below it in 29 (0.34 of it), whitened 27, njs 29 (0.16). Not "
        "surely: around one caustic james-stein had 1.3 times its error.",
    ),
    Claim(
        "fig. 6",
        "the same from 16 to 2K samples: below path tracing throughout",
        where=(_CONVERGENCE,),
        measured=(_FORMS,),
        note="With a box james-stein is below path tracing in all of 29 test frames, "
        "4 to 4096 samples: 13.3 to 2.01 of the better of OIDN and path tracing, "
        "which has 87.4 to 3.47; njs 5.48 to 1.38.",
    ),
    Claim(
        "fig. 7",
        "y, y* and what each gives: AFGSA 0.0178, y* 0.0097, combined 0.0151 and "
        "0.0088",
        where=("james_stein.cross_regression",),
        measured=("experiments.james_stein.regression",),
        note="y* alone has 1.48 times the error of y with OIDN (better in 9 of 20 "
        "frames), 0.946 with non-local means (11). On frames the halves decide, right "
        "in 16 of 20 with OIDN, to harm in 0. Combined errors: fig. 8.",
    ),
    Claim(
        "fig. 8",
        "combined error with y and with y*, by sample count",
        where=("experiments.comparison.combiners",),
        measured=(_FORMS,),
        note="The contrary with OIDN: njs has 1.57 of the better input towards y*, "
        "0.961 towards y, 0.981 by the choice of the halves (29 test frames). OIDN "
        "sees the features already; the paper has KPCN and AFGSA.",
    ),
    Claim(
        "fig. 9",
        "training images: seven public scenes with other views and materials",
        where=("experiments.data.dataset", "experiments.data.variations"),
        note="Four real scenes with variations, and random scenes.",
    ),
    Claim(
        "fig. 10",
        "equal time, five scenes: 0.35 to 0.51 of KPCN's error, 0.28 to 0.68 of "
        "AFGSA's; deep combiner and PD sometimes harm",
        where=(_EQUAL_TIME,),
        measured=(_EQUAL_TIME,),
        note="Over the time of njs, denoised path tracing takes 1.0 (staircase2), 1.2 "
        "(living-room) and over 3.7 (veach-bidir) for its error; of pd 0.9, 1.8, over "
        "3.9; of `balanced` 1.2, 2.9, over 3.6. The deep combiner is not here.",
    ),
    Claim(
        "fig. 11",
        "convergence beside PD and the deep combiner, KPCN and AFGSA",
        where=(_CONVERGENCE,),
        measured=(_CONVERGENCE, _LEARNED),
        note="At equal samples, OIDN, 4 to 4096: njs 1.10, 0.950, 0.980, 0.978, "
        "0.891, 0.910 of the better input, pd 1.14, 0.887, 0.963, 0.842, 0.871, "
        "0.827. The paper has PD harm up to 2K samples; ours has other training.",
    ),
    Claim(
        "fig. 12",
        "equal time beside ensemble denoising: Veach-Ajar 0.0064, with path tracing "
        "as a base 0.291, with NFOR 0.0326",
        measured=(_FORMS,),
        note="At equal samples, of OIDN with and without features: ensemble 0.908 of "
        "the better input, with path tracing 0.900 (worst 1.03), whitened James-Stein "
        "after it 0.877. Path tracing as a base harms in the paper; our weights are "
        "multi-scale. NFOR and equal time were not measured.",
    ),
    Claim(
        "fig. 13",
        "convergence of the same",
        measured=(_FORMS,),
        note="At 4 to 4096 samples, of the better input: ensemble 0.968 to 0.826, "
        "with path tracing 0.983 to 0.769, njs after the first 1.06 to 0.778.",
    ),
    Claim(
        "fig. 14",
        "an ensemble's image as y: lower than the ensemble and than path tracing",
        where=("ensemble.combine_frame", "james_stein.combine_frame"),
        measured=(_FORMS,),
        note="njs towards the ensemble of two denoisers has 0.983 of its error (29 "
        "test frames): above it at 4 samples (1.06, 0.968), below it from 64 on; "
        "below path tracing in all.",
    ),
    Claim(
        "fig. 15",
        "KPCN trained jointly with the combiner converges faster, and below path "
        "tracing",
        where=("learning.networks.Joint",),
        measured=("experiments.training.joint",),
        note="Over the denoiser trained alone: apart 0.968, jointly 0.901 (worst "
        "3.56): joint training gains, as there. Below path tracing in 34 of 35 "
        "frames. A small kernel predictor of the whole image; the combiner has the "
        "U-Net, not eight convolutions; 750 steps.",
    ),
    Claim(
        "fig. 16",
        "NFOR as y, a consistent denoiser: improved up to 2K samples",
        where=("denoisers.nfor.denoise_frame", "james_stein.neural_combine_frame"),
        measured=("experiments.james_stein.weak_denoisers",),
        note="njs 1.07, 0.937, 0.994, 0.972, 0.986, 0.984 of NFOR at 4 to 4096 "
        "samples (worst 1.24), multi-scale 0.818 in the mean. Our NFOR makes the "
        "images of halves of their own halves; with two sub-buffers as in the paper.",
    ),
    Claim(
        "fig. 17",
        "equal time, bidirectional path tracing with photon mapping: 0.0018 against "
        "0.0858 and 0.0066; 0.0073 against 0.0353 and 0.0709",
        where=("james_stein.combine_frame", "rendering.render"),
        measured=("experiments.double_shrinkage.photons",),
        note="Mitsuba 3 has no bidirectional path tracer: path tracing stands for it, "
        "at equal samples. Over the better input, 29 test frames: james-stein 0.436 "
        "(worst 1.05), njs 0.234 (1.11), trained on OIDN alone.",
    ),
    Claim(
        "fig. 18",
        "convergence of the same: below both inputs",
        where=("experiments.double_shrinkage.photons",),
        measured=("experiments.double_shrinkage.photons",),
        note="njs 0.204, 0.162, 0.189, 0.217, 0.295, 0.467 of the better input at 4 "
        "to 4096 samples. Photon maps have a fixed number of passes, so only path "
        "tracing converges.",
    ),
    Claim(
        "fig. 19",
        "maps of error: single pixels lose, the mean gains (0.0120 and 0.0017 become "
        "0.0007)",
        where=("experiments.comparison.pixels",),
        measured=("experiments.comparison.pixels",),
        note="Against the denoised image, where the paper has the unbiased one: njs "
        "removes 55 % of OIDN's error and adds 33 %, in 22.1 % of the pixels; "
        "whitened removes 17 % and adds 2 %.",
    ),
    Claim(
        "table 2",
        "full pair or crossed halves: Curly-hair 0.0041 and 0.0043 at 128 samples, "
        "Glass-of-water 0.00275 both at 2K",
        where=("james_stein.combine_dual", "james_stein.neural_combine_dual"),
        measured=("experiments.james_stein.error", _FORMS),
        note="Without networks, development frames: full 0.949, dual 2.56 of the "
        "better input; in the paper at most 21 % worse. 29 test frames: whitened "
        "0.950, dual 0.990; with the network 0.981 and 0.989, worse at 16 samples "
        "(1.14), better at 4096 (0.808, full 0.910).",
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
