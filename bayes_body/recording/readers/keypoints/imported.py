"""Import the subject's keypoints: for the first frame, and for all frames.

Each camera has a folder of OpenPose's files, or one file that another program wrote for the whole video (pose_files/). The unit and the order of the
points, and the person's size, are judged before anything is written (units.py, orders.py, stature.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.progress import watched
from bayes_body.recording.readers.agreement.verdict import describe_verdict, judge_rig
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.file_names import child
from bayes_body.recording.readers.keypoints.measured_lengths import with_measured_lengths
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS, Tally, describe_tallies, keypoint_files, read_openpose, read_people
from bayes_body.recording.readers.keypoints.orders import FEWEST_IN_ALL, CameraPoses, Orders, check_body, decide_orders
from bayes_body.recording.readers.keypoints.person import People, distinct_people
from bayes_body.recording.readers.keypoints.pose_files.find import PoseFiles, find_pose_files, read_track
from bayes_body.recording.readers.keypoints.pose_files.pose_track import PoseTrack
from bayes_body.recording.readers.keypoints.remarks import describe_absence, describe_crowd
from bayes_body.recording.readers.keypoints.series import KeypointSeries, follow_person, write_series
from bayes_body.recording.readers.keypoints.stature import check_stature, measure_stature, triangulated_body
from bayes_body.recording.readers.keypoints.units import check_unit, in_pixels
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.people.detections import remove_detections, write_detections
from bayes_body.recording.readers.people.files import in_all_frames, series_of
from bayes_body.recording.readers.people.people import Person, describe_people, people_of
from bayes_body.recording.readers.people.presence import write_presences
from bayes_body.recording.readers.people.tracks import MOST_PEOPLE, limited
from bayes_body.recording.session.session import CameraSpec, Keypoints, Session, View

# How many evenly spaced files of a camera tell the order of the keypoints, if the session has few frames.
FILES_FOR_LAYOUT = 20
FOLDER = "keypoints"
# Beginnings of the names of points of a whole-body network.
FACES_AND_HANDS = ("face_", "l_hand_", "r_hand_")


def keypoint_folders(session: Session, folder: Path) -> dict[str, Path]:
    """Each camera's folder of files, CAMERA_json or CAMERA. Cameras without one are left out."""
    places = {view.camera.name: (child(folder, f"{view.camera.name}_json"), child(folder, view.camera.name)) for view in session.views}
    return {name: path for name, either in places.items() for path in either[::-1] if path.is_dir()}


def with_imported_keypoints(session: Session, options: Options, usual: Path | None = None, unit: str | None = None) -> tuple[Session, list[str]]:
    """Add the keypoints that the user names, or those of the usual folder if it has any, and the lengths that they show. Also returns remarks.

    Args:
        session: its cameras and frames.
        options: the user's options.
        usual: the folder in which the laboratory's program writes keypoints.
        unit: of the calibration's translations, if the user can give another one.

    Raises:
        FaultyFileError: one sentence for each folder or file that is missing or wrong.
        InputError: the named folder has none, they cannot be read, they are no person's, or the session's folder cannot be written.
    """
    check_unit(options.keypoints_unit)
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
        return session, [f"No keypoints are imported: nothing in {folder} has a camera's name."] if files.unused else []
    session, remarks = with_keypoints(session, folders, options, unit)
    session, measures = with_measured_lengths(session) if options.measures_lengths else (session, [])
    return session, [*remarks, *measures]


