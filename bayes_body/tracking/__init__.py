"""Tracking: a model and a kernel filter a session."""
