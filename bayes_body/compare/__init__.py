"""Compare runs: every kernel on every definition; and the errors of two samplers at equal computation, on one frame and along frames."""

from bayes_body.compare import estimator_path, estimator_variance
from bayes_body.compare.benchmark import Pair, Row, Settings, benchmark_rows, pairs
from bayes_body.compare.scenes import Scene, Scenes

__all__ = ["Pair", "Row", "Scene", "Scenes", "Settings", "benchmark_rows", "estimator_path", "estimator_variance", "pairs"]
