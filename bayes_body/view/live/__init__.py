"""A page on this machine that shows the last second of a run while it is tracked."""

from bayes_body.view.live.page import LivePage
from bayes_body.view.live.server import served

__all__ = ["LivePage", "served"]
