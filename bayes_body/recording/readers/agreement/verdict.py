"""What an import makes of the verdict on its rig (judge.py): it refuses the calibration, or says which camera contradicts it."""

import sys
from collections.abc import Mapping, Sequence

import numpy as np

from bayes_body.base.progress import waiting
from bayes_body.recording.readers.agreement.cameras import common_keypoints
from bayes_body.recording.readers.agreement.judge import Verdict, judge
from bayes_body.recording.readers.agreement.option import AS_GIVEN
from bayes_body.recording.readers.agreement.sentences import contradiction, describe_dissent, rough_agreement
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.keypoints.series import Places
from bayes_body.recording.session.session import Session, View

# Frames of a session.
MOST_LOOKED_AT = 50


def judge_rig(
    session: Session, views: Sequence[View], people: Sequence[Sequence[People]], names: Sequence[str], changes: Mapping[str, str]
) -> Verdict | None:
    """Return how the cameras agree; None if they move, or if no two of them see somebody at the same time.

    Args:
        session: the recording.
        views: its cameras with keypoints.
        people: for each frame and camera.
        names: of the keypoints.
        changes: of the calibration, that the user asks for; with `as_given` it is used in any case.

    Raises:
        InputError: no majority of the cameras agrees.
    """
    cameras = [view.camera for view in views]
    if len(cameras) < 2 or session.moves:
        return None
    with waiting("looking whether the cameras agree", sys.stderr.isatty()):
        verdict = judge(cameras, people, names)
    # Among several people no majority need see the same one.
    is_crowd = any(len(group) > 1 for frame in people for group in frame)
    if verdict and verdict.contradicts and AS_GIVEN not in changes.values() and (verdict.remedies or not is_crowd):
        raise contradiction(session.calibration or "the calibration", cameras, verdict)
    return verdict


def describe_verdict(views: Sequence[View], people: Sequence[Sequence[People]], series: Sequence[Places], verdict: Verdict | None) -> list[str]:
    """Return sentences on cameras whose people agree with no other camera in most frames, and on cameras that agree only roughly.

    Args:
        views: the cameras with keypoints.
        people: for each frame and camera.
        series: for each frame, the subject's index among the people of each camera; None where the camera does not show the subject.
        verdict: from `judge_rig`.
    """
    frames, cameras = len(series), [view.camera for view in views]
    strangers = [sum(places[c] is None and len(frame[c]) > 0 for places, frame in zip(series, people, strict=True)) for c in range(len(views))]
    contradicting = [c for c, count in enumerate(strangers) if len(views) > 1 and 2 * count > frames]
    agreeing, causes = len(views) - len(contradicting), verdict.causes if verdict else {}
    sentences = [describe_dissent(cameras[c].name, strangers[c], frames, agreeing, causes.get(c)) for c in contradicting]
    return [*sentences, *(rough_agreement(cameras, verdict) if verdict and not verdict.contradicts else [])]


def describe_contradiction(session: Session) -> list[str]:
    """Return a sentence if the keypoints of a session contradict its cameras, as `judge_rig` finds for an import; none if they agree.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    cameras, names, keypoints = common_keypoints(session)
    if len(cameras) < 2 or session.moves or not names:
        return []
    frames = np.unique(np.linspace(0, session.frames - 1, MOST_LOOKED_AT).astype(int))
    people = [[row[None] if np.isfinite(row[:, 0]).any() else row[None][:0] for row in keypoints[:, frame]] for frame in frames]
    verdict = judge(cameras, people, names)
    return [str(contradiction("session.toml", cameras, verdict))] if verdict and verdict.contradicts else []
