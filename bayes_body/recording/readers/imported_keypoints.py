"""Import the subject's keypoints: for the first frame, and for all frames.

Each camera has a folder of OpenPose's files, or one file that another program wrote for the whole video (pose_files/).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.progress import watched
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.keypoint_series import KeypointSeries, Places, follow_person, write_series
from bayes_body.recording.readers.keypoints import Layout, Tally, choose_layout, describe_tallies, keypoint_files, read_openpose, read_people
from bayes_body.recording.readers.measured_lengths import with_measured_lengths
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.person import People
from bayes_body.recording.readers.pose_files.find import PoseFiles, find_pose_files, read_track
from bayes_body.recording.readers.pose_files.pose_track import PoseTrack
from bayes_body.recording.readers.rig_verdict import describe_verdict, judge_rig
from bayes_body.recording.session.session import CameraSpec, Keypoints, Session, View

# How many evenly spaced files of a camera are used to find the order of the keypoints.
FILES_FOR_LAYOUT = 20
FOLDER = "keypoints"
# Beginnings of the names of points of a whole-body network.
FACES_AND_HANDS = ("face_", "l_hand_", "r_hand_")


def keypoint_folders(session: Session, folder: Path) -> dict[str, Path]:
    """Each camera's folder of files, CAMERA_json or CAMERA. Cameras without one are left out."""
    places = {view.camera.name: (folder / f"{view.camera.name}_json", folder / view.camera.name) for view in session.views}
    return {name: path for name, either in places.items() for path in either[::-1] if path.is_dir()}


def with_imported_keypoints(session: Session, options: Options, usual: Path | None = None) -> tuple[Session, list[str]]:
    """Add the keypoints that the user names, or those of the usual folder if it has any, and the lengths that they show. Also returns remarks.

    Raises:
        FaultyFileError: one sentence for each folder or file that is missing or wrong.
        InputError: the named folder has none, they cannot be read, or the session's folder cannot be written.
    """
    folder, names = options.keypoints or usual, [view.camera.name for view in session.views]
    files = find_pose_files(folder, names) if folder else PoseFiles({}, [])
    folders, expected = files.paths, "for each camera a folder CAMERA_json of OpenPose's files, or a file of AlphaPose, MMPose, DeepLabCut or SLEAP"
    if options.keypoints is not None and not folders:
        raise input_error(f"--keypoints {folder}", "no folder or file of any camera in it", expected, "check the path and the names")
    if options.layout is not None and not folders:
        raise input_error(
            "--layout", f"{options.layout}, but there are no keypoints{f' in {folder}' if folder else ''}", expected, "leave the option out"
        )
    if not folders:
        return session, files.remarks(names)
    session, remarks = with_keypoints(session, folders, options.layout, options.keypoints_first, options.rig, options.progress)
    session, measures = with_measured_lengths(session) if options.measures_lengths else (session, [])
    return session, [*files.remarks(names), *remarks, *measures]


def with_keypoints(
    session: Session,
    folders: Mapping[str, Path],
    layout: str | None = None,
    starts: Mapping[str, int] | None = None,
    rig: Mapping[str, str] | None = None,
    progress: bool = False,
) -> tuple[Session, list[str]]:
    """Add the subject's keypoints: all frames in files beside the session, the first frame as the first pose. Also returns remarks.

    Args:
        session: its cameras and frames.
        folders: each camera's folder of files, numbered like its frames, or its file of the whole video; a camera may be missing.
        layout: the order of the keypoints; None: infer it from the data.
        starts: of a camera, or of all cameras under an empty name: the number of the keypoints of the first recorded frame, if it is another one.
        rig: the changes of the calibration that the user asks for.
        progress: whether bars on standard error show how many frames are done.

    Raises:
        FaultyFileError: one sentence for each folder or file that is missing or wrong.
        InputError: the order of the keypoints cannot be inferred, they contradict the calibration, or the session's folder cannot be written.
    """
    views = [view for view in session.views if view.camera.name in folders]
    tracks = {name: read_track(path) for name, path in folders.items() if path.is_file()}
    people, remarks = _read(session, views, folders, tracks, starts or {}, progress)
    somebody = [group for frame in people for group in frame if len(group)]
    if not somebody:
        return session, ["The keypoint files contain no people: the session has no keypoints."]
    order = _order(folders, tracks, [*somebody, *_sample(views, folders)], layout)
    people, order = _of_body(people, order)
    verdict = judge_rig(session, views, people, order.keypoints, rig or {})
    places = follow_person([view.camera for view in views], people, watched("following the person", progress))
    first = {
        view.camera.name: _named(view.camera, among[place], order)
        for view, among, place in zip(views, people[0], places[0], strict=True)
        if place is not None
    }
    remarks = [*([order.remark] if order.remark else []), *remarks, *_crowd(session, views, people[0], places), *_seldom(views, places)]
    remarks += describe_verdict(views, people, places, verdict)
    files = {view.camera.name: _written(session, view, c, people, places, order) for c, view in enumerate(views)}
    marked = tuple(replace(view, keypoints=files.get(view.camera.name)) for view in session.views)
    # A first pose in angles or markers that the source provides takes precedence.
    has_first_pose = session.initial or session.initial_markers
    return replace(session, views=marked, initial_keypoints={} if has_first_pose else first), remarks


