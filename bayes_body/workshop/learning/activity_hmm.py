r"""Learn an activity from captured motion: a linear subspace of its joint angles, and a hidden Markov model in it (Darby et al. 2008, 4 and 5).

Each motion is retargeted to a body. Its angles, without the root's and the head's, are brought to the same solutions and turns. Each person's mean
pose is subtracted. The first principal components are the features. A model with Gaussian emissions says how they change from frame to frame. With
several activities there is one model for each, and a small probability of changing from one to another.

The learned model tells how well a motion fits an activity, and motion can be drawn from it.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from sklearn.decomposition import PCA

from bayes_body.base.errors import input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.shapes import Key
from bayes_body.model.body.build import build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import Topology
from bayes_body.model.dynamics.activity import Activity
from bayes_body.workshop.learning.activity_motions import Captured, frames_of, half_of_largest_change, learned_dofs
from bayes_body.workshop.learning.baum_welch import Hmm, log_likelihood, padded
from bayes_body.workshop.learning.hmm_choice import Chosen, Track, choose, joined, shares_of
from bayes_body.workshop.learning.walking_angles import ROOT, alike, near_reference

# What the features leave of a dof is taken as at least this, degrees.
LEAST_DEG = 0.5
# Motions with less variance than this show no motion, radians².
STILL = 1e-12
# A motion that is less likely than the others by more nats per frame is reported.
FAR = 10.0


class LearnOptions(NamedTuple):
    """What is learned.

    Attributes:
        components: number of features.
        states: number of states, of all activities together.
        fps: frames per second of the motions.
        restarts: number of starts, of which the best on motion held out is used.
        seed: of the first start.
        switch_per_s: probability of another activity, per second.
        learn_initial: whether to estimate the initial probabilities of the states; otherwise they are equal.
    """

    components: int = 4
    states: int = 30
    fps: float = 60.0
    restarts: int = 4
    seed: int = 0
    switch_per_s: float = 0.2
    learn_initial: bool = False


class LearnedActivity(NamedTuple):
    """An activity, log-likelihoods in training and of motion held out (nats per frame), and sentences about the data."""

    activity: Activity
    training: float
    held_out: float
    sentences: tuple[str, ...]


def learn_activity(
    motions: Sequence[Captured], body: str, schema: BodySchema, options: LearnOptions = LearnOptions(), watch: Watch = unwatched
) -> LearnedActivity:
    """Learn an activity, or several, from motions of one or more people.

    Raises:
        InputError: too few frames for the states, no motion at all, or more components than dofs.
    """
    topology = build_body(body, schema).skeleton.topology
    frames = frames_of(motions)
    shares = shares_of(frames, options.states)
    names, space = _subspace(motions, body, schema, options.components)
    chosen = _chosen(motions, space.tracks, shares, options, watch)
    hmm = joined([choice.hmm for choice in chosen.values()], options.switch_per_s / options.fps)
    several = len(space.subjects) > 1
    activity = Activity(
        body=body,
        names=names,
        subjects=space.subjects,
        labels=tuple(label for label, count in shares.items() for _ in range(count)),
        means=space.means,
        between=space.means.std(axis=0, ddof=1) if several else np.zeros(len(names)),
        centre=space.centre,
        basis=space.basis,
        residual=np.maximum(space.residual, np.radians(LEAST_DEG)),
        **{key: np.asarray(value, float) for key, value in hmm._asdict().items()},
        change=half_of_largest_change([motion.dofs for motion in motions], topology),
        low=space.low,
        high=space.high,
        kept=space.explained,
        fps=options.fps,
    )
    weights = np.array(list(frames.values())) / sum(frames.values())
    training, held_out = (float(weights @ [getattr(choice, key) for choice in chosen.values()]) for key in ("training", "held_out"))
    return LearnedActivity(activity, training, held_out, tuple(_sentences(motions, space.subjects, chosen)))


class _Subspace(NamedTuple):
    """What is known of the learned angles before their order in time: see `Activity`. Tracks have the features of the motions."""

    tracks: list[Track]
    subjects: tuple[str, ...]
    means: Float[np.ndarray, "subject dof"]
    centre: Float[np.ndarray, " dof"]
    basis: Float[np.ndarray, "dof feature"]
    residual: Float[np.ndarray, " dof"]
    low: Float[np.ndarray, " dof"]
    high: Float[np.ndarray, " dof"]
    explained: float


def _subspace(motions: Sequence[Captured], body: str, schema: BodySchema, components: int) -> tuple[tuple[str, ...], _Subspace]:
    """Return the names of the learned dofs, and their subspace."""
    skeleton = build_body(body, schema).skeleton
    places = learned_dofs(skeleton.topology)
    if not 1 <= components <= len(places):
        raise input_error("components", f"{components}", f"1 to {len(places)}, the number of learned angles of the body", "correct it")
    limits = (np.asarray(side, float)[ROOT:] for side in (skeleton.low, skeleton.high))
    poses = [pose[:, places - ROOT] for pose in alike([motion.dofs[:, ROOT:] for motion in motions], skeleton.topology, *limits)]
    owners = [motion.subject for motion in motions]
    subjects = tuple(dict.fromkeys(owners))
    means = np.stack(
        [np.concatenate([pose for pose, owner in zip(poses, owners, strict=True) if owner == person]).mean(axis=0) for person in subjects]
    )
    deviations = [pose - means[subjects.index(owner)] for pose, owner in zip(poses, owners, strict=True)]
    every, stacked = np.concatenate(poses), np.concatenate(deviations)
    if stacked.var(axis=0).sum() < STILL:
        raise input_error("the motions", "all frames alike", "motion", "give others")
    pca = PCA(components, svd_solver="full").fit(stacked)
    residual = np.sqrt(np.mean((stacked - pca.inverse_transform(pca.transform(stacked))) ** 2, axis=0))
    tracks = [Track(owner, pca.transform(deviation)) for owner, deviation in zip(owners, deviations, strict=True)]
    explained, basis = float(pca.explained_variance_ratio_.sum()), np.asarray(pca.components_).T
    names = tuple(skeleton.topology.dof_names[k] for k in places)
    return names, _Subspace(tracks, subjects, means, np.asarray(pca.mean_), basis, residual, every.min(axis=0), every.max(axis=0), explained)


def _chosen(
    motions: Sequence[Captured], features: Sequence[Track], shares: Mapping[str, int], options: LearnOptions, watch: Watch
) -> dict[str, Chosen]:
    seeds = range(options.seed, options.seed + options.restarts)
    tracks = {label: [track for track, motion in zip(features, motions, strict=True) if motion.label == label] for label in shares}
    return {label: choose(tracks[label], count, seeds, options.learn_initial, watch) for label, count in shares.items()}


def _sentences(motions: Sequence[Captured], subjects: Sequence[str], chosen: Mapping[str, Chosen]) -> list[str]:
    sentences = []
    if len(subjects) == 1:
        sentences.append(f"only one person ({subjects[0]}): how the mean poses of people differ is not known")
    for label, choice in chosen.items():
        names = [motion.name for motion in motions if motion.label == label]
        for k, name in enumerate(names):
            other_motions = np.delete(choice.of_motion, k)
            if len(other_motions) and (ratio := float(np.median(other_motions) - choice.of_motion[k])) > FAR:
                sentences.append(f"{name}: {ratio:.1f} nats a frame less likely than the other motions of '{label}': perhaps another activity")
    return sentences


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
    first, transition_key, noise = jax.random.split(key, 3)
    begun = jax.random.categorical(first, initial)

    def step(state: Array, key: Key) -> tuple[Array, Array]:
        return jax.random.categorical(key, transition[state]), state

    _, states = jax.lax.scan(step, begun, jax.random.split(transition_key, frames))
    return locations[states] + jnp.einsum("tij,tj->ti", roots[states], jax.random.normal(noise, (frames, locations.shape[1])))
