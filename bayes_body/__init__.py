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
    "InputError": "errors",
    "configure": "config",
    "load_session": "session.read",
    "save_session": "session.read",
    "load_definition": "model.definition",
    "load_model": "initial",
    "unposed": "initial",
    "PersonSearch": "initial.person_search",
    "PersonRecovery": "runs.recovery",
    "read_frame": "observation.frames",
    "read_colour": "observation.pictures",
    "RunWarning": "errors",
    "track": "runs.track",
    "to_datatree": "posterior",
    "save_posterior": "posterior",
    "equal_weight": "posterior",
    "diagnose": "posterior.diagnostics",
    "stream_posterior": "posterior",
    "window_of_run": "runs.window",
    "window_posterior": "tracking.window",
    "window_sentences": "posterior.window",
    "window_to_datatree": "posterior.window",
    "FrameFiles": "storage",
    "load_run": "storage.saved_run",
    "summarise": "metrics",
    "draw_overlay": "view.overlay",
    "watched": "view.progress",
    "Factor": "density.factor",
    "Particles": "density.factor",
    "FilterInfo": "density.kernel",
    "MarkerEvidence": "evidence.markers",
    "MARKERS": "evidence.markers",
    "over_particles": "kernels.parts.batching",
    "excerpt": "recording.excerpt",
    "graph": "density.pairwise",
    "node_factor": "density.pairwise",
    "edge_factor": "density.pairwise",
    "proposal": "density.pairwise",
    "Schema": "toml.schema",
    "Count": "toml.schema",
    "Positive": "toml.schema",
    "Transition": "density.factor",
    "Variable": "density.factor",
    "load_plugin": "plugins.load",
    "marker_positions": "body.kinematics",
    "project": "geometry.camera",
    "register": "registry",
    "setting": "cli.arguments",
    "whole_number": "cli.arguments",
}
_MODULES = ("compare", "kernels", "posterior", "metrics")
__all__ = sorted({*_HOME, *_MODULES})  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # Reading a package's metadata takes as long as all the rest of this import.
        from importlib.metadata import version

        return version("bayes-body")
    if name in _HOME:
        return getattr(import_module(f"bayes_body.{_HOME[name]}"), name)
    if name in _MODULES:
        return import_module(f"bayes_body.{name}")
    raise AttributeError(f"module 'bayes_body' has no attribute '{name}'; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
