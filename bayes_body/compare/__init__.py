"""Runs side by side: every kernel on every definition."""

from bayes_body.compare.matrix import Pair, Row, Settings, matrix_rows, pairs
from bayes_body.compare.scenes import Scene, Scenes

__all__ = ["Pair", "Row", "Scene", "Scenes", "Settings", "matrix_rows", "pairs"]
