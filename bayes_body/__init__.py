"""Bayesian 3D human pose and motion from calibrated video, with honest uncertainty.

Every public name is imported at its first use (PEP 562): `import bayes_body` costs nothing and does not configure JAX. Call `configure()` before the
first computation.
"""

import os
from importlib import import_module
from typing import Any

# OpenCV reads it when it is loaded. An image's header can claim any size, and OpenCV's own limit lets a small file take 3 GB.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))

_HOME = {
    "InputError": "base.errors",
    "configure": "base.config",
    "load_session": "recording.session.read",
    "save_session": "recording.session.read",
    "load_definition": "model.definition",
    "load_model": "initial",
    "unposed": "initial",
    "PersonSearch": "initial.search.person_search",
    "PersonRecovery": "runs.recovery",
    "read_frame": "recording.observation.frames",
    "read_colour": "recording.observation.pictures",
    "RunWarning": "base.errors",
    "track": "runs.track",
    "smooth": "runs.track",
    "to_datatree": "results.posterior",
    "save_posterior": "results.posterior",
    "equal_weight": "results.posterior",
    "diagnose": "results.posterior.diagnostics",
    "stream_posterior": "results.posterior",
    "window_of_run": "runs.window",
    "window_posterior": "tracking.window",
    "window_sentences": "results.posterior.window",
    "window_to_datatree": "results.posterior.window",
    "FrameFiles": "results.storage",
    "load_run": "results.storage.saved_run",
    "summarise": "results.metrics",
    "draw_overlay": "view.overlay",
    "watched": "base.progress",
    "Factor": "density.factor",
    "Particles": "density.factor",
    "FilterInfo": "density.kernel",
    "MarkerEvidence": "recording.evidence.markers",
    "MARKERS": "recording.evidence.markers",
    "KEYPOINTS": "recording.evidence.markers",
    "over_particles": "kernels.batching",
    "excerpt": "recording.readers.excerpt",
    "graph": "density.pairwise",
    "node_factor": "density.pairwise",
    "edge_factor": "density.pairwise",
    "proposal": "density.pairwise",
    "Schema": "base.toml.schema",
    "Count": "base.toml.schema",
    "Positive": "base.toml.schema",
    "Transition": "density.factor",
    "Variable": "density.factor",
    "load_plugin": "model.plugins.load",
    "marker_positions": "model.body.kinematics",
    "project": "base.geometry.camera",
    "register": "base.registry",
    "setting": "cli.arguments",
    "whole_number": "cli.arguments",
}
_MODULES = {"compare": "workshop.compare", "kernels": "kernels", "metrics": "results.metrics", "posterior": "results.posterior"}
# For the programs of inference/, whose texts are copied; not promised to stay.
_FOR_PROGRAMS = {"setting", "unposed", "watched", "whole_number", "window_sentences"}
__all__ = sorted({*_HOME, *_MODULES} - _FOR_PROGRAMS)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # Reading a package's metadata takes as long as all the rest of this import.
        from importlib.metadata import version

        return version("bayes-body")
    if name in _HOME:
        return getattr(import_module(f"bayes_body.{_HOME[name]}"), name)
    if name in _MODULES:
        return import_module(f"bayes_body.{_MODULES[name]}")
    raise AttributeError(f"module 'bayes_body' has no attribute '{name}'; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
