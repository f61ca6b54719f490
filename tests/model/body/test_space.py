"""The space of a body's configuration."""

import numpy as np

from bayes_body.density.spaces import Plate
from bayes_body.model.body.build import build_body
from bayes_body.model.body.placed_body import loosened
from bayes_body.model.body.solids import configuration_space, pose_space
from bayes_body.model.definition import load_body, load_definition
from bayes_body.model.dynamics import diffusion, second_order


def test_a_pose_has_translations_angles_on_the_circle_and_limits():
    body = build_body("person_31", load_body("person_31"))
    space = pose_space(body)
    assert space == configuration_space(body) and space.labels == body.dof_names and space.axis == "dof"
    limited = np.isfinite(np.asarray(body.skeleton.low))
    angular = np.asarray(body.skeleton.topology.angular)
    # Of the root's three angles only the direction in which the person faces has no limits.
    assert [label for label, turns in zip(space.labels, space.turns, strict=True) if turns] == ["root_yaw"]
    assert (space.turns == (angular & ~limited)).all() and (np.isfinite(space.low) == limited).all() and limited.sum() == 27


def test_a_loosened_body_has_a_rigid_transform_for_each_part():
    body = loosened(build_body("person_31", load_body("person_31")))
    space = configuration_space(body)
    assert isinstance(space, Plate) and space.names == body.placement.names and space.shape == (len(space.names), 7)
    assert [axis.name for axis in space.axes] == ["part", "coordinate"]


def test_motion_priors_say_where_their_variables_live():
    definition = load_definition("arm")
    body = build_body("arm_4", definition.body)
    deviations = {"sd_deg": {"*": 5.0}}
    walk = diffusion.build(diffusion.Options(**deviations), body=body, fps=60.0)
    smooth = second_order.build(second_order.Options(**deviations), body=body, fps=60.0)
    assert walk.space("pose", (4,)) == pose_space(body) and set(dict(smooth.spaces)) == {"pose", "pose_before"}
    assert walk.space("other", (2,)).tangent_labels == ("other_0", "other_1")
