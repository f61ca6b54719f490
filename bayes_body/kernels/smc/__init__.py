"""Particle filters: sampling importance resampling, annealing, tempered SMC."""
