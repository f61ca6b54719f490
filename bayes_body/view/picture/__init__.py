"""Pictures of a run for a paper: the posterior of one frame over a camera's image, and curves over time."""

from bayes_body.view.picture.curves import write_curves
from bayes_body.view.picture.frame import write_picture

__all__ = ["write_curves", "write_picture"]
