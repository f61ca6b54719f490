"""A run as a 3D scene in one HTML file, for people who want to turn, zoom and play what was tracked."""

from bayes_body.view.viewer.page import write_view
from bayes_body.view.viewer.people import write_people_view

__all__ = ["write_people_view", "write_view"]
