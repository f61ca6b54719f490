"""A loose limb of three parts: its model, exact draws of its prior, and the replications with which a sampler of its posterior is checked.

The prior of a frame is rigid_walk times kinematic, without a normaliser. A joint with one Gaussian is densest at its mean, where its log-density is
`log_weight`, if no standard deviation exceeds √6 radians. So a draw of the walk that is accepted with the probability exp(kinematic - Σ log_weight)
is an exact draw of the prior.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.base.geometry import rigid, rotations
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.definition import parse_definition
from bayes_body.workshop.calibration.problem import AXES, point_mass
from bayes_body.workshop.calibration.scene import model_in_a_room

# The arm hangs: its frames are half a turn away from the world's, where both signs of a quaternion are equally near.
MODEL = """
title = "A loose arm"
source = "a test"

[body]
title = "one arm of three parts"
source = "a test"
placement = "parts"
height_m = 1.75

[body.lengths_of_height]
shoulder_height = 0.818
upper_arm = 0.186
forearm = 0.146
hand = 0.108

[[body.joint]]
name = "shoulder"
parent = "world"
offset = { z = "shoulder_height" }
preset = ["x180"]
dofs = [{ name = "shoulder_x", axis = "x" }, { name = "shoulder_y", axis = "y" }, { name = "shoulder_z", axis = "z" }]

[[body.joint]]
name = "elbow"
parent = "shoulder"
offset = { z = "upper_arm" }
dofs = [{ name = "elbow", axis = "y", low_deg = -150, high_deg = 10 }]

[[body.joint]]
name = "wrist"
parent = "elbow"
offset = { z = "forearm" }
dofs = [{ name = "wrist", axis = "y", low_deg = -90, high_deg = 90 }]

[[body.part]]
name = "upper_arm"
joint = "shoulder"
length = "upper_arm"
radius_of_height = [0.0325, 0.0281]

[[body.part]]
name = "forearm"
joint = "elbow"
length = "forearm"
radius_of_height = [0.0281, 0.0160]

[[body.part]]
name = "hand"
joint = "wrist"
length = "hand"
radius_of_height = [0.026, 0.015]

[body.markers]
l_shoulder = { joint = "shoulder" }
l_elbow = { joint = "elbow", offset = { x = 0.03 } }
l_wrist = { joint = "wrist" }

[dynamics]
kind = "rigid_walk"
at_fps = 60
sd_m = { "*" = 0.04 }
sd_deg = { upper_arm = 12.0, forearm = 18.0, hand = 25.0 }

[[potential]]
kind = "kinematic"

[[potential.component]]
mean_deg = { elbow = -40.0, wrist = 10.0 }
sd_m = { "*" = 0.025 }
sd_deg = { forearm = [10.0, 35.0, 25.0], hand = [15.0, 30.0, 20.0] }

LIKELIHOOD

