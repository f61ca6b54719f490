"""The space of what places a body: a pose, or the transforms of its parts."""

import numpy as np

from bayes_body.density.spaces import SE3, Flat, Plate, Space, flat
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body


def pose_space(body: Body) -> Flat:
    """Return the space of a pose, one axis `dof`: an angle without limits is on the circle, a dof with limits keeps them."""
    topology, low, high = body.skeleton.topology, np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    turning = np.asarray(topology.angular) & ~np.isfinite(low) & ~np.isfinite(high)
    return flat(topology.dof_names, topology.dof_units, tuple(turning.tolist()), tuple(low.tolist()), tuple(high.tolist()), "dof")


def configuration_space(body: Body) -> Space:
    """Return the space of the variable `body.variable`: that of a pose, or rigid transforms with the axes `part` and `coordinate`."""
    placement = body.placement
    return Plate(placement.names, SE3("coordinate"), "part") if isinstance(placement, ByParts) else pose_space(body)
