"""Comparison of models and priors by the evidence of finished runs."""