def with_keypoints(
    session: Session, folders: Mapping[str, Path], options: Options | None = None, unit: str | None = None
) -> tuple[Session, list[str]]:
    """Add the subject's keypoints: all frames in files beside the session, the first frame as the first pose. Also returns remarks.

    Args:
        session: its cameras and frames.
        folders: each camera's folder of files, numbered like its frames, or its file of the whole video; a camera may be missing.
        options: the user's options. Used are the order, the unit and the first numbers of the keypoints, the changes of the rig, and the bars.
        unit: of the calibration's translations, if the user can give another one.

    Raises:
        FaultyFileError: one sentence for each folder or file that is missing or wrong, or whose points are in another order.
        InputError: the order of the keypoints cannot be inferred, they contradict the calibration or are no person's, or the session's folder
            cannot be written.
    """
    options = options or Options()
    views = [view for view in session.views if view.camera.name in folders]
    tracks = {name: read_track(path) for name, path in folders.items() if path.is_file()}
    cameras, remarks = _read(session, views, folders, tracks, options.keypoints_first, options.progress)
    sizes = {view.camera.name: view.camera.size_px for view in views}
    cameras = in_pixels(cameras, sizes, options.keypoints_unit)
    if not any(len(group) for groups in cameras.values() for group in groups):
        return session, ["The keypoint files contain no people: the session has no keypoints."]
    has_few = sum(len(group) for groups in cameras.values() for group in groups) < FEWEST_IN_ALL
    sample = in_pixels(_sample(folders), sizes, options.keypoints_unit) if has_few else {}
    points, orders = _orders(folders, tracks, cameras, sample, options.layout, session.first_frame)
    cameras, names = _common_points(cameras, points)
    people = [list(frame) for frame in zip(*cameras.values(), strict=True)]
    verdict = judge_rig(session, views, people, names, options.rig)
    people, most = limited(people)
    subject, who = _main_person(session, views, people, names, most, options.progress)
    if subject is None:
        places = follow_person([view.camera for view in views], people, watched("following the person", options.progress))
    else:
        places = [tuple(None if place < 0 else place for place in row) for row in subject.places.tolist()]
    frames = list(zip(people, places, strict=True))
    rows = np.stack([[subject_row(view.camera, frame[c], chosen[c], len(names)) for frame, chosen in frames] for c, view in enumerate(views)])
    remarks = [
        *([orders.remark] if orders.remark else []),
        *remarks,
        *describe_crowd(session, views, people, places),
        *who,
        *describe_absence(views, people),
        *describe_verdict(views, people, places, verdict),
    ]
    if not session.moves:
        body = triangulated_body([view.camera for view in views], rows)
        remarks += check_body(orders, body, names, options.layout is not None)
        remarks += check_stature(measure_stature(body, names), session.subject.height_m, unit)
    files = {}
    for c, (view, points) in enumerate(zip(views, rows, strict=True)):
        first = session.number(view, 0)
        series = KeypointSeries(points, names, first) if subject is None else series_of(subject, view.camera, c, people, names, first)
        files[view.camera.name] = _written(session, view, series)
    marked = tuple(replace(view, keypoints=files.get(view.camera.name)) for view in session.views)
    # A first pose in angles or markers that the source provides takes precedence.
    has_first_pose = session.initial or session.initial_markers
    first = (
        {}
        if has_first_pose
        else {view.camera.name: _named(points[0], names) for view, points, place in zip(views, rows, places[0], strict=True) if place is not None}
    )
    return replace(session, views=marked, initial_keypoints=first), remarks


def _read(
    session: Session, views: Sequence[View], folders: Mapping[str, Path], tracks: Mapping[str, PoseTrack], starts: Mapping[str, int], progress: bool
) -> tuple[dict[str, list[People]], list[str]]:
    """The people of each camera in each frame, and remarks on what was strange."""
    faults, cameras, nobody, tallies = Faults(), dict[str, list[People]](), np.zeros((0, 0, 3)), dict[str, Tally]()
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
            cameras[name] = [nobody if number is None else visible_people(series.get(number, nobody), tally) for number in expected]
            tally.missing, tally.frames = len(filmed) - len(numbers), len(filmed)
    faults.raise_any()
    return cameras, describe_tallies(tallies)


def _numbers(session: Session, view: View, start: int | None) -> list[int | None]:
    """The number of the camera's keypoints in each frame: that of the frame in its files, counted from `start` if given; None if it has no frame."""
    recording = session.recorded_session
    numbers = (recording.file_number(view, frame) for frame in range(recording.frames))
    shift = 0 if start is None else start - next((number for number in numbers if number is not None), 0)
    filmed = (session.file_number(view, frame) for frame in range(session.frames))
    return [None if number is None else number + shift for number in filmed]


def _orders(
    folders: Mapping[str, Path],
    tracks: Mapping[str, PoseTrack],
    cameras: Mapping[str, Sequence[People]],
    sample: Mapping[str, Sequence[People]],
    layout: str | None,
    first_frame: int,
) -> tuple[dict[str, tuple[str, ...]], Orders]:
    """The names of each camera's points: those that all files state, else those that their number and the body's proportions tell."""
    stated = {track.names for track in tracks.values() if track.names}
    if stated and layout is None:
        if len(stated) > 1 or len(tracks) < len(folders):
            folder = next(iter(folders.values())).parent
            raise input_error(folder, "cameras whose files name other keypoints", "the same keypoints for all cameras", "use one network")
        return dict.fromkeys(cameras, stated.pop()), Orders({})
    poses = {name: _poses(groups, sample.get(name, ())) for name, groups in cameras.items()}
    counts = sorted({group.shape[1] for groups in (*cameras.values(), *sample.values()) for group in groups if len(group)})
    if len(counts) > 1:
        folder = next(iter(folders.values())).parent
        raise input_error(folder, f"people with {counts[0]} and with {counts[-1]} keypoints", "one order of keypoints", "use one network")
    orders = decide_orders({name: camera for name, camera in poses.items() if len(camera.poses)}, counts[0], layout, first_frame)
    layouts = {name: orders.layouts.get(name, next(iter(orders.layouts.values()))) for name in cameras}
    return {name: LAYOUTS[layout_name] for name, layout_name in layouts.items()}, orders


