"""The first joint of a body that a learned motion prior moves: its dofs are the position and the orientation in the world."""

from bayes_body.base.errors import input_error
from bayes_body.model.body.solids import Body

# Its dofs, in order: shifts along x, y, z, then rotations about z (yaw), x, y. The second entry says whether it is a shift.
ROOT = ((0, True), (1, True), (2, True), (2, False), (0, False), (1, False))
ROOT_DOFS = len(ROOT)


def check_root(body: Body, what: str) -> None:
    """Check that the first joint of a body has these dofs.

    Args:
        body: the body.
        what: what needs it, such as "dynamics walking_cycle".

    Raises:
        InputError: it has others.
    """
    topology = body.skeleton.topology
    root = tuple((motion.axis, motion.is_shift) for motion in topology.motions[0] if motion.sign == 1)
    if root != ROOT or [motion.dof for motion in topology.motions[0]] != list(range(ROOT_DOFS)):
        problem = f"the first joint of the body '{body.name}' is {topology.joint_names[0]}, with other dofs"
        raise input_error(what, problem, "a first joint with the dofs tx, ty, tz, z, x, y in this order", "name another body")
