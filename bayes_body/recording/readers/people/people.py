"""The people of a recording: where and when everybody is, in which detections, and with which probability."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.progress import Watch, unwatched
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.people.association import Association, Exclusion, ExpectedBodies, associate
from bayes_body.recording.readers.people.shares import joint_shares
from bayes_body.recording.readers.people.tracks import Track, follow_people
from bayes_body.recording.session.session import CameraSpec

# Where the second is seen by this share of the pictures in which the first one is, who is meant may be another.
CLOSE = 0.8
CLOSE_REMARK = "Person 2 is seen nearly as much as person 1: look at the pictures of both before you take person 1 for the subject."


class Person(NamedTuple):
    """A person of a recording.

    Attributes:
        number: from 1 on, by the number of pictures in which the person is seen.
        first: the first frame, counted from 0.
        last: the last frame.
        places: the likeliest detection of each camera, by the rows of the frames from first to last; -1 where it is likelier that the person is not
            detected.
        shares: for each of these frames and each camera, the probability of every detection.
        bodies: for each of these frames, metres, or pixels with one camera; NaN where not known.
        misfit: median distance of the detections from the body, as a fraction of the person's size in the image.
    """

    number: int
    first: int
    last: int
    places: Int[np.ndarray, "frame camera"]
    shares: list[list[Float[np.ndarray, " detection"]]]
    bodies: Float[np.ndarray, "frame keypoint _"]
    misfit: float

    @property
    def frames(self) -> int:
        """The number of frames from the first to the last."""
        return self.last - self.first + 1

    @property
    def pictures(self) -> int:
        """In how many pictures the person is seen."""
        return int((self.places >= 0).sum())


def people_of(
    cameras: Sequence[CameraSpec],
    people: Sequence[Sequence[People]],
    fps: float,
    watch: Watch = unwatched,
    exclude: Exclusion = joint_shares,
) -> list[Person]:
    """Return everybody in a recording, the one who is seen in most pictures first.

    Args:
        cameras: calibrated, without motion.
        people: for each frame and camera, column, row (pixels; NaN where not seen) and confidence.
        fps: frames per second.
        watch: shows how many frames are done.
        exclude: the shares of people who exclude each other, from their weights.
    """
    tracks = follow_people(cameras, people, fps, watch)
    bodies = [_filled(track) for track in tracks]
    expected_bodies = [ExpectedBodies(track.first, _by_neighbours(body)) for track, body in zip(tracks, bodies, strict=True)]
    associations = associate(cameras, people, expected_bodies, exclude)
    persons = [_person(*arguments) for arguments in zip(tracks, bodies, associations, strict=True)]
    persons.sort(key=lambda person: (-person.pictures, person.first))
    return [person._replace(number=number) for number, person in enumerate(persons, 1)]


def _person(track: Track, bodies: np.ndarray, association: Association) -> Person:
    places = np.array([[_likeliest(row) for row in frame] for frame in association.shares])
    chosen = zip(association.misfits, places, strict=True)
    misfits = [row[place] for frame, line in chosen for row, place in zip(frame, line, strict=True) if place >= 0]
    return Person(0, track.first, track.last, places, association.shares, bodies, float(np.median(misfits)) if misfits else np.inf)


def _likeliest(shares: Float[np.ndarray, " detection"]) -> int:
    return int(shares.argmax()) if len(shares) and shares.max() > 1 - shares.sum() else -1


def _filled(track: Track) -> Float[np.ndarray, "frame keypoint _"]:
    """The body in every frame from the first to the last: between frames in which it was seen, on a straight line."""
    frames = np.array(sorted(track.bodies))
    seen_bodies, every = np.array([track.bodies[frame] for frame in frames.tolist()]), np.arange(track.first, track.last + 1)
    flat = seen_bodies.reshape(len(seen_bodies), -1)
    columns = [np.interp(every, frames, column) for column in flat.T]
    return np.stack(columns, axis=-1).reshape(len(every), *seen_bodies.shape[1:])


def _by_neighbours(bodies: Float[np.ndarray, "frame keypoint _"]) -> Float[np.ndarray, "frame keypoint _"]:
    """The body of each frame by those before and after it."""
    return 0.5 * (bodies[np.maximum(np.arange(len(bodies)) - 1, 0)] + bodies[np.minimum(np.arange(len(bodies)) + 1, len(bodies) - 1)])


def describe_people(persons: Sequence[Person], cameras: int, numbers: Callable[[int], int], most: int, limit: int) -> list[str]:
    """Return sentences about who is tracked and why.

    Args:
        persons: of the recording.
        cameras: how many have keypoints.
        numbers: the number by which the user knows a frame, counted from 0.
        most: the largest number of detections of a camera in a frame.
        limit: the number of them that are looked at.
    """
    sentences = []
    if most > limit:
        sentences.append(f"A camera sees {most} people in one frame: the {limit} largest of each picture are looked at.")
    if len(persons) < 2:
        return sentences
    first, second = persons[:2]
    noun = "camera" if cameras == 1 else "cameras"
    sentences.append(
        f"There are {len(persons)} people. Person 1 is the subject: seen in {first.pictures} pictures of {cameras} {noun}, frames "
        f"{numbers(first.first)} to {numbers(first.last)}; person 2 in {second.pictures}. `bayes-body people` shows them, --person 2 tracks another."
    )
    if is_close(first.pictures, second.pictures):
        sentences.append(CLOSE_REMARK)
    return sentences


def is_close(first: int, second: int) -> bool:
    """Whether the person who is seen in most pictures may not be the one who is meant.

    Args:
        first: the number of pictures in which person 1 is seen.
        second: that of person 2.
    """
    return second >= CLOSE * first
