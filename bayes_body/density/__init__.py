"""Densities: factors over named variables, transitions, and the density that is their product."""
