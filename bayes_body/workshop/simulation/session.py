"""Write a simulated recording as a session: videos, empty scenes or silhouettes, calibration, a first pose as a user would give it, and the truth."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.rig import Rig
from bayes_body.recording.session.read import FILE_NAME, load_session, save_session
from bayes_body.recording.session.session import Session, Subject, View
from bayes_body.workshop.simulation.film import (
    MASKS,
    TRUE_MASKS,
    TRUE_MASKS_OF_ALL,
    Camera,
    Picture,
    Reel,
    backgrounds,
    cameras,
    empty_name,
    film_empty,
    mask_pattern,
    video_name,
)
from bayes_body.workshop.simulation.options import Options, Quality
from bayes_body.workshop.simulation.person import Performance, Person
from bayes_body.workshop.simulation.session_files import (
    CALIBRATION,
    TRUTH,
    camera_name,
    write_calibration,
    write_detections,
    write_extrinsics,
    write_truth,
)
from bayes_body.workshop.simulation.staging import Landmarks, stacked
from bayes_body.workshop.simulation.visibility import check_visibility, detect_people, detected

type Watch = Callable[[Sequence[int]], Iterable[int]]
WORKERS = min(8, os.cpu_count() or 2)
# The folder of keypoints in a project of Pose2Sim.
POSES = "pose"


class Bystander(NamedTuple):
    """A further person in the film: landmarks in all of its frames, as those of the first person, and the person."""

    landmarks: Landmarks
    person: Person


def simulate(
    landmarks: Landmarks,
    rig: Rig,
    person: Person,
    options: Options,
    folder: Path,
    *,
    title: str = "a simulated recording",
    truth: Mapping[str, np.ndarray] | None = None,
    bystanders: Sequence[Bystander] = (),
    watch: Watch = iter,
) -> tuple[Session, list[str]]:
    """Film a person in a motion with the cameras of a rig, and others beside, and write the session of the first person.

    Args:
        landmarks: the 15 markers at the rig's frame rate (and toes, finger ends, neck if known), metres, z up, floor at 0.
        rig: the cameras.
        person: the person to be filmed.
        options: clutter, noise, silhouettes.
        folder: the session's folder; created if needed.
        title: one line for the reader.
        truth: further arrays for truth.npz, such as a body's angles.
        bystanders: further people.
        watch: wraps the iteration over frames, to show progress.

    Returns:
        The session as read from its file, and remarks for the user, one sentence each.

    Raises:
        InputError: the folder already holds a session or cannot be written, a background is missing, a marker is unknown, or a bystander's motion has
            another number of frames.
        FaultyFileError: some cameras do not see the person; one sentence for each.
    """
    check_folder(folder)
    markers = stacked(landmarks)
    remarks = check_visibility(rig, markers)
    people = [landmarks, *(bystander.landmarks for bystander in bystanders)]
    markers_of_all = np.stack(
        [markers, *(_same_frames(stacked(bystander.landmarks), number, len(markers)) for number, bystander in enumerate(bystanders, 2))]
    )
    performances = [person.perform(landmarks, rig.fps), *(bystander.person.perform(bystander.landmarks, rig.fps) for bystander in bystanders)]
    quality = options.segmentation or ("good" if any(path is not None for path in rig.path) else None)
    posed = rig.posed(len(markers))
    make_folder(folder)
    filming = cameras(posed, rig.grey, rig.fps, backgrounds(rig, people, options), options, quality)
    kinds = _mask_kinds(options, quality, len(people))
    _film(performances, filming, rig, folder, kinds, _detector(rig, filming, markers_of_all, options, folder), watch)
    if quality is None:
        with ThreadPoolExecutor(WORKERS, thread_name_prefix="film") as pool:
            list(pool.map(lambda camera, spec: film_empty(camera, folder / empty_name(spec.name), rig.fps, spec.size_px), filming, rig.cameras))
    write_calibration(folder / CALIBRATION, rig.cameras)
    write_truth(folder / TRUTH, markers, landmarks, truth or {})
    for number, (tracks, places) in enumerate(zip(people[1:], markers_of_all[1:], strict=True), 2):
        write_truth(folder / truth_name(number), places, tracks, {})
    moving = {posed[c][0].name: posed[c] for c, path in enumerate(rig.path) if path is not None}
    for name, specs in moving.items():
        write_extrinsics(folder / camera_name(name), specs)
    session = _session(rig, person, folder, title, markers, options, quality)
    return load_session(save_session(session)), remarks


def truth_name(number: int) -> str:
    """The file of a bystander's truth, relative to the session's folder; the first bystander is person 2."""
    return f"truth_person_{number}.npz"


def _same_frames(markers: Float[np.ndarray, "frame 15 3"], number: int, frames: int) -> Float[np.ndarray, "frame 15 3"]:
    if len(markers) != frames:
        raise input_error(f"the motion of person {number}", f"{len(markers)} frames", f"{frames}, as the first person's", "cut both to one length")
    return markers


type Detector = Callable[[int, int, Picture], None]


def _detector(
    rig: Rig, filming: Sequence[Camera], markers: Float[np.ndarray, "person frame 15 3"], options: Options, folder: Path
) -> Detector | None:
    """Writes the keypoints of all people in a picture of a camera and frame; None if none are wanted."""
    if not options.keypoints:
        return None
    folders = [folder / POSES / f"{camera.name}_json" for camera in rig.cameras]
    for place in folders:
        make_folder(place)

    def detect(camera: int, frame: int, picture: Picture) -> None:
        rng = np.random.default_rng((options.seed, 19, camera, frame))
        people = detect_people(rng, filming[camera].spec(frame), markers[:, frame], picture.true_masks, options.keypoint_sd_px)
        write_detections(folders[camera], rig.cameras[camera].name, frame, people)

    return detect


def check_folder(folder: Path) -> None:
    """Refuse a folder that already holds a session.

    Raises:
        InputError: it holds one.
    """
    if (folder / FILE_NAME).exists():
        raise input_error(folder, f"already holds a {FILE_NAME}", "a folder without one", "name another folder, or remove it")


def _mask_kinds(options: Options, quality: Quality | None, people: int) -> list[str]:
    true_masks = [TRUE_MASKS, *([TRUE_MASKS_OF_ALL] if people > 1 else [])] if options.true_masks else []
    return [*([MASKS] if quality is not None else []), *true_masks]


def _film(
    performances: Sequence[Performance],
    filming: Sequence[Camera],
    rig: Rig,
    folder: Path,
    masks: Sequence[str],
    detect: Detector | None,
    watch: Watch,
) -> None:
    """Take and write all frames: pictures in threads, files in temporal order."""
    with ExitStack() as stack:
        reels = [Reel(stack, folder, camera, rig.fps, masks) for camera in rig.cameras]
        pool = stack.enter_context(ThreadPoolExecutor(WORKERS, thread_name_prefix="film"))
        taken = _taken(pool, performances, filming)
        for frame in watch(range(len(performances[0]))):
            for camera, (reel, picture) in enumerate(zip(reels, next(taken), strict=True)):
                reel.add(picture.result(), frame)
                if detect is not None:
                    detect(camera, frame, picture.result())


def _taken(pool: ThreadPoolExecutor, performances: Sequence[Performance], filming: Sequence[Camera]) -> Iterator[list[Future[Picture]]]:
    """All cameras' images of each frame. Those of the next frame are computed while one is consumed."""
    next_frame: list[Future[Picture]] = []
    for frame in range(len(performances[0])):
        meshes = [performance.mesh(frame) for performance in performances]
        following = [pool.submit(camera.take, meshes, frame) for camera in filming]
        if next_frame:
            yield next_frame
        next_frame = following
    yield next_frame


