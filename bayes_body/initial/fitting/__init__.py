"""Fit a body to given points: lengths and angles by least squares."""
