"""Where the joints, markers and solids of a body are in the world, whichever variable places it; and terms that need one of the two."""

import jax
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration
from bayes_body.model.body.placement import PARTS, POSE, ByParts
from bayes_body.model.body.solids import Body


def require(body: Body, variable: str, what: str, alternative: str) -> None:
    """Check that the body is placed by this variable.

    Args:
        body: the body.
        variable: `pose` or `parts`.
        what: what needs it, such as "dynamics 'diffusion'".
        alternative: the term that does the same for the other placement.

    Raises:
        InputError: it is placed by the other one.
    """
    if body.variable != variable:
        placement = {POSE: "angles", PARTS: "parts"}
        setting, expected = f'[body] placement = "{placement[body.variable]}"', f'placement = "{placement[variable]}"'
        raise input_error(what, setting, expected, f"change it, or take {alternative}")


@jax.jit
def solids_in_parts(body: Body) -> Transform:
    """Return `T_part_solid` of every solid of a body that is placed by parts: rotations (solid, 3, 3) and origins (solid, 3), metres."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    return transforms.compose(transforms.pick(placement.held, np.array(body.topology.joints)), Transform(body.presets, body.offsets))


def joint_transforms(body: Body, configuration: Configuration) -> Transform:
    """`T_world_joint` of every joint, stacked: rotations (joint, 3, 3) and origins (joint, 3), metres."""
    return body.placement.joints(body.skeleton, configuration)


def placed_markers(body: Body, configuration: Configuration) -> Float[Array, "marker 3"]:
    """World positions of the virtual markers, metres."""
    return transforms.apply(transforms.pick(joint_transforms(body, configuration), np.array(body.markers.joints, np.int32)), body.markers.offsets)