def _poses(groups: Sequence[People], sample: Sequence[People]) -> CameraPoses:
    """All people of a camera. Those of a sample of other frames count as if they were in the last frame."""
    numbered = [(frame, group) for frame, group in enumerate(groups) if len(group)]
    numbered += [(len(groups) - 1, group) for group in sample if len(group)]
    if not numbered:
        return CameraPoses(np.zeros((0, 0, 2)), np.zeros(0, int))
    frames = [np.full(len(group), frame) for frame, group in numbered]
    # A group of other size is refused by its number of points.
    count = numbered[0][1].shape[1]
    poses = [group[..., :2] for _, group in numbered if group.shape[1] == count]
    return CameraPoses(np.concatenate(poses), np.concatenate(frames)[: sum(map(len, poses))])


def _common_points(cameras: Mapping[str, Sequence[People]], orders: Mapping[str, tuple[str, ...]]) -> tuple[dict[str, list[People]], tuple[str, ...]]:
    """The people with the points that all cameras have, in one order, and their names; without faces and hands, which no body has."""
    listed = list(orders.values())
    common = tuple(name for name in listed[0] if all(name in names for names in listed) and not name.startswith(FACES_AND_HANDS))
    columns = {camera: [names.index(name) for name in common] for camera, names in orders.items()}
    return {camera: [group[:, columns[camera]] if len(group) else group for group in groups] for camera, groups in cameras.items()}, common


def _other_numbers(camera: str, path: Path, numbers: Sequence[int], first: int, count: int) -> InputError:
    """The error for keypoints whose numbers are not those of the frames."""
    problem = f"keypoints of {len(numbers)} frames, numbered {min(numbers)} to {max(numbers)}"
    remedy = f"if the first of them belongs to the first frame, give --keypoints-first {camera}={min(numbers)}, or without 'CAMERA=' for all cameras"
    return input_error(path, problem, f"numbers {first} to {first + count - 1}, those of the camera's frames", remedy)


def visible_people(people: People, tally: Tally | None = None) -> People:
    """The people of whom a keypoint was found; of several detections of a person, the most confident one. `tally` counts the others."""
    visible = people[np.isfinite(people[..., 0]).any(axis=1)]
    distinct = distinct_people(visible)
    if tally is not None:
        tally.repeated += len(visible) - len(distinct)
    return distinct


def _sample(folders: Mapping[str, Path]) -> dict[str, list[People]]:
    """The people of some files of each camera, whichever frames they belong to."""
    files = {name: list(keypoint_files(path).values()) for name, path in folders.items() if path.is_dir()}
    chosen = {name: paths[:: max(1, len(paths) // FILES_FOR_LAYOUT)] for name, paths in files.items()}
    return {name: [group for path in paths if len(group := visible_people(read_people(path)))] for name, paths in chosen.items()}


def _named(points: Float[np.ndarray, "keypoint 3"], names: Sequence[str]) -> Keypoints:
    """The keypoints that were found inside the image."""
    rows = zip(names, points.tolist(), strict=True)
    return {name: (column, row, confidence) for name, (column, row, confidence) in rows if confidence > 0}


def _inside(camera: CameraSpec, points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    return (points[..., :2] >= 0).all(axis=-1) & (points[..., :2] <= camera.size_px).all(axis=-1)


def subject_row(camera: CameraSpec, people: People, place: int | None, keypoints: int) -> Float[np.ndarray, "keypoint 3"]:
    """The subject's keypoints inside the image, among the people of a frame; NaN without a place."""
    row = np.full((keypoints, 3), np.nan) if place is None else people[place].copy()
    row[~_inside(camera, row)] = (np.nan, np.nan, 0.0)
    return row


def _written(session: Session, view: View, series: KeypointSeries) -> str:
    """Write the camera's file with the subject's keypoints inside the image; returns its name as the session writes it."""
    name = f"{FOLDER}/{view.camera.name}.npz"
    write_series(session.folder / name, series)
    return name


def _main_person(
    session: Session, views: Sequence[View], people: list[list[People]], names: tuple[str, ...], most: int, progress: bool
) -> tuple[Person | None, list[str]]:
    """The person who is seen in most pictures, with rows for all frames, and sentences about who is there. All people are written beside the session.

    None if no camera sees two people in any frame, if no two cameras agree on anybody, or if a camera moves.
    """
    if session.moves or all(len(group) < 2 for frame in people for group in frame):
        remove_detections(session)
        return None, []
    write_detections(session, views, people, names)
    persons = people_of([view.camera for view in views], people, session.fps, watched("following the people", progress))
    write_presences(session, persons)
    sentences = describe_people(persons, len(views), session.frame_number, most, MOST_PEOPLE)
    return (in_all_frames(persons[0], people) if persons else None), sentences
