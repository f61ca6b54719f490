"""A captured motion as the joint angles of a named body: exactly where the skeletons agree, by a fit to its landmarks where they do not."""

from bayes_body.retarget.result import Retargeted
from bayes_body.retarget.to_body import retarget

__all__ = ["Retargeted", "retarget"]
