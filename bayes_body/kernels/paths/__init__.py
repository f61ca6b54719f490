"""Samplers of paths: backward simulation, and windows of frames by NUTS."""
