"""Captured motions that an activity is learned from, as dofs of a body."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import Topology
from bayes_body.recording.readers.mocap import landmarks, resample
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.workshop.learning.gait import fault_of_walk
from bayes_body.workshop.learning.walking_angles import ROOT, retargeted

# Dofs that are not learned, besides the root's.
FREE = "head_"


class Captured(NamedTuple):
    """A motion of a person: its name, the person, the activity, and all dofs of the body in each frame, radians and metres."""

    name: str
    subject: str
    label: str
    dofs: Float[np.ndarray, "_ body_dof"]


def no_walk(name: str, motion: Motion) -> str | None:
    """Return why a motion is not used as a walk, or None."""
    return fault_of_walk(name, landmarks(motion), motion.fps)


def captured(name: str, subject: str, label: str, motion: Motion, body: str, schema: BodySchema, fps: float) -> Captured:
    """Retarget a motion to a body, at `fps`. Angles that its points leave open are those nearest to rest.

    Raises:
        InputError: the motion has fewer frames per second, or lacks points of the body; the body's first joint has not six dofs.
    """
    check_rate(name, motion.fps, fps)
    return Captured(name, subject, label, retargeted(resample(motion, fps), body, schema))


def check_rate(name: str, rate: float, fps: float) -> None:
    """Check that a motion has at least `fps` frames per second: frames in between would be invented.

    Raises:
        InputError: it has fewer.
    """
    if rate < fps * (1 - 1e-6):
        raise input_error(name, f"{rate:g} frames a second", f"{fps:g} or more", f"leave it out, or learn at {rate:g}")


def learned_dofs(topology: Topology) -> Int[np.ndarray, " learned"]:
    """Return the places of the learned dofs among those of the body: all but the root's and the head's."""
    return np.array([k for k, name in enumerate(topology.dof_names) if k >= ROOT and not name.startswith(FREE)])


def frames_of(motions: Sequence[Captured]) -> dict[str, int]:
    """Return the number of frames of each activity.

    Raises:
        InputError: no motion at all.
    """
    if not motions:
        raise input_error("the motions", "none", "at least one", "give captured motion of the activity")
    labels = dict.fromkeys(motion.label for motion in motions)
    return {label: sum(len(motion.dofs) for motion in motions if motion.label == label) for label in labels}


def half_of_largest_change(tracks: Sequence[Float[np.ndarray, "_ dof"]], topology: Topology) -> Float[np.ndarray, " dof"]:
    """Return for every dof half the largest change between two frames (Darby et al. 2008, (10)); full turns are no change."""
    unwrapped = [np.where(topology.angular, np.unwrap(track, axis=0), track) for track in tracks]
    return np.max([np.abs(np.diff(track, axis=0)).max(axis=0, initial=0.0) for track in unwrapped], axis=0) / 2
