"""Compare runs: every kernel on every definition; the errors of two samplers at equal computation; people found in single frames with the truth."""

from bayes_body.compare import estimator_path, estimator_variance
from bayes_body.compare.benchmark import Pair, Row, Settings, benchmark_rows, pairs
from bayes_body.compare.bending_arm import film_arm, twist_interval
from bayes_body.compare.few_cameras import few_camera_definitions, film_in_room, follow, with_cameras
from bayes_body.compare.image_motion import compare_walk, film_walk, motion_figures, uniform
from bayes_body.compare.scenes import Scene, Scenes
from bayes_body.compare.single_frames import single_frames, track_figures

__all__ = [
    "Pair",
    "Row",
    "Scene",
    "Scenes",
    "Settings",
    "benchmark_rows",
    "compare_walk",
    "estimator_path",
    "estimator_variance",
    "few_camera_definitions",
    "film_arm",
    "film_in_room",
    "film_walk",
    "follow",
    "motion_figures",
    "pairs",
    "single_frames",
    "track_figures",
    "twist_interval",
    "uniform",
    "with_cameras",
]