def _session(
    rig: Rig, person: Person, folder: Path, title: str, markers: Float[np.ndarray, "frame 15 3"], options: Options, quality: Quality | None
) -> Session:
    views = []
    for camera, path in zip(rig.cameras, rig.path, strict=True):
        masks = None if quality is None else mask_pattern(MASKS, camera.name)
        background = empty_name(camera.name) if quality is None else None
        file = None if path is None else camera_name(camera.name)
        views.append(View(camera, video=video_name(camera.name), masks=masks, background=background, path=file))
    height = round(person.build.height_m, 3)
    return Session(
        folder.resolve(),
        title,
        "z",
        rig.fps,
        len(markers),
        0,
        tuple(views),
        Subject(height_m=height),
        initial_keypoints=_keypoints(rig, markers[0], options),
        # With one camera a small person cannot be distinguished from a distant one.
        fit_lengths=len(rig.cameras) > 1,
        fit_outline=len(rig.cameras) > 1,
        truth=TRUTH,
    )


def _keypoints(rig: Rig, markers: Float[np.ndarray, "15 3"], options: Options) -> dict[str, dict[str, tuple[float, float, float]]]:
    """A detector's keypoints in the first frame, in the cameras that do not move, or in all cameras if all of them move."""
    points = dict(zip(MARKERS, markers, strict=True))
    fixed_cameras = [c for c, path in enumerate(rig.path) if path is None] or range(len(rig.cameras))
    by_camera = {}
    for c in fixed_cameras:
        rng = np.random.default_rng((options.seed, 17, c))
        keypoints = detected(rng, rig.cameras[c], points, options.keypoint_sd_px)
        if keypoints:
            by_camera[rig.cameras[c].name] = keypoints
    return by_camera