def _read(
    session: Session, views: Sequence[View], folders: Mapping[str, Path], tracks: Mapping[str, PoseTrack], starts: Mapping[str, int], progress: bool
) -> tuple[list[list[People]], list[str]]:
    """The people of each frame in each camera, and remarks on frames without a file and on what was strange."""
    faults, cameras, remarks, nobody, tallies = Faults(), [], list[str](), np.zeros((0, 0, 3)), dict[str, Tally]()
    for view in views:
        with faults.collect():
            name = view.camera.name
            path, track, tally = folders[name], tracks.get(name), tallies.setdefault(name, Tally())
            expected = _numbers(session, view, starts.get(name, starts.get("")))
            filmed = [number for number in expected if number is not None]
            first = filmed[0] if filmed else session.number(view, 0)
            files = track.people if track else keypoint_files(path)
            numbers = [number for number in filmed if number in files]
            if filmed and (not numbers or (first < min(files) and len(files) >= session.frames and not session.recorded)):
                raise _other_numbers(name, path, list(files), first, session.frames)
            if track:
                series, tally.largest = track.people, track.unclipped or 0.0
            else:
                series = dict(zip(numbers, read_openpose(path, numbers, tally, watched(f"reading keypoints of {name}", progress)), strict=True))
            cameras.append([nobody if number is None else visible_people(series.get(number, nobody)) for number in expected])
            if len(numbers) < len(filmed):
                absence = f"are not in {path.name}" if track else f"have no file in {path}"
                lost = f"{len(filmed) - len(numbers)} of {len(filmed)} frames {absence}"
                remarks.append(f"camera '{name}': {lost}: its keypoints are missing there.")
    faults.raise_any()
    remarks += describe_tallies(tallies)
    if programs := sorted({track.program for track in tracks.values()}):
        remarks.append(f"Keypoints are read from files of {' and '.join(programs)}.")
    return [list(frame) for frame in zip(*cameras, strict=True)], remarks


def _numbers(session: Session, view: View, start: int | None) -> list[int | None]:
    """The number of the camera's keypoints in each frame: that of the frame in its files, counted from `start` if given; None if it has no frame."""
    recording = session.recorded_session
    numbers = (recording.file_number(view, frame) for frame in range(recording.frames))
    shift = 0 if start is None else start - next((number for number in numbers if number is not None), 0)
    filmed = (session.file_number(view, frame) for frame in range(session.frames))
    return [None if number is None else number + shift for number in filmed]


def _order(folders: Mapping[str, Path], tracks: Mapping[str, PoseTrack], people: Sequence[People], layout: str | None) -> Layout:
    """The order of the keypoints: the one that all files state, else the one that their number and the body's proportions tell."""
    stated = {track.names for track in tracks.values() if track.names}
    if not stated or layout is not None:
        return choose_layout(_alike(folders, people), layout)
    if len(stated) > 1 or len(tracks) < len(folders):
        folder = next(iter(folders.values())).parent
        raise input_error(folder, "cameras whose files name other keypoints", "the same keypoints for all cameras", "use one network")
    program = next(iter(tracks.values())).program
    return Layout(program, stated.pop())


def _of_body(people: list[list[People]], order: Layout) -> tuple[list[list[People]], Layout]:
    """The people and the order without points of faces and hands, which no body has."""
    columns = [place for place, name in enumerate(order.keypoints) if not name.startswith(FACES_AND_HANDS)]
    if len(columns) == len(order.keypoints):
        return people, order
    names = tuple(order.keypoints[place] for place in columns)
    return [[group[:, columns] if len(group) else group for group in frame] for frame in people], order._replace(keypoints=names)


def _other_numbers(camera: str, path: Path, numbers: Sequence[int], first: int, count: int) -> InputError:
    """The error for keypoints whose numbers are not those of the frames."""
    problem = f"keypoints of {len(numbers)} frames, numbered {min(numbers)} to {max(numbers)}"
    remedy = f"if the first of them belongs to the first frame, give --keypoints-first {camera}={min(numbers)}, or without 'CAMERA=' for all cameras"
    return input_error(path, problem, f"numbers {first} to {first + count - 1}, those of the camera's frames", remedy)


