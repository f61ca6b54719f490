"""What an import makes of the verdict on its rig (rig_judge.py): it refuses the calibration, or says which camera contradicts it."""

import sys
from collections.abc import Mapping, Sequence

from bayes_body.base.progress import waiting
from bayes_body.recording.readers.keypoint_series import Places
from bayes_body.recording.readers.person import People
from bayes_body.recording.readers.rig_judge import Verdict, judge
from bayes_body.recording.readers.rig_option import AS_GIVEN
from bayes_body.recording.readers.rig_sentences import contradiction, describe_dissent, rough_agreement
from bayes_body.recording.session.session import Session, View


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
