"""Networks that choose what the estimators leave open, and how they are trained.

`methods` combines a frame with the networks that come with the package, and loads
others; `networks` are the papers'; `training` and `losses` make new ones. They need
flax, which is slow to import, so they are imported by name::

    from jscomb.learning import methods
    image = methods.combine_frame(jax.random.key(0), frame, "oidn", method="njs")
"""
