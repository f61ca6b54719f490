"""A captured motion as the joint angles of a named body: exact if the skeletons agree, otherwise fitted to the motion's landmarks."""

from bayes_body.initial.retarget.to_body import Retargeted, retarget

__all__ = ["Retargeted", "retarget"]
