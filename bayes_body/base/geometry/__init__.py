"""Rotations, rigid transforms and cameras."""
