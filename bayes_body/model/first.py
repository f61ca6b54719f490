r"""The distribution of the state before the first frame: a first pose, which may be uncertain.

$$s \sim \mathcal N(s_0, \sigma_0^2)\ \text{truncated to the joint limits}, \qquad \text{state} = \mathrm{begin}(s).$$

The standard deviations are those of the definition's table `[first]`. Dofs without one are certain: only the first transition spreads them. Where the
pose was found in pictures, $s_0$ is one of several equally likely poses. What the pose leaves open, such as a velocity, is drawn from a distribution
of the motion prior (`Transition.first`).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Key, Keys, Pose
from bayes_body.density.factor import State, Transition, draw
from bayes_body.kernels.laplace.proposal import balanced_noise
from bayes_body.model.body.solids import Body
from bayes_body.model.definition import FirstTable
from bayes_body.model.dynamics.diffusion import TruncatedWalk, by_dof, known_deviations


class First(NamedTuple):
    """The distribution of the state before the first frame.

    Attributes:
        pose: the most likely pose, radians and metres.
        sd: its standard deviations; 0 where the pose is certain.
        low: limits of each dof, or -∞.
        high: limits of each dof, or ∞.
        transition: the motion prior, whose `begin` makes a state of a pose.
        mode: the state of the most likely pose.
        draws: poses that are equally likely and take the place of `pose`, if there are any.
        resting_pose: the angle about which a dof is drawn in place of `pose` and `draws`; NaN for the others. None: there is no such dof.
    """

    pose: Pose
    sd: Pose
    low: Pose
    high: Pose
    transition: Transition
    mode: State
    draws: Float[Array, "draw dof"] | None = None
    resting_pose: Pose | None = None

    def start_evenly(self, key: Key, count: int) -> State:
        """Draw `count` states whose standard normal numbers have exactly the mean 0 and the covariance I, all variables together.

        In many dimensions, the covariance of independent draws differs much from that of their distribution: with 512 draws of 100 entries, variances
        in some directions are twice too large. What the pose leaves open must be normal. Of several equally likely poses, draws are independent.
        """
        opening = self.transition.first
        if self.draws is not None or opening is None:
            return self.start(key, count)
        widths = {name: opening_variable.event_shape[0] for name, opening_variable in opening(self.mode).items()}
        noise = balanced_noise(key, count, self.pose.shape[0] + sum(widths.values())).astype(self.pose.dtype)
        return jax.vmap(lambda row: self._state_at(row))(noise)

    def _state_at(self, noise: Float[Array, " entry"]) -> State:
        """Return the state at standard normal numbers."""
        assert self.transition.first is not None
        pose, noise = (
            self._pose_near(self.pose, lambda walk: walk.icdf(jax.scipy.stats.norm.cdf(noise[: self.pose.shape[0]]))),
            noise[self.pose.shape[0] :],
        )
        state = dict(self.transition.begin({"pose": pose}))
        for name, distribution in self.transition.first(state).items():
            width = distribution.event_shape[0]
            normal: Any = distribution
            state[name], noise = normal.base_dist.loc + normal.base_dist.scale * noise[:width], noise[width:]
        return state

    @property
    def is_point(self) -> bool:
        """Whether the first state is certain."""
        return self.draws is None and self.transition.first is None and not bool((np.asarray(self.sd) > 0).any())

    def centred_on(self, pose: Pose, draws: Float[Array, "draw dof"] | None = None) -> "First":
        """Return the distribution around another pose, or around several of which it is the most likely one."""
        return self._replace(pose=pose, mode=self.transition.begin({"pose": pose}), draws=draws)

    def make_certain(self, state: State) -> "First":
        """Return the distribution of one certain state."""
        settled = replace(self.transition, first=None)
        return self._replace(
            pose=state.get("pose", self.pose), sd=jnp.zeros_like(self.sd), transition=settled, mode=state, draws=None, resting_pose=None
        )

    def sample(self, key: Key) -> State:
        """Draw a state."""
        if self.draws is None:
            return self.draw_near(key, self.pose)
        pose_key, near_key = jax.random.split(key)
        return self.draw_near(near_key, jax.random.choice(pose_key, self.draws))

    def start(self, key: Key, count: int) -> State:
        """Draw `count` states, with a leading particle axis. A certain pose needs no random numbers. Of several, each is taken equally often."""
        if self.is_point:
            return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), dict(self.mode))
        if self.draws is None:
            return _draw_all_near(self, jax.random.split(key, count), jnp.broadcast_to(self.pose, (count, *self.pose.shape)))
        order_key, near_key = jax.random.split(key)
        poses = jax.random.permutation(order_key, self.draws)[np.arange(count) % len(self.draws)]
        return _draw_all_near(self, jax.random.split(near_key, count), poses)

    def draw_near(self, key: Key, pose: Pose) -> State:
        """Draw a state near a pose."""
        state = self.transition.begin({"pose": self._pose_near(pose, lambda walk: walk.sample(key))})
        if self.transition.first is None:
            return state
        return {**state, **draw(jax.random.fold_in(key, 1), self.transition.first(state))}

    def _pose_near(self, pose: Pose, draw_from: Callable[[TruncatedWalk], Pose]) -> Pose:
        if self.resting_pose is not None:
            pose = jnp.where(jnp.isnan(self.resting_pose), pose, self.resting_pose)
        uncertain = self.sd > 0
        return jnp.where(uncertain, draw_from(TruncatedWalk(pose, jnp.where(uncertain, self.sd, 1.0), self.low, self.high)), pose)


@jax.jit
def _draw_all_near(first: First, keys: Keys, poses: Float[Array, "draw dof"]) -> State:
    # `first` is an argument. If it were a constant, numpyro would check its values, with many small programs.
    return jax.vmap(lambda key, pose: first.draw_near(key, pose))(keys, poses)


def first_of(table: FirstTable, body: Body, pose: Pose, transition: Transition) -> First:
    """Return the distribution around a pose.

    Raises:
        InputError: a key of the table matches no dof.
    """
    topology = body.skeleton.topology
    deviations = known_deviations(table.sd_deg, table.sd_m, topology, "first.")
    sd = device_array([deviations.get(name, 0.0) for name in topology.dof_names], body.lengths.dtype)
    angles = tuple(name for name, unit in zip(topology.dof_names, topology.dof_units, strict=True) if unit == "rad")
    rest_deg = by_dof(table.rest_deg, angles, "first.rest_deg")
    resting_pose = device_array([math.radians(rest_deg.get(name, math.nan)) for name in topology.dof_names], body.lengths.dtype) if rest_deg else None
    return First(pose, sd, body.skeleton.low, body.skeleton.high, transition, transition.begin({"pose": pose}), resting_pose=resting_pose)
