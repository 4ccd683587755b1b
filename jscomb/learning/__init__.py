"""Networks that decide what the estimators leave open, and their training.

`recipes` defines what each network sees, how its output makes an image, and loads the
parameters that come with the package; `networks` are the papers'; `examples`,
`training`, `losses` and `checkpoints` make and store others, as `jscomb train` does.
Most import flax, which is slow, so modules are imported by name::

    from jscomb.learning import recipes
    recipe, network = recipes.RECIPES["njs"], recipes.shipped("njs")
    inputs = recipe.inputs(jax.random.key(0), frame.normalised(), estimate)
    image = recipe.combine(network, inputs)
"""

__all__ = ["checkpoints", "examples", "losses", "networks", "recipes", "training"]  # pyright: ignore