def visible_people(people: People) -> People:
    """The people of whom a keypoint was found."""
    return people[np.isfinite(people[..., 0]).any(axis=1)]


def _sample(views: Sequence[View], folders: Mapping[str, Path]) -> list[People]:
    files = [list(keypoint_files(path).values()) for view in views if (path := folders[view.camera.name]).is_dir()]
    return [group for paths in files for path in paths[:: max(1, len(paths) // FILES_FOR_LAYOUT)] if len(group := read_people(path))]


def _alike(folders: Mapping[str, Path], people: Sequence[People]) -> Float[np.ndarray, "person keypoint 3"]:
    counts = sorted({group.shape[1] for group in people})
    if len(counts) > 1:
        folder = next(iter(folders.values())).parent
        raise input_error(folder, f"people with {counts[0]} and with {counts[-1]} keypoints", "one order of keypoints", "use one network")
    return np.concatenate(people)


def _named(camera: CameraSpec, person: Float[np.ndarray, "keypoint 3"], layout: Layout) -> Keypoints:
    """The keypoints that were found inside the image."""
    inside = _inside(camera, person) & (person[:, 2] > 0)
    points = zip(layout.keypoints, person.tolist(), inside.tolist(), strict=True)
    return {name: (column, row, confidence) for name, (column, row, confidence), is_inside in points if is_inside}


def _inside(camera: CameraSpec, points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    return (points[..., :2] >= 0).all(axis=-1) & (points[..., :2] <= camera.size_px).all(axis=-1)


def subject_row(camera: CameraSpec, people: People, place: int | None, keypoints: int) -> Float[np.ndarray, "keypoint 3"]:
    """The subject's keypoints inside the image, among the people of a frame; NaN without a place."""
    row = np.full((keypoints, 3), np.nan) if place is None else people[place].copy()
    row[~_inside(camera, row)] = (np.nan, np.nan, 0.0)
    return row


def _written(session: Session, view: View, c: int, people: Sequence[Sequence[People]], places: Sequence[Places], order: Layout) -> str:
    """Write the camera's file with the subject's keypoints inside the image; returns its name as the session writes it."""
    count = len(order.keypoints)
    points = np.stack([subject_row(view.camera, frame[c], chosen[c], count) for frame, chosen in zip(people, places, strict=True)])
    name = f"{FOLDER}/{view.camera.name}.npz"
    write_series(session.folder / name, KeypointSeries(points, order.keypoints, session.number(view, 0)))
    return name


def _crowd(session: Session, views: Sequence[View], people: Sequence[People], series: Sequence[Places]) -> list[str]:
    """A remark if nobody is in the first frame, with the first that shows the subject, or if several people are."""
    places = series[0]
    if not any(place is not None for place in places):
        why = "No two cameras agree on a person's keypoints" if len(views) > 1 and any(map(len, people)) else "The keypoint files contain no people"
        return [f"{why} in frame {session.first_frame}, the first one: the session has no first keypoints{_describe_first_shown(session, series)}."]
    choices = [
        f"{view.camera.name}: {'none' if place is None else f'#{place + 1}'} of {len(among)}"
        for view, among, place in zip(views, people, places, strict=True)
        if len(among) > 1 or place is None
    ]
    how = "on whom most cameras agree" if len(views) > 1 else "who is largest"
    return (
        [f"There are several people in the first frame. The subject is the one {how} ({', '.join(choices)}): check the picture."] if choices else []
    )


def _describe_first_shown(session: Session, series: Sequence[Places]) -> str:
    """Words on the first frame in which two cameras, or the only one, show the subject."""
    shown = [sum(place is not None for place in places) for places in series]
    first_shown = next((frame for frame, count in enumerate(shown) if count >= min(2, len(series[0]))), None)
    if first_shown is None:
        return ""
    number = session.frame_number(first_shown)
    return f"; they show the subject from frame {number} on: begin there with --first-frame {number}"


def _seldom(views: Sequence[View], places: Sequence[Places]) -> list[str]:
    """A remark on cameras that do not see the subject in every frame."""
    frames = len(places)
    unseen = [sum(chosen[c] is None for chosen in places) for c in range(len(views))]
    counts = [f"{view.camera.name}: {count} of {frames}" for view, count in zip(views, unseen, strict=True) if count]
    return [f"Frames in which a camera's keypoints do not show the subject: {', '.join(counts)}."] if counts else []
