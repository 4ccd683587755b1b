"""Every public function keeps the promises, or there is a reason why not."""

import inspect

from tests.battery import catalogue, parts, public

ENTRIES = catalogue.combiners() | catalogue.denoisers() | catalogue.solvers()
ELSEWHERE = {
    "of frames, and what they are made of is here": {
        *(
            f"{room}.{name}"
            for room in ("bilateral", "nonlocal_means", "rdfc", "smoothing")
            for name in ("denoise_frame", "plan_frame", "reach")
        ),
        "double_shrinkage.combine_frame",
        "double_shrinkage.depends",
        "double_shrinkage.make_inputs",
        "double_shrinkage.neural_combine_frame",
        "double_shrinkage.neural_inputs",
        "double_shrinkage.plan_neural",
        "ensemble.candidates",
        "ensemble.combine_frame",
        "ensemble.neural_combine_frame",
        "ensemble.neural_inputs",
        "ensemble.neural_weights",
        "ensemble.plan_neural_weights",
        "ensemble.select_bases",
        "ensemble.stack_estimates",
        "ensemble.weigh_frame",
        "james_stein.combine_frame",
        "james_stein.neural_combine_frame",
        "james_stein.neural_inputs",
        "james_stein.plan_bands",
        "james_stein.plan_frame",
        "james_stein.plan_neural",
        "james_stein.reach",
        "james_stein.reach_of_bands",
        "james_stein.regress",
        "james_stein.strength_for",
        "james_stein.worth_regressing",
        "kernel_predicting.denoise_inputs",
        "kernel_predicting.neural_inputs",
        "methods.combine",
        "methods.combine_tier",
        "methods.input_name",
        "methods.inputs",
        "methods.table",
        "methods.with_inputs",
        "nfor.denoise_frame",
        "oidn.denoise_color",
        "oidn.denoise_frame",
        "oidn.denoise_turns",
        "oidn.denoise_variants",
        "oidn.tune",
        "oidn.tune_frame",
        "progressive.combine_frame",
        "rdfc.denoise_selected_frame",
        "progressive.neural_combine_frame",
        "progressive.neural_inputs",
        "progressive.plan_neural",
        "uncorrelated.combine_frame",
        "uncorrelated.select_gamma_frame",
    },
    "what is here with normalisation, or without": {
        "double_shrinkage.neural_combine",
        "ensemble.neural_combine",
        "james_stein.neural_combine",
        "james_stein.neural_combine_dual",
        "kernel_predicting.denoise",
        "oidn.denoise_normalised",
        "progressive.neural_combine",
    },
    "of functions": {
        "denoisers.black_box",
        "nonlocal_means.weights",
        "sure.exact_sure",
        "uncorrelated.admissibility",
        "uncorrelated.combine_with",
        "uncorrelated.median_kernel",
        "uncorrelated.variance_kernel",
    },
    "what others are held against, in float64": {
        "simplex.reference",
        "simplex.reference_quadratic",
    },
    "of features, which have no unit": {"oidn.denoise_feature"},
    "selects filters that are here by a risk that is here": {"rdfc.denoise_selected"},
    "not of images": {"james_stein.rule_of", "oidn.available", "oidn.pretrained"},
}
ROOMS = (
    *("james_stein", "ensemble", "uncorrelated", "double_shrinkage", "progressive"),
    *("methods", "denoisers"),
    *("numerics.poisson", "numerics.regression", "numerics.simplex", "numerics.sure"),
)
MODULES = [
    module
    for name, module in public.modules().items()
    if name.startswith(tuple(f"jscomb.{room}" for room in ROOMS))
]


def test_nothing_is_left_out():
    """Public functions are here, or parts of those, or there is a reason why not."""
    short = lambda module: module.__name__.rpartition(".")[2]
    public = {
        f"{short(module)}.{name}"
        for module in MODULES
        for name in module.__all__
        if inspect.isfunction(found := getattr(module, name))
        and found.__module__.startswith(module.__name__)
    }
    here = {name.partition(" ")[0] for name in ENTRIES}
    named = here | parts.parts().keys() | set().union(*ELSEWHERE.values())
    assert public <= named
    assert here | set().union(*ELSEWHERE.values()) <= public