[kernel]
kind = "sir"
"""
MARKERS = '[[likelihood]]\nkind = "markers_gaussian"\nsd_px = 8.0\nat_diagonal_px = 800.0\n'
# So coarse that about half of a thousand draws of the prior are effective.
SILHOUETTES = '[[likelihood]]\nkind = "silhouette_bernoulli"\ngrid = [16, 12]\nsoft_px = 8.0\nfalse_alarm = 0.1\nmiss = 0.1\n'
# Angles before the frame, degrees: three ancestors. The kernel's systematic choice of ten of them keeps these weights exactly.
BEFORE = ((10.0, -25.0, 5.0, -30.0, 5.0), (0.0, -10.0, 20.0, -55.0, 20.0), (-8.0, -40.0, -15.0, -15.0, 0.0))
WEIGHTS = (0.5, 0.3, 0.2)
ANCESTORS = 10
# Draws of the walk that are tried at once.
TRIED = 1024


@partial(jax.tree_util.register_dataclass, meta_fields=["names"], data_fields=["body", "transition", "factors", "before"])
@dataclass(frozen=True, eq=False)
class Limb:
    """The model.

    Attributes:
        names: what is ranked: coordinates of markers, angles of each joint, the log of the potential and of the likelihood.
        body: the body.
        transition: the walk.
        factors: potential and likelihood.
        before: the weighted states of the frame before, of which one is true.
    """

    names: tuple[str, ...]
    body: Body
    transition: Transition
    factors: tuple[Factor, ...]
    before: Particles

    def density(self, data: Any, previous: Particles) -> Density:
        """The posterior of the frame."""
        return Density(self.transition, self.factors, data, previous)

    def quantities(self, parts: Any, data: Any) -> Any:
        """What is ranked."""
        density, placement = self.density(data, self.before), self.body.placement
        assert isinstance(placement, ByParts)
        parents = placement.parents
        state, joints = {"parts": parts}, np.arange(1, len(parents))
        relative = rigid.relative(parts[np.array(parents)[joints]], parts[joints])
        potential, likelihood = density.log_potential(state, density.ancestor(0)), density.log_likelihood(state, density.ancestor(0))
        angles = rotations.logarithm(relative[:, 3:])
        return jnp.concatenate([placed_markers(self.body, parts).ravel(), angles.ravel(), jnp.stack([potential, likelihood])])


def limb(likelihood: str = MARKERS, weights: tuple[float, ...] = WEIGHTS) -> Limb:
    """The model in a room of four cameras.

    Args:
        likelihood: the likelihood's table.
        weights: those of the states before.
    """
    model = model_in_a_room(parse_definition("arm", MODEL.replace("LIKELIHOOD", likelihood), None))
    body, poses = model.body, jnp.radians(jnp.asarray(BEFORE[: len(weights)]))
    assert isinstance(body.placement, ByParts)
    parts = jax.vmap(lambda pose: body.placement.configuration(body.skeleton, pose))(poses)
    marker = [f"{marker} {axis}" for marker in body.markers.names for axis in AXES]
    joint = [f"{part} r{axis}" for part in body.placement.names[1:] for axis in AXES]
    names = (*marker, *joint, "log-potential", "log-likelihood")
    return Limb(names, body, model.transition, model.factors, Particles({"parts": parts}, jnp.log(jnp.asarray(weights))))


def draw_prior(key: Any, limb: Limb) -> Any:
    """Draw the parts from the exact prior of the frame, by rejection."""
    potential: Any = next(factor for factor in limb.factors if factor.side == "prior").log_potential
    highest = jnp.sum(potential.parameters["log_weight"])

    def one(key: Any) -> tuple[Any, Any]:
        ancestor_key, step_key, accept_key = jax.random.split(key, 3)
        ancestor = jax.random.categorical(ancestor_key, limb.before.log_weights)
        parts = limb.transition.sample(step_key, jax.tree.map(lambda leaf: leaf[ancestor], limb.before.states))["parts"]
        return parts, jnp.log(jax.random.uniform(accept_key)) < jnp.sum(potential.log_potentials(parts)) - highest

    def again(tried: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        parts, accepted = jax.vmap(one)(jax.random.split(jax.random.fold_in(key, tried[0]), TRIED))
        return tried[0] + 1, parts[jnp.argmax(accepted)], jnp.any(accepted)

    start = (jnp.zeros((), int), limb.before.states["parts"][0], jnp.zeros((), bool))
    return jax.lax.while_loop(lambda tried: ~tried[2], again, start)[1]


class Ranked(NamedTuple):
    """A replication: ranks of the truth, effective size of the draws, and whether the kernel lost the frame."""

    ranks: Any
    ess: Any
    lost: Any


def replicate(kernel: Callable[..., Any], particles: int, bins: int) -> Callable[..., Ranked]:
    """One replication as a function of its key and the limb: a truth, its data, and its ranks among bins - 1 draws of the kernel."""

    def one(key: Any, limb: Limb) -> Ranked:
        truth_key, data_key, kernel_key, draw_key = jax.random.split(key, 4)
        truth = draw_prior(truth_key, limb)
        data = limb.density({}, limb.before).simulate(data_key, {"parts": truth})
        # As many particles go in as come out: copies of the states before, by weight.
        copies = np.repeat(np.arange(len(WEIGHTS)), np.round(np.array(WEIGHTS) * particles).astype(int))
        parts = limb.before.states["parts"][copies % limb.before.log_weights.shape[0]]
        previous = point_mass({"parts": parts[0]}, particles)._replace(states={"parts": parts})
        after, info = kernel(kernel_key, previous, limb.density(data, previous))
        chosen = jax.random.categorical(draw_key, after.log_weights, shape=(bins - 1,))
        found = jax.lax.map(lambda parts: limb.quantities(parts, data), jnp.concatenate([truth[None], after.states["parts"][chosen]]))
        return Ranked(jnp.sum(found[1:] < found[0], axis=0), info.ess, info.lost)

    return one
