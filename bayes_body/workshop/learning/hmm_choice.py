"""Choose among several starts of Baum and Welch's algorithm, and join several activities in one hidden Markov model.

The chosen start is the one whose models best explain the motion that they were not learned from. For each person, a model is learned from the motion
of the others, and the log-likelihood of this person's motion is taken. With one person, or if the others have fewer frames than there are states, the
last fifth of each motion is held out instead. The model itself is then learned from all motion, from the same seed.

The joint model records how many states each activity has, and how one activity changes to another.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from sklearn.cluster import KMeans

from bayes_body.base.errors import input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.workshop.learning.baum_welch import FLOOR, Hmm, Sequences, fit, log_likelihood, padded

# The share of each motion that is held out if all are of one person.
LAST = 0.2


class Track(NamedTuple):
    """The features of one motion, and the person."""

    subject: str
    features: Float[np.ndarray, "_ feature"]


class Chosen(NamedTuple):
    """The model, the seed of its start, and log-likelihoods, nats per frame: in training, held out, and held out of each motion."""

    hmm: Hmm
    seed: int
    training: float
    held_out: float
    of_motion: Float[np.ndarray, " motion"]


class _Fold(NamedTuple):
    learned: list[np.ndarray]
    validation: dict[int, np.ndarray]


def choose(tracks: Sequence[Track], states: int, seeds: Sequence[int], learn_initial: bool = False, watch: Watch = unwatched) -> Chosen:
    """Learn a model from all motions, from the start that is best on motion held out.

    Args:
        tracks: the motions.
        states: number of states.
        seeds: one for each start.
        learn_initial: whether to estimate the initial probabilities; otherwise they are equal (Darby et al. 2008, 5).
        watch: shows the progress over the folds and the last fit.
    """
    folds, count = _folds(tracks, states), len(tracks)
    log_likelihoods = np.zeros((len(seeds), count))
    last: Chosen | None = None
    for number in watch(range(len(folds) + 1)):
        learned = folds[number].learned if number < len(folds) else [track.features for track in tracks]
        data = padded(learned, count)
        fits = fit(starts(np.concatenate(learned), states, seeds), data, learn_initial=learn_initial)
        models = [Hmm(*(part[k] for part in fits.hmm)) for k in range(len(seeds))]
        if number < len(folds):
            places, validation = list(folds[number].validation), padded(list(folds[number].validation.values()), count)
            for row, model in zip(log_likelihoods, models, strict=True):
                row[places] = log_likelihood(model, validation)[: len(places)]
        else:
            last = _best(models, np.asarray(fits.log_likelihood) / _frames(data), log_likelihoods, _held_frames(folds, count), seeds)
    assert last is not None
    return last


def _best(models: Sequence[Hmm], training: np.ndarray, log_likelihoods: np.ndarray, frames: np.ndarray, seeds: Sequence[int]) -> Chosen:
    scores = log_likelihoods.sum(axis=1) / frames.sum()
    best = int(np.nanargmax(scores))
    return Chosen(models[best], seeds[best], float(training[best]), float(scores[best]), log_likelihoods[best] / frames)


def _folds(tracks: Sequence[Track], states: int) -> list[_Fold]:
    people = list(dict.fromkeys(track.subject for track in tracks))
    folds = [
        _Fold([t.features for t in tracks if t.subject != person], {k: t.features for k, t in enumerate(tracks) if t.subject == person})
        for person in people
    ]
    if all(sum(map(len, fold.learned)) >= states for fold in folds):
        return folds
    ends = [len(track.features) - max(round(LAST * len(track.features)), 1) for track in tracks]
    first = [track.features[:end] for track, end in zip(tracks, ends, strict=True) if end]
    return [_Fold(first, {k: track.features[end:] for k, (track, end) in enumerate(zip(tracks, ends, strict=True))})]


def _held_frames(folds: Sequence[_Fold], count: int) -> Float[np.ndarray, " motion"]:
    frames = np.zeros(count)
    for fold in folds:
        for place, features in fold.validation.items():
            frames[place] = len(features)
    return frames


def _frames(data: Sequences) -> int:
    return int(np.asarray(data.mask).sum())


def starts(frames: Float[np.ndarray, "frame feature"], states: int, seeds: Sequence[int]) -> Hmm:
    """Return a start for each seed: k-means, random transitions, and equal initial probabilities.

    The covariance of a cluster is mixed with the mean one, with the weight of as many frames as a covariance needs: a cluster may have one frame.
    """
    return Hmm(*(np.stack(part) for part in zip(*(_start(frames, states, seed) for seed in seeds), strict=True)))


def _start(frames: Float[np.ndarray, "frame feature"], states: int, seed: int) -> Hmm:
    clusters = KMeans(states, random_state=seed).fit(frames)
    memberships = np.eye(states)[clusters.labels_]
    deviations = frames - clusters.cluster_centers_[clusters.labels_]
    squares, needed = np.einsum("tn,ti,tj->nij", memberships, deviations, deviations), frames.shape[1] + 1
    common = squares.sum(axis=0) / len(frames) + FLOOR * frames.var(axis=0).mean() * np.eye(frames.shape[1])
    covariances = (squares + needed * common) / (memberships.sum(axis=0) + needed)[:, None, None]
    transition = np.random.default_rng(seed).uniform(size=(states, states))
    initial = np.full(states, 1 / states)
    return Hmm(initial, transition / transition.sum(axis=1, keepdims=True), clusters.cluster_centers_.astype(float), covariances)


# Fewest frames of each state, and fewest states of each activity.
FRAMES, STATES = 10, 4


def shares_of(frames: Mapping[str, int], states: int) -> dict[str, int]:
    """Return the number of states of each activity, in proportion to its frames, and at least `STATES`. One activity has all states.

    Raises:
        InputError: too few states for the activities, or too few frames for the states.
    """
    shares = _in_proportion(frames, states) if len(frames) > 1 else dict.fromkeys(frames, states)
    for label, count in shares.items():
        if frames[label] < FRAMES * count:
            problem = f"{frames[label]} frames for {count} states"
            raise input_error(f"activity '{label}'", problem, f"at least {FRAMES} frames a state", "learn fewer states, or give more motion")
    return shares


def _in_proportion(frames: Mapping[str, int], states: int) -> dict[str, int]:
    if states < STATES * len(frames):
        problem = f"{states} for {len(frames)} activities"
        raise input_error("states", problem, f"at least {STATES} for each activity", "learn more states, or fewer activities")
    shares = dict.fromkeys(frames, STATES)
    for _ in range(states - sum(shares.values())):
        # The next state goes to the activity that has most frames for each state.
        shares[max(shares, key=lambda label: frames[label] / shares[label])] += 1
    return shares


def joined(models: Sequence[Hmm], switch: float) -> Hmm:
    """Return one model of several, with the probability `switch` per frame of leaving one for the states of the others.

    Those states are as likely then as after a long time in their own model. The initial probabilities are shared in proportion to the states.
    """
    sizes = [len(model.initial) for model in models]
    ends = np.cumsum(sizes)
    blocks = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    switch = switch if len(models) > 1 else 0.0
    transition = np.zeros((ends[-1], ends[-1]))
    for row, model in zip(blocks, models, strict=True):
        for column, target in zip(blocks, models, strict=True):
            switches = switch / max(len(models) - 1, 1) * stationary(np.asarray(target.transition))
            transition[row, column] = (1 - switch) * np.asarray(model.transition) if row == column else switches
    initial = np.concatenate([size / ends[-1] * np.asarray(model.initial) for size, model in zip(sizes, models, strict=True)])
    return Hmm(initial, transition, *(np.concatenate([np.asarray(model[k]) for model in models]) for k in (2, 3)))


def stationary(transition: Float[np.ndarray, "state state"]) -> Float[np.ndarray, " state"]:
    """Return the probabilities of the states after a long time, from equal ones at first."""
    # A chain that stays with probability 1/2 has the same ones, and never alternates.
    lazy = (np.eye(len(transition)) + transition) / 2
    probabilities = np.linalg.matrix_power(lazy, 2**14).mean(axis=0)
    return probabilities / probabilities.sum()
