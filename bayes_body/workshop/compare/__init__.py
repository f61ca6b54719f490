"""Compare every kernel on every definition. The experiments of papers are programs in `inference/papers`."""

from bayes_body.workshop.compare.benchmark import Pair, Row, Settings, benchmark_rows, pairs
from bayes_body.workshop.compare.scenes import Scene, Scenes

__all__ = ["Pair", "Row", "Scene", "Scenes", "Settings", "benchmark_rows", "pairs"]
