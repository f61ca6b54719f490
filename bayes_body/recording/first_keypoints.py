"""The subject's keypoints in a session's first frame, from a folder of OpenPose's files for each camera."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.errors import wrong
from bayes_body.recording.faults import Faults
from bayes_body.recording.keypoint_layouts import Layout, choose_layout
from bayes_body.recording.keypoints import keypoint_files, read_openpose, read_people
from bayes_body.recording.person import People, choose_person
from bayes_body.session import CameraSpec, Keypoints, Session, View

# Files of a camera, evenly spaced, in which the order of the keypoints is looked for.
FILES_FOR_LAYOUT = 20


def first_keypoints(session: Session, folders: Mapping[str, Path], layout: str | None = None) -> tuple[dict[str, Keypoints], list[str]]:
    """The keypoints of frame 0 by camera, those of the subject alone, and remarks; empty where nobody can be told.

    Args:
        session: its cameras, and which of their frames is the first.
        folders: each camera's files, numbered as its frames; a camera may be missing.
        layout: the order of the keypoints, or None to let the data decide.

    Raises:
        FaultyFileError: one sentence for each folder or file that is missing or wrong.
        InputError: the data do not tell the order of the keypoints.
    """
    views = [view for view in session.views if view.camera.name in folders]
    faults, people, sample = Faults(), [], []
    for view in views:
        folder = folders[view.camera.name]
        with faults.collect():
            people.append(read_openpose(folder, [session.number(view, 0)])[0])
            sample += _sample(folder)
    faults.raise_any()
    everybody = _alike(folders, [*people, *sample])
    if not len(everybody):
        return {}, ["The keypoint files that were looked at show nobody: the session has no first keypoints."]
    order = choose_layout(everybody, layout)
    remarks = [order.remark] if order.remark else []
    chosen = choose_person([view.camera for view in views], people)
    if chosen is None:
        return {}, [*remarks, "No two cameras agree on anybody's keypoints in the first frame: the session has no first keypoints."]
    named = {
        view.camera.name: _named(view.camera, among[place], order)
        for view, among, place in zip(views, people, chosen.places, strict=True)
        if place is not None
    }
    return named, [*remarks, *_crowd(views, people, chosen.places)]


def _sample(folder: Path) -> list[People]:
    files = list(keypoint_files(folder).values())
    return [read_people(path) for path in files[:: max(1, len(files) // FILES_FOR_LAYOUT)]]


def _alike(folders: Mapping[str, Path], people: Sequence[People]) -> Float[np.ndarray, "person keypoint 3"]:
    somebody = [each for each in people if len(each)]
    counts = sorted({each.shape[1] for each in somebody})
    if len(counts) > 1:
        where = next(iter(folders.values())).parent
        raise wrong(where, f"people with {counts[0]} and with {counts[-1]} keypoints", "one order of keypoints", "detect them with one network")
    return np.concatenate(somebody) if somebody else np.zeros((0, 0, 3))


def _named(camera: CameraSpec, person: Float[np.ndarray, "keypoint 3"], layout: Layout) -> Keypoints:
    """What was found, inside of the image."""
    inside = (person[:, :2] >= 0).all(axis=1) & (person[:, :2] <= camera.size_px).all(axis=1) & (person[:, 2] > 0)
    points = zip(layout.keypoints, person.tolist(), inside.tolist(), strict=True)
    return {name: (column, row, confidence) for name, (column, row, confidence), seen in points if seen}


def _crowd(views: Sequence[View], people: Sequence[People], places: Sequence[int | None]) -> list[str]:
    told = [
        f"{view.camera.name}: {'nobody' if place is None else f'#{place + 1}'} of {len(among)}"
        for view, among, place in zip(views, people, places, strict=True)
        if len(among) > 1 or place is None
    ]
    how = "on whom most cameras agree" if len(views) > 1 else "who is largest"
    return [f"Of several people in the first frame the one {how} is taken ({', '.join(told)}): look at the picture."] if told else []
