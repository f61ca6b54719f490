"""Constraints and pairwise potentials."""
