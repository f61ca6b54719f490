"""One file a motion prior, in JAX: the previous state becomes a Transition."""
