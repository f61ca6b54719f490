"""Readers of what laboratories have: calibrations, images."""
