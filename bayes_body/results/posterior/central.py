r"""The one body that is drawn for a posterior: its mean if that lies among the draws, else the medoid of the draws.

The mean of a posterior with several modes can be a pose that the posterior excludes: if one mode faces the camera and another faces away, the arms of
the mean are inside the trunk. A draw is never such a pose.

Two poses have the distance $d(a, b) = \sqrt{\mathrm{mean}_k\, |a_k - b_k|^2}$ of the ends of their parts, metres. Around a pose a, $r(a)$ is the
smallest radius within which 5 % of the posterior lies, without the draws that are at a itself. The mean lies among the draws if $r$ of the mean is at
most the 90 % quantile of $r$ of the draws: the posterior is no thinner there than around nine of ten draws. The medoid is the draw with the smallest
mean distance to all others. It is also taken if there are so few different draws that their density is unknown.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.distance import cdist

from bayes_body.base.shapes import Configuration
from bayes_body.model.body.solids import Body, configuration_space, part_transforms

# So many draws are compared, and fewer than FEWEST different ones tell nothing.
DRAWS, FEWEST = 128, 8
SHARE, LEVEL = 0.05, 0.9
# Poses that are closer than this, metres, are the same draw: a Markov chain that stayed where it was.
SAME_M = 1e-5


class CentralPose(NamedTuple):
    """The pose that stands for a posterior.

    Attributes:
        pose: radians and metres, or a value of the variable that places the body.
        is_mean: whether it is the mean; else it is the medoid of the draws.
    """

    pose: Float[np.ndarray, "*shape"]
    is_mean: bool


def central_pose(body: Body, poses: Float[np.ndarray, "draw *shape"], weights: Float[np.ndarray, " draw"]) -> CentralPose:
    """Return the mean of weighted draws if it lies among them, else their medoid.

    Args:
        body: the body.
        poses: draws of all runs together, radians and metres.
        weights: not negative, and not all zero.
    """
    weights = np.asarray(weights, float) / np.sum(weights)
    mean = np.asarray(configuration_space(body).mean(weights, poses))
    chosen, shares = thinned(weights)
    # The last one is the mean.
    points = np.asarray(part_ends(body, jnp.asarray(np.concatenate([poses[chosen], mean[None]]), body.lengths.dtype)), float)
    distance_matrix = distances(points)
    if lies_among(distance_matrix[-1, :-1], distance_matrix[:-1, :-1], shares):
        return CentralPose(mean, True)
    return CentralPose(np.asarray(poses[chosen[(distance_matrix[:-1, :-1] @ shares).argmin()]]), False)


def thinned(weights: Float[np.ndarray, " draw"]) -> tuple[Int[np.ndarray, " place"], Float[np.ndarray, " place"]]:
    """Return the places of DRAWS draws, evenly spaced by weight, and their shares; where a place is repeated, the first one has the whole share."""
    levels = (np.arange(DRAWS) + 0.5) / DRAWS
    places = np.minimum(np.searchsorted(np.cumsum(weights), levels), len(weights) - 1)
    first = np.concatenate([[True], np.diff(places) > 0])
    shares = np.zeros(DRAWS)
    shares[first] = np.diff(np.append(np.flatnonzero(first), DRAWS)) / DRAWS
    return places, shares


def distances(points: Float[np.ndarray, "pose point 3"]) -> Float[np.ndarray, "pose pose"]:
    """Return the root mean squared distance between the points of every two poses, metres."""
    flat = points.reshape(len(points), -1)
    # Not by a matrix product: the threads of BLAS wait for each other for longer than this takes.
    return cdist(flat, flat) / np.sqrt(points.shape[1])


def lies_among(to_draws: Float[np.ndarray, " draw"], between: Float[np.ndarray, "draw draw"], shares: Float[np.ndarray, " draw"]) -> bool:
    """Return whether a pose lies among weighted draws; also if all draws are the same.

    Args:
        to_draws: its distances to the draws.
        between: distances between the draws.
        shares: weights of the draws, with the sum 1.
    """
    drawn = between[shares > 0][:, shares > 0]
    different = len(drawn) - np.triu(drawn < SAME_M, 1).any(axis=0).sum()
    if different == 1:
        return True
    *radii, radius = _radii(np.concatenate([between, to_draws[None]]), shares)
    return bool(different >= FEWEST and radius <= _quantiles(np.array([radii]), shares[None], LEVEL)[0])


def _radii(distance_matrix: Float[np.ndarray, "pose draw"], shares: Float[np.ndarray, " draw"]) -> Float[np.ndarray, " pose"]:
    """Return the smallest radius around each pose within which SHARE of the weight of the draws elsewhere lies."""
    return _quantiles(distance_matrix, np.where(distance_matrix < SAME_M, 0, shares), SHARE)


def _quantiles(values: Float[np.ndarray, "row value"], shares: Float[np.ndarray, "row value"], level: float) -> Float[np.ndarray, " row"]:
    """Return the smallest value of each row with at least the fraction `level` of the row's weight at or below it."""
    order = np.argsort(values, axis=1, kind="stable")
    cumulative = np.cumsum(np.take_along_axis(shares, order, axis=1), axis=1)
    # Sums of the same shares in another order differ by their rounding.
    places = (cumulative >= (level - 1e-9) * cumulative[:, -1:]).argmax(axis=1)
    return np.take_along_axis(values, np.take_along_axis(order, places[:, None], axis=1), axis=1)[:, 0]


@jax.jit
def part_ends(body: Body, poses: Float[Array, "draw *shape"]) -> Float[Array, "draw point 3"]:
    """Return both ends of every part's axis in the world, metres."""

    def ends(configuration: Configuration) -> Float[Array, "point 3"]:
        T_world_part = part_transforms(body, configuration)
        return jnp.concatenate([T_world_part.origin, T_world_part.origin + body.lengths[:, None] * T_world_part.z])

    return jax.vmap(ends)(poses)
