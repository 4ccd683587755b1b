"""What of double shrinkage is here, and what was measured?"""

from experiments.common.claims import Claim
from experiments.common.claims import account as report
from experiments.common.command import Options, main

CLAIMS = (
    Claim(
        "eq. 1",
        "unbiased image Gaussian about the truth, biased one about truth plus bias",
        where=("double_shrinkage.factors",),
        note="An assumption: one pixel, one channel. Both images are taken to be "
        "independent.",
    ),
    Claim(
        "eq. 2",
        "single shrinkage: lambda of the biased image, the rest of the unbiased one",
        where=("double_shrinkage.Factors",),
        note="Its blend, with k1 for lambda.",
    ),
    Claim(
        "eq. 3",
        "James-Stein's combination of a window",
        where=("james_stein.combine",),
        measured=("experiments.double_shrinkage.photons",),
        note="With the positive part, and averaged over windows as in the paper that "
        "it cites.",
    ),
    Claim(
        "eq. 4",
        "lambda = (p-2) s2 over the squared distance",
        where=("james_stein.combine",),
        note="As in the paper.",
    ),
    Claim(
        "eq. 5",
        "its mean squared error, below that of the unbiased image",
        where=("james_stein.risk",),
        note="The paper prints the right side without an expectation: its mean is the "
        "error. It holds for one variance a window and a biased image apart from the "
        "unbiased one.",
    ),
    Claim(
        "eq. 6",
        "the truth of greatest posterior probability",
        where=("double_shrinkage.combine",),
        note="Only the closed form is in the code.",
    ),
    Claim(
        "eq. 7",
        "likelihood of the biased image without its bias: variance s_b^2 + g^2",
        where=("double_shrinkage.factors",),
        note="The paper prints the prior's mean as that of the biased image; it is "
        "the truth. The sum is one number here, m, its mean squared error.",
    ),
    Claim(
        "eq. 8",
        "the posterior's derivative is zero: a mean by inverse errors",
        where=("double_shrinkage.combine",),
        note="A test holds the result equal to that mean.",
    ),
    Claim(
        "eq. 9",
        "k2 of the prior, 1 - k2 of the blend by k1",
        where=("double_shrinkage.combine",),
        measured=("experiments.double_shrinkage.photons",),
        note="A test holds it against the posterior mean. An infinite error leaves an "
        "image out, an error of zero gives it all.",
    ),
    Claim(
        "eq. 10",
        "k1 and k2 by the three errors",
        where=("double_shrinkage.factors",),
        measured=("experiments.double_shrinkage.photons",),
        note="Written as two blends by inverse errors, equal but for rounding, "
        "because the products leave the range of float32.",
    ),
    Claim(
        "eq. 11",
        "linear fit of features to both images at once, 51x51",
        where=(
            "double_shrinkage.radiance_prior",
            "numerics.regression.joint_local_linear",
        ),
        note="radiance_prior is that of the paper, but for the notes at eq. 14, 16, "
        "17. Frames, and so the networks, have another: blend_prior fits the first "
        "blend alone, since one failed image spoils a fit of both; limit_prior bounds "
        "it by three deviations of u. Both are ours: fig. 14 compares them.",
    ),
    Claim(
        "eq. 12",
        "weights of each image by distances in the other",
        where=("numerics.weights.gaussian_weights",),
        note="Distances are sums over channels, variances means over them (the paper "
        "has one channel). The bandwidth is m or, as printed, the variance alone: the "
        "caller's choice.",
    ),
    Claim(
        "eq. 13",
        "the same as least squares of matrices",
        where=("numerics.regression.joint_local_linear",),
        note="In sums of products over tiles; no such matrix is made.",
    ),
    Claim(
        "eq. 14",
        "its matrices: root weights times one and centred features",
        where=("numerics.regression.joint_local_linear",),
        note="Features are also divided by their largest difference from the centre "
        "plus 0.1.",
    ),
    Claim(
        "eq. 15",
        "its residual",
        where=("numerics.regression.joint_local_linear",),
        note="Only the closed form is in the code.",
    ),
    Claim(
        "eq. 16",
        "normal equations, solved by Cholesky with an epsilon on the diagonal",
        where=("numerics.regression.joint_local_linear", "numerics.cholesky"),
        note="The constant is eliminated, and a ridge is on the slopes alone: on the "
        "constant it would darken bright pixels. A test compares with loops over "
        "pixels.",
    ),
    Claim(
        "eq. 17",
        "prior: windows' predictions, weighted by distances less the noise's part",
        where=(
            "numerics.weights.noise_free_weights",
            "double_shrinkage.radiance_prior",
        ),
        note="Slopes times f_i - f_j, where f_j - f_i is printed, and a weighted "
        "mean, where a sum is. The noise's part is subtracted once for each channel.",
    ),
    Claim(
        "eq. 18",
        "loss: SMAPE, epsilon 0.001",
        where=("metrics.smape",),
        note="The networks that ship are trained on relative L2 over halves of the "
        "reference; dsc-smape in experiments.training.ablations has SMAPE, without a "
        "result here.",
    ),
    Claim(
        "table 1",
        "symbols",
        where=("double_shrinkage",),
        note="The package's docstring has ours: m for s_b^2 + g^2.",
    ),
    Claim(
        "section 3, motivation",
        "a single pixelwise blend at most halves the lower of both errors",
        where=("double_shrinkage.Factors",),
        measured=("experiments.double_shrinkage.error",),
        note="Its error s = v m / (v + m) says so where v and m are right. Without a "
        "network the blend alone has 0.0996, 0.0430, 0.0272 on staircase2, "
        "cornell-caustic, cornell-glass, both shrinkages 0.0378, 0.0354, 0.0232.",
    ),
    Claim(
        "section 4.1",
        "two shrinkages: inverse errors against fireflies, the prior against what is "
        "left",
        where=("double_shrinkage.combine_frame",),
        measured=("experiments.double_shrinkage.photons",),
        note="Without a network 0.232 of the better of path tracing and photon "
        "mapping (worst 1.37, at few samples), whitened James-Stein 0.388 (0.99), 29 "
        "test frames; 0.512 at 4096 samples.",
    ),
    Claim(
        "section 4.2",
        "the prior is an auxiliary image, smoother than a denoised one",
        where=("double_shrinkage.blend_prior", "double_shrinkage.limit_prior"),
        measured=("experiments.double_shrinkage.error",),
        note="Alone ours has 0.0393, 0.0390, 0.0210 on the scenes of fig. 14, about "
        "as little as the result; that of the paper 0.653, 2.53, 0.257.",
    ),
    Claim(
        "section 4.3, network",
        "U-Net of prior, both images and both errors: two softmax kernels of 13x13 "
        "and eta^2, 339 outputs",
        where=("learning.networks.ShrinkageNetwork", "double_shrinkage.neural_combine"),
        measured=(
            "experiments.training.learned",
            "experiments.double_shrinkage.photons",
        ),
        note="As there; what ships has half the channels. Radiance enters as a signed "
        "logarithm. eta^2 is the prior's mean squared error, the paper's confidence "
        "the other way round. Over the better input, 35 frames: with photon mapping "
        "0.218 (untrained 0.606, without a network 0.247), with OIDN 0.908 (1.42, "
        "1.10).",
    ),
    Claim(
        "section 4.3, data",
        "2548 pairs of 512x512 from 20 scenes, path tracing and photon mapping",
        where=("experiments.data.dataset",),
        note="Ours: 128x128, four real scenes varied and random ones; 263 frames by "
        "the networks' cards, a network for photon mapping and one for OIDN.",
    ),
    Claim(
        "section 4.3, training",
        "2000 epochs of batch 10, 128x128, Adam 1e-4, a day",
        where=("learning.training.Schedule", "experiments.training.train"),
        measured=("experiments.training.learned",),
        note="About 460 000 steps there; ours 2500 of 8 crops of 64x64, one-cycle "
        "Adam to 5e-4.",
    ),
    Claim(
        "section 4.4, unbiased",
        "its variance is the sample variance, filtered",
        where=("double_shrinkage.unbiased_error",),
        note="Half of it is pooled over a window before the network filters, since a "
        "pixel that missed the light looks certain; the networks are trained on that.",
    ),
    Claim(
        "section 4.4, biased",
        "bias and variance of photon mapping by Hachisuka et al. 2010",
        where=("double_shrinkage.biased_error", "double_shrinkage.radius_bias"),
        measured=("experiments.double_shrinkage.error",),
        note="By halves, an unbiased estimate that any integrator allows; or by the "
        "slope over passes of different radii, after that work but without its "
        "kernels. Of the frame, true 2.65, 0.247, 0.0960, by halves 2.16, 0.276, "
        "0.143, by radii 3.23, 0.248, 0.122, on three scenes.",
    ),
    Claim(
        "section 5, photon mapping",
        "Mitsuba's stochastic progressive photon mapping",
        where=("rendering.render",),
        measured=(
            "experiments.double_shrinkage.photon_mapping",
            "experiments.double_shrinkage.photons",
        ),
        note="Written here: one known radius a pass for all pixels, so that passes "
        "are independent and halves exist. Means of frames were within 1.7 standard "
        "errors of path tracing. Until lately turned environment maps were twice too "
        "bright in photons (Mitsuba draws their rays from a disk that is not turned), "
        "and photons made fireflies on gloss; experiments.training.learned and the "
        "networks are of before. Now living-room has 2.5 of relative L2, nearly all "
        "variance, staircase2 0.30; veach-bidir 18 to 20, nearly all in 16 pixels of "
        "a wall that take light from inside the housing of a lamp, within the first "
        "radius (1/100 of the diagonal): at half of it, in a run that is not kept, "
        "2.0.",
    ),
    Claim(
        "section 5, time",
        "post-processing takes below 5 % of the rendering",
        where=("experiments.double_shrinkage.error",),
        measured=("experiments.double_shrinkage.error",),
        note="Combining 128x128 pixels took 0.10 to 0.29 s on a busy machine of two "
        "cores, 2 to 5 % of the 6 s of rendering, without a network.",
    ),
    Claim(
        "section 6",
        "equal time for both integrators; noise that comes back; other priors",
        note="How to share a budget between integrators, and other distributions, are "
        "not here; nor are they in the paper. For noise see fig. 16.",
    ),
    Claim(
        "fig. 1",
        "Swimming Pool, equal time: against NeuralJS with OIDN and with photon mapping",
        note="A scene that is not here; its errors stand in the picture. Compare fig. "
        "10 and 12.",
    ),
    Claim(
        "fig. 2",
        "one variance a window leaves noise where the variance varies",
        where=("james_stein.combine",),
        measured=("experiments.james_stein.error",),
        note="Over the better of path tracing and OIDN: one variance a 15x15 window "
        "0.949, one a pixel in 7x7 windows 0.904, without networks. The picture is "
        "not here.",
    ),
    Claim(
        "fig. 3",
        "James-Stein with photon mapping: large residuals where integrators differ "
        "weaken the shrinkage",
        where=("james_stein.combine_frame",),
        measured=("experiments.double_shrinkage.photons",),
        note="james-stein 0.436 of the better of path tracing and photon mapping, "
        "double shrinkage 0.232, 29 test frames. The residuals are not drawn.",
    ),
    Claim(
        "fig. 4",
        "overview of the pipeline",
        where=(
            "double_shrinkage.neural_combine_frame",
            "double_shrinkage.neural_inputs",
        ),
        note="As drawn, but for the prior (eq. 11) and the errors (section 4.4).",
    ),
    Claim(
        "fig. 5",
        "the prior beside the other paper's y*: without photons' blotches",
        where=("double_shrinkage.radiance_prior", "james_stein.cross_regression"),
        measured=("experiments.double_shrinkage.error",),
        note="Alone, scenes of fig. 14: that of the paper 0.653, 2.53, 0.257, ours "
        "0.0393, 0.0390, 0.0210, y* 0.0824, 9.79, 0.124.",
    ),
    Claim(
        "fig. 6",
        "map of the predicted eta^2: large where the prior has blurred",
        where=("double_shrinkage.Filters",),
        measured=("experiments.comparison.forms",),
        note="With OIDN, 29 test frames: over blocks of 8x8 pixels the predicted "
        "eta^2 has a median rank correlation of 0.63 (0.22 to 0.82) with the squared "
        "error of the prior, and 8.9 times its size: a ranking, and too much of it. "
        "Not drawn; nor measured with photon mapping.",
    ),
    Claim(
        "fig. 7",
        "architecture",
        where=("learning.networks.ShrinkageNetwork", "learning.unet.UNet"),
        note="As drawn; the text does not give the widths, ours are 32, 64, 128.",
    ),
    Claim(
        "fig. 8",
        "scenes of the training data",
        where=("experiments.data.dataset", "rendering.render"),
        note="Others: see section 4.3, data.",
    ),
    Claim(
        "fig. 9",
        "map of the prior's share of the result",
        where=("double_shrinkage.factors",),
        measured=("experiments.double_shrinkage.error",),
        note="Drawn beside the images there, without a network. With the network and "
        "OIDN the mean share is 0.10 to 0.64 (median 0.39) in 29 test frames "
        "(experiments.comparison.forms).",
    ),
    Claim(
        "fig. 10",
        "equal time, four scenes, 20 to 2560 s: below DeepCombiner, NeuralJS and "
        "NeuralJS trained again",
        where=(
            "double_shrinkage.neural_combine_frame",
            "james_stein.neural_combine_frame",
        ),
        measured=("experiments.double_shrinkage.photons",),
        note="dsc 0.218 of the better input (worst 1.26), njs 0.234 (1.11), dsc lower "
        "in 14 of 29 test frames: a small gain, where the paper has a large one. At "
        "equal samples, not time. njs is trained on the images of OIDN; trained "
        "again, and DeepCombiner, are not here. Ours has a lighter network, about "
        "1/180 of the steps, and was trained on photon maps of before (section 5).",
    ),
    Claim(
        "fig. 11",
        "bidirectional path tracing with photon mapping against vertex connection and "
        "merging",
        note="Not here: Mitsuba 3 has neither bidirectional method.",
    ),
    Claim(
        "fig. 12",
        "equal time: NeuralJS with OIDN against ours with photon mapping: marginally "
        "better, in caustics and shadows",
        where=(
            "double_shrinkage.neural_combine_frame",
            "james_stein.neural_combine_frame",
        ),
        measured=("experiments.training.learned",),
        note="Same path tracing, so that ours has the time of photons on top: "
        "dsc-photons has less error than njs with OIDN in 5 of 35 frames, with photon "
        "maps of before (section 5); other scenes.",
    ),
    Claim(
        "fig. 13",
        "OIDN or photon mapping for the biased image: an integrator brings more detail",
        where=("double_shrinkage.combine_frame",),
        measured=("experiments.training.learned",),
        note="Relative L2 says the opposite: with OIDN (dsc) it is lower than with "
        "photon mapping (dsc-photons) in all of 35 frames, with photon maps of before "
        "(section 5). Each network is trained on its own kind. Detail by itself is "
        "not measured.",
    ),
    Claim(
        "fig. 14",
        "ablation of the prior: theirs against y*",
        where=("experiments.double_shrinkage.error",),
        measured=("experiments.double_shrinkage.error",),
        note="Without networks, staircase2, cornell-caustic, cornell-glass: double "
        "shrinkage to the prior of the paper 0.0586, 0.0474, 0.0289, to y* 0.0503, "
        "2.56, 0.0281 (as the paper says of the caustic alone), to ours 0.0378, "
        "0.0354, 0.0232. 8 to 12 photon passes, errors from halves.",
    ),
    Claim(
        "fig. 15",
        "ablation of the combiner: double shrinkage against James-Stein, both towards "
        "y*",
        where=("experiments.double_shrinkage.error",),
        measured=("experiments.double_shrinkage.error",),
        note="Towards y* double shrinkage has 0.0503, 2.56, 0.0281, whitened "
        "James-Stein 0.0379, 6.72, 0.102: better in two of three. Towards our prior "
        "0.0378, 0.0354, 0.0232 against 0.0373, 0.0356, 0.0210: such a prior has "
        "nearly the error of the result, and there is little to add to it. Without "
        "networks.",
    ),
    Claim(
        "fig. 16",
        "limitation: noise of both kinds may come back",
        where=("experiments.comparison.pixels",),
        measured=("experiments.comparison.pixels",),
        note="With OIDN, one frame of 1024 samples: dsc removes 27 % of the denoised "
        "image's error and adds 15 %, in 14.6 % of the pixels. Not told apart by "
        "kind, nor measured with photon mapping.",
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
