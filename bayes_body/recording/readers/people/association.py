"""Every detection against everybody who is there: the shares of all people in all frames, a block of frames at a time."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.people.bodies import distances_of_offsets, offsets_px, sizes_of
from bayes_body.recording.readers.people.shares import MOST_EXACT, Shares, Weights, weights_of
from bayes_body.recording.session.session import CameraSpec

# Frames at a time: this bounds the memory in long recordings.
BLOCK = 256

type Exclusion = Callable[[Weights], Shares]


class ExpectedBodies(NamedTuple):
    """A person's body in each frame from the first to the last, as it is known without the frame's detections."""

    first: int
    bodies: Float[np.ndarray, "frame keypoint _"]

    def within(self, frames: range) -> Float[np.ndarray, "frame keypoint _"]:
        """Return the bodies of some frames, NaN where the person is not there."""
        bodies = np.full((len(frames), *self.bodies.shape[1:]), np.nan)
        start, stop = max(self.first, frames.start), min(self.first + len(self.bodies), frames.stop)
        if start < stop:
            bodies[start - frames.start : stop - frames.start] = self.bodies[start - self.first : stop - self.first]
        return bodies


class Association(NamedTuple):
    """A person's share of every detection, and its distance as a fraction of the person's size: by frame of the person, and camera."""

    shares: list[list[Float[np.ndarray, " detection"]]]
    misfits: list[list[Float[np.ndarray, " detection"]]]

    def take(self, frame: int, c: int, shares: np.ndarray, misfits: np.ndarray) -> None:
        """Take the shares and distances of a camera, padded, if the person is there in the frame."""
        if 0 <= frame < len(self.shares):
            count = len(self.shares[frame][c])
            self.shares[frame][c], self.misfits[frame][c] = shares[:count], misfits[:count]


def associate(
    cameras: Sequence[CameraSpec], people: Sequence[Sequence[People]], expected_bodies: Sequence[ExpectedBodies], exclude: Exclusion
) -> list[Association]:
    """Return the association of everybody.

    Args:
        cameras: calibrated, without motion.
        people: for each frame and camera.
        expected_bodies: of everybody.
        exclude: the shares of people who exclude each other, from their weights.
    """
    associations = [_of_nobody(people[person.first : person.first + len(person.bodies)]) for person in expected_bodies]
    for start in range(0, len(people), BLOCK):
        block = range(start, min(start + BLOCK, len(people)))
        present = [i for i, person in enumerate(expected_bodies) if person.first < block.stop and person.first + len(person.bodies) > start]
        if not present:
            continue
        expected = np.stack([expected_bodies[i].within(block) for i in present], axis=1)
        for c, camera in enumerate(cameras):
            groups = [people[frame][c] for frame in block]
            for rows in _of_like_counts(groups):
                shares, misfits = _compared(camera, expected[rows], [groups[row] for row in rows], exclude)
                for k, i in enumerate(present):
                    for j, row in enumerate(rows):
                        associations[i].take(block[row] - expected_bodies[i].first, c, shares[j, k], misfits[j, k])
    return associations


def _of_nobody(people: Sequence[Sequence[People]]) -> Association:
    return Association(*([[np.full(len(group), value) for group in frame] for frame in people] for value in (0.0, np.inf)))


def _of_like_counts(groups: Sequence[People]) -> list[list[int]]:
    """The places of the groups with some detections, in two lists: those that the exact sum can treat, and those that are too large for it."""
    counts = [len(group) for group in groups]
    small, large = ([row for row, count in enumerate(counts) if low < count <= high] for low, high in ((0, MOST_EXACT), (MOST_EXACT, np.inf)))
    return [rows for rows in (small, large) if rows]


def _compared(
    camera: CameraSpec, expected: Float[np.ndarray, "frame person keypoint _"], groups: Sequence[People], exclude: Exclusion
) -> tuple[Shares, Float[np.ndarray, "frame person detection"]]:
    """The shares and distances of groups of detections, padded with nobody."""
    padded = np.full((len(groups), max(map(len, groups)), *groups[0].shape[1:]), np.nan)
    for row, group in enumerate(groups):
        padded[row, : len(group)] = group
    offsets, sizes = offsets_px(camera, expected, padded), sizes_of(padded)
    misfits = distances_of_offsets(offsets, sizes)
    possible = np.isfinite(misfits)
    # Where nothing can be compared, the numbers have no effect.
    weights = weights_of(np.where(possible[..., None], offsets, 0.0), np.where(sizes > 0, sizes, 1.0), float(np.prod(camera.size_px)))
    return exclude(np.where(possible, weights, 0.0)), misfits
