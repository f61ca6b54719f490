"""Whether the rays of a rig's keypoints meet, and by which change of the calibration they would.

A rig is right if most cameras that see somebody agree on the same person (`person.choose_person`), in most of the frames that are looked at. Any two
rays that happen to pass near each other make a point, so two cameras that agree by chance are no proof: agreement needs more than half of the
cameras, and at least two.

- A camera that contradicts the majority is looked at alone: its pictures may be turned, its keypoints may belong to pictures of another size, or have
  left and right exchanged.
- If no majority agrees, or only two of three cameras do and nothing explains the third, the changes of `changes` are tried on all cameras.
- Two cameras see no error along their epipolar lines, and cameras in a ring hardly see that all pictures are turned by 180°. If cameras agree only
  roughly, changes by which they agree far better are named too.

A change is named only if the rays meet with it, and never made here.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.recording.readers.agreement.changes import CHANGES, POSES, SIZES, VIEWS
from bayes_body.recording.readers.keypoints.person import MOST_PROPOSERS, SAME, Chosen, People, choose_person, relative_error
from bayes_body.recording.readers.keypoints.triangulate import triangulate
from bayes_body.recording.session.session import CameraSpec

# Frames that are looked at. In a crowd fewer: so many pairs of people of two cameras are compared in about a second.
MOST_FRAMES, FEWEST_FRAMES, MOST_PAIRS = 6, 2, 200
# Changes are tried on the first of them.
TRIED_FRAMES = 3
# With a change, the mean error of three cameras or more must be below this; that of two, below ROUGH.
WELL = 0.05
# Cameras agree only roughly if their mean error is above this, as a fraction of the person's size in the image.
ROUGH = 0.03
# An explanation of a camera's error is believed if at most this share of the error is left.
CLEAR = 0.35
# Keypoints of pictures of another size.
SCALES = {"twice": 0.5, "half": 2.0}
SIDES = {"l_": "r_", "r_": "l_"}


@dataclass(frozen=True)
class Agreement:
    """How the cameras agree in some frames.

    Attributes:
        people: of each frame and camera, as `person.People`.
        chosen: of each frame, the subject; None where no two cameras agree.
    """

    people: Sequence[Sequence[People]]
    chosen: Sequence[Chosen | None]

    @cached_property
    def seeing(self) -> Int[np.ndarray, " camera"]:
        """Frames in which a camera sees somebody."""
        return np.array([[len(group) > 0 for group in frame] for frame in self.people]).sum(axis=0)

    @cached_property
    def agreeing(self) -> Int[np.ndarray, " camera"]:
        """Frames in which a camera agrees with others on the subject."""
        return np.array([_placed(frame, choice) for frame, choice in zip(self.people, self.chosen, strict=True)]).sum(axis=0)

    @property
    def has_majority(self) -> bool:
        """Whether more than half of the cameras that see somebody agree, in more than half of the frames."""
        majorities = [
            2 * sum(_placed(frame, choice)) > sum(len(group) > 0 for group in frame) for frame, choice in zip(self.people, self.chosen, strict=True)
        ]
        return 2 * sum(majorities) > len(majorities)

    @property
    def dissenting(self) -> list[int]:
        """Cameras that agree in less than half of the frames in which they see somebody."""
        return np.flatnonzero(2 * self.agreeing < self.seeing).tolist()

    @property
    def members(self) -> list[int]:
        """Cameras that agree in at least half of the frames in which they see somebody."""
        return np.flatnonzero((self.seeing > 0) & (2 * self.agreeing >= self.seeing)).tolist()

    @property
    def error(self) -> float:
        """Mean of the subject's errors, as fractions of the person's size in the image; infinite if there is no subject."""
        errors = [choice.error for choice in self.chosen if choice is not None]
        return float(np.mean(errors)) if errors else np.inf

    @property
    def share(self) -> float:
        """Share of the frames in which cameras that see somebody agree."""
        return float(self.agreeing.sum() / self.seeing.sum())


def _placed(frame: Sequence[People], choice: Chosen | None) -> list[bool]:
    return [choice is not None and choice.places[c] is not None for c in range(len(frame))]


class Cause(NamedTuple):
    """Why a camera contradicts the others: in words, and the name of the change of its calibration that mends it, if it is one."""

    words: str
    change: str | None


class Verdict(NamedTuple):
    """What `judge` says of a rig.

    Attributes:
        agreement: of the cameras as they are.
        remedies: alternatives by which the rays meet, or meet far better, the best first: changes by camera, under an empty name of all cameras.
        causes: of cameras that contradict the others, by their index.
    """

    agreement: Agreement
    remedies: list[dict[str, str]]
    causes: dict[int, Cause]

    @property
    def contradicts(self) -> bool:
        """Whether the rig cannot be used as it is: no majority agrees, or two cameras of three do and a change makes all agree."""
        return not self.agreement.has_majority or (bool(self.remedies) and bool(self.agreement.dissenting))


def judge(cameras: Sequence[CameraSpec], people: Sequence[Sequence[People]], names: Sequence[str]) -> Verdict | None:
    """Judge a rig by the keypoints of its people.

    Args:
        cameras: calibrated.
        people: of each frame and camera.
        names: of the keypoints.

    Returns:
        The verdict; None if no two cameras see somebody at the same time.
    """
    frames = _sample(people)
    if not frames:
        return None
    agreement = _agreement(cameras, frames)
    causes = {c: cause for c in agreement.dissenting if (cause := _cause(cameras, agreement, c, names)) is not None}
    explained = len(causes) == len(agreement.dissenting)
    if not agreement.has_majority or not (explained or len(agreement.members) > 2):
        return Verdict(agreement, _remedies(cameras, agreement, causes), causes)
    return Verdict(agreement, _improvements(cameras, agreement), causes)


def _sample(people: Sequence[Sequence[People]]) -> list[Sequence[People]]:
    """Return evenly spaced frames among those in which two cameras see somebody; fewer in a crowd."""
    shared = [frame for frame in people if sum(len(group) > 0 for group in frame) > 1]
    if not shared:
        return []
    crowd = max(_pairs(shared[k]) for k in np.linspace(0, len(shared) - 1, MOST_FRAMES).astype(int))
    count = int(np.clip(MOST_PAIRS // crowd, FEWEST_FRAMES, MOST_FRAMES))
    return [shared[k] for k in np.unique(np.linspace(0, len(shared) - 1, count).round().astype(int))]


def _pairs(frame: Sequence[People]) -> int:
    """Return the number of pairs of people that are triangulated."""
    return sum(min(len(a), MOST_PROPOSERS) * min(len(b), MOST_PROPOSERS) for a, b in combinations(frame, 2))


def _agreement(cameras: Sequence[CameraSpec], frames: Sequence[Sequence[People]]) -> Agreement:
    return Agreement(frames, [choose_person(cameras, frame) for frame in frames])


def _remedies(cameras: Sequence[CameraSpec], agreement: Agreement, causes: Mapping[int, Cause]) -> list[dict[str, str]]:
    """Return the changes by which most cameras agree; if most do as they are, those by which all do.

    Of two cameras several, the best first, since several may make their rays meet by chance. Of more cameras the best one.
    """
    proposals = _proposals(cameras)
    if mended := {cameras[c].name: cause.change for c, cause in causes.items() if cause.change is not None}:
        proposals.append(mended)
    is_pair = len(cameras) == 2
    better = []
    for proposal in proposals:
        trial = _trial(cameras, agreement.people, proposal)
        is_well = trial.has_majority and not (agreement.has_majority and trial.dissenting) and trial.error <= (ROUGH if is_pair else WELL)
        if trial.share > agreement.share and is_well:
            better.append((-trial.share, trial.error, proposal))
    better.sort(key=lambda entry: entry[:2])
    return [proposal for *_, proposal in better[: None if is_pair else 1]]


def _improvements(cameras: Sequence[CameraSpec], agreement: Agreement) -> list[dict[str, str]]:
    """Return the changes by which cameras that agree roughly would agree well, the best first."""
    if agreement.error <= ROUGH:
        return []
    trials = [(proposal, _trial(cameras, agreement.people, proposal)) for proposal in _proposals(cameras)]
    well = min(ROUGH, CLEAR * agreement.error)
    better = [(proposal, trial.error) for proposal, trial in trials if trial.share >= agreement.share and trial.error <= well]
    return [proposal for proposal, _ in sorted(better, key=lambda pair: pair[1])]


def _proposals(cameras: Sequence[CameraSpec]) -> list[dict[str, str]]:
    """Return changes of all cameras and, of two cameras, of one of them."""
    pair = [camera.name for camera in cameras] if len(cameras) == 2 else []
    return [*({"": change} for change in (*POSES, *VIEWS, *SIZES)), *({name: change} for name in pair for change in (*VIEWS, *SIZES))]


def _trial(cameras: Sequence[CameraSpec], frames: Sequence[Sequence[People]], proposal: Mapping[str, str]) -> Agreement:
    changes = [proposal.get(camera.name, proposal.get("")) for camera in cameras]
    changed = [camera if name is None else CHANGES[name].for_pictures(camera) for camera, name in zip(cameras, changes, strict=True)]
    # Most changes fail at once.
    first = _agreement(changed, frames[:1])
    return _agreement(changed, frames[:TRIED_FRAMES]) if first.has_majority else first


def _cause(cameras: Sequence[CameraSpec], agreement: Agreement, c: int, names: Sequence[str]) -> Cause | None:
    """Return what explains that a camera contradicts the others; None if nothing does."""
    errors: dict[Cause | None, list[float]] = {}
    for frame, choice in zip(agreement.people, agreement.chosen, strict=True):
        if choice is None or choice.places[c] is not None or not len(frame[c]):
            continue
        body = _body(cameras, frame, choice)
        for cause, camera, group in ((None, cameras[c], frame[c]), *_explanations(cameras[c], frame[c], names)):
            errors.setdefault(cause, []).append(min(relative_error(camera, body, person) for person in group))
    medians = {cause: float(np.median(values)) for cause, values in errors.items()}
    best = min(medians, key=lambda cause: medians[cause], default=None)
    return best if best is not None and medians[best] <= min(SAME, CLEAR * medians[None]) else None


def _body(cameras: Sequence[CameraSpec], frame: Sequence[People], choice: Chosen) -> Float[np.ndarray, "keypoint 3"]:
    placed = [(cameras[c], frame[c][place]) for c, place in enumerate(choice.places) if place is not None]
    return triangulate([camera for camera, _ in placed], np.stack([person for _, person in placed]), np.inf).points_m


def _explanations(camera: CameraSpec, people: People, names: Sequence[str]) -> Iterator[tuple[Cause, CameraSpec, People]]:
    """Yield what may be the matter with a camera, and the camera and its people if it is so."""
    for name, change in VIEWS.items():
        yield Cause(change.meaning, name), change.for_pictures(camera), people
    for size, scale in SCALES.items():
        yield Cause(f"its keypoints belong to pictures of {size} the size", None), camera, people * [scale, scale, 1.0]
    yield Cause("left and right of its keypoints are exchanged", None), camera, people[:, _exchanged_sides(names)]


def _exchanged_sides(names: Sequence[str]) -> list[int]:
    """Return the order of the keypoints with left and right exchanged."""
    places = {name: place for place, name in enumerate(names)}
    return [places.get(SIDES.get(name[:2], name[:2]) + name[2:], place) for place, name in enumerate(names)]
