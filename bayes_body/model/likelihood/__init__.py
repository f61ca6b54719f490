"""Image likelihoods in JAX, one per file."""
