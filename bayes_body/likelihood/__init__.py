"""One file an image likelihood, in JAX."""
