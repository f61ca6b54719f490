"""Motion and an activity's model: how well a motion fits it, and motion that is drawn from it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key
from bayes_body.model.body.skeleton import Topology
from bayes_body.model.dynamics.activity import Activity
from bayes_body.workshop.learning.baum_welch import Hmm, log_likelihood, padded
from bayes_body.workshop.learning.walking_angles import ROOT, near_reference

# Frames that are drawn from an activity to know how likely its own motion is, and how often.
DRAWN, DRAWS = 300, 10


def angles_for(activity: Activity, dofs: Float[np.ndarray, "frame body_dof"], topology: Topology) -> Float[np.ndarray, "frame dof"]:
    """Return the learned angles of another motion of the same body, by the solutions and turns that are nearest to the activity's."""
    reference = np.zeros(len(topology.dof_names))
    places = np.array([topology.dof_names.index(name) for name in activity.names])
    reference[places] = activity.means.mean(axis=0) + activity.centre
    return near_reference(topology, dofs[:, ROOT:], reference[ROOT:])[:, places - ROOT]


def log_likelihood_ratio(activity: Activity, angles: Float[np.ndarray, "frame dof"]) -> float:
    """Return how much less likely a motion is than motion that the activity itself draws, nats per frame.

    It is near 0 for motion like that of training, and far below 0 for another activity. The motion's own mean pose is subtracted, because that of a
    new person is unknown.

    Args:
        activity: the activity.
        angles: its dofs in each frame, radians; at the activity's frame rate, by the solutions and turns of `angles_for`.
    """
    drawn = [np.asarray(_drawn(*_arrays(activity), jax.random.key(draw), DRAWN), float) for draw in range(DRAWS)]
    features = (angles - angles.mean(axis=0)) @ activity.basis
    model = Hmm(activity.initial, activity.transition, activity.locations, activity.covariances)
    baseline = log_likelihood(model, padded(drawn)).sum() / (DRAWN * DRAWS)
    return float(log_likelihood(model, padded([features]))[0] / len(angles) - baseline)


def emitted(activity: Activity, frames: int, key: Key) -> Float[np.ndarray, "frame dof"]:
    """Draw a sequence of states and a feature vector from each, and return the joint angles of the mean person, radians.

    The features of two frames are independent given the states, so the motion jitters.
    """
    drawn = np.asarray(_drawn(*_arrays(activity), key, frames), float)
    return activity.means.mean(axis=0) + activity.centre + drawn @ activity.basis.T


def _arrays(activity: Activity) -> tuple[Array, Array, Array, Array]:
    initial, transition = (jnp.log(jnp.asarray(part)) for part in (activity.initial, activity.transition))
    return initial, transition, jnp.asarray(activity.locations), jnp.asarray(np.linalg.cholesky(activity.covariances))


@partial(jax.jit, static_argnames="frames")
def _drawn(initial: Array, transition: Array, locations: Array, roots: Array, key: Key, frames: int) -> Float[Array, "frame feature"]:
    first, later, noise = jax.random.split(key, 3)
    begun = jax.random.categorical(first, initial)

    def step(state: Array, key: Key) -> tuple[Array, Array]:
        return jax.random.categorical(key, transition[state]), state

    _, states = jax.lax.scan(step, begun, jax.random.split(later, frames))
    return locations[states] + jnp.einsum("tij,tj->ti", roots[states], jax.random.normal(noise, (frames, locations.shape[1])))
