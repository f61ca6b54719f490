"""Motion priors in JAX, one per file: each maps the previous state to a Transition."""
