"""Sentences about imported keypoints: several people in the first frame, nobody in it, and cameras that see nobody at all."""

from collections.abc import Sequence

from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.keypoints.series import Places
from bayes_body.recording.session.session import Session, View


def describe_crowd(session: Session, views: Sequence[View], people: Sequence[Sequence[People]], series: Sequence[Places]) -> list[str]:
    """A remark if nobody is in the first frame, with the first that shows the subject, or if several people are.

    Args:
        session: whose frames they are.
        views: the cameras with keypoints.
        people: for each frame and camera.
        series: for each frame, the subject's index among the people of each camera; None where the camera does not show the subject.
    """
    first_people, places = people[0], series[0]
    if not any(place is not None for place in places):
        agreement = "No two cameras agree on a person's keypoints"
        why = agreement if len(views) > 1 and any(map(len, first_people)) else "The keypoint files contain no people"
        return [f"{why} in frame {session.first_frame}, the first one: the session has no first keypoints{_describe_first_shown(session, series)}."]
    if all(len(among) <= 1 for among in first_people):
        return []
    choices = [
        f"{view.camera.name}: {'none' if place is None else f'#{place + 1}'} of {len(among)}"
        for view, among, place in zip(views, first_people, places, strict=True)
        if len(among) > 1 or (place is None and len(among))
    ]
    how = "on whom most cameras agree" if len(views) > 1 else "who is largest"
    return [f"There are several people in the first frame. The subject is the one {how} ({', '.join(choices)}): check the picture."]


def _describe_first_shown(session: Session, series: Sequence[Places]) -> str:
    """Words on the first frame in which two cameras, or the only one, show the subject."""
    shown = [sum(place is not None for place in places) for places in series]
    first_shown = next((frame for frame, count in enumerate(shown) if count >= min(2, len(series[0]))), None)
    if first_shown is None:
        return ""
    number = session.frame_number(first_shown)
    return f"; they show the subject from frame {number} on: begin there with --first-frame {number}"


def describe_absence(views: Sequence[View], people: Sequence[Sequence[People]]) -> list[str]:
    """A remark on cameras that see nobody in any frame; `people` are those of each frame and camera."""
    blind = [view.camera.name for c, view in enumerate(views) if not any(len(frame[c]) for frame in people)]
    if not blind:
        return []
    files = "their keypoint files show" if len(blind) > 1 else "its keypoint files show"
    return [f"{', '.join(blind)}: {files} nobody in any of the {len(people)} frames."]
