"""Check that a session's files exist and match its cameras, without reading all of them, and that its cameras and its person are possible."""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.agreement.verdict import describe_contradiction
from bayes_body.recording.readers.camera_path import read_camera_path
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.images import NotSeenError, check_size, is_image, read_colour, read_grey, read_mask
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.videos.pairing import NEAR_RATE, SAME_RATE
from bayes_body.recording.readers.videos.video import damaged_frames, probe, read_clock, readable_frames
from bayes_body.recording.session.session import Session, View

MOST_RANGES = 20
BLIND = "the camera counts as not seeing the person there"
# A newborn child is longer.
SHORTEST_M = 0.4
# Cameras that are closer together tell as little about depth as a single one.
LEAST_APART_M = 0.01


def check_session(session: Session, frames: int | None = None, decode: bool = True) -> list[str]:
    """Look for every file of every frame, read the first and the last image of every camera, and check every video's rate and frames.

    Args:
        session: the recording.
        frames: how many of its first frames will be used, all by default. Videos are decoded that far, to find damage.
        decode: whether they are. Without it, damage is not noticed, and a video's length is checked only by a look at its last frame.

    Returns:
        Remarks for the user, one sentence each: which frames some cameras did not see, and whether the keypoints contradict the cameras.

    Raises:
        FaultyFileError: one sentence for each camera without any image, and for each file that does not match the session; if all cameras stand in
            one place, and if nobody is as small as the person.
    """
    faults, remarks = Faults(), []
    for check in (_check_height, _check_places):
        with faults.collect():
            check(session)
    for view in session.views:
        owner = f"camera '{view.camera.name}'"
        with faults.collect():
            if view.video is not None:
                used = min(frames or session.frames, session.frames) if decode else 0
                remarks += _check_video(session, view, owner, used)
        for kind, read in (("images", read_grey), ("masks", read_mask)):
            if (pattern := getattr(view, kind)) is not None:
                # Strings: a session of a million frames would need minutes to make so many `Path`.
                numbers = ((session.frame_number(k), session.file_number(view, k)) for k in range(session.frames))
                files = ((frame, os.path.join(session.folder, pattern % number)) for frame, number in numbers if number is not None)  # noqa: PTH118
                remarks += _check_series(faults, owner, kind, files, lambda path, read=read, view=view: read(path, view.camera.size_px))
        with faults.collect():
            _check_background(session, view)
        if (keypoints := session.keypoints_path(view)) is not None:
            with faults.collect():
                read_series(keypoints)
        path = session.camera_path(view)
        if path is not None:
            with faults.collect():
                read_camera_path(path, session.skipped + session.frames)
    faults.raise_any()
    return [*remarks, *describe_contradiction(session)]


def _check_height(session: Session) -> None:
    height = session.subject.height_m
    if height is not None and height < SHORTEST_M:
        raise input_error("session.toml: subject.height_m", f"{height:g}", f"metres, at least {SHORTEST_M:g}", "give the person's height in metres")


def _check_places(session: Session) -> None:
    centres = np.array([-view.camera.rotation.T @ view.camera.translation_m for view in session.views])
    if len(centres) > 1 and np.linalg.norm(centres - centres[0], axis=-1).max() < LEAST_APART_M:
        place = ", ".join(f"{coordinate:.3g}" for coordinate in centres[0] + 0.0)
        problem = f"all {len(centres)} cameras stand in one place, ({place}) m in the world"
        remedy = "check rotation and translation_m of each [[camera]]: X_camera = rotation X_world + translation; or keep one camera"
        raise input_error("session.toml: camera", problem, f"cameras at least {LEAST_APART_M:g} m apart", remedy)


def _check_series(faults: Faults, owner: str, kind: str, files: Iterable[tuple[int, str]], read: Callable[[Path], Any]) -> list[str]:
    """Check one series of files, each with its frame's number. Returns remarks on missing files; errors go to `faults`."""
    ends, missing, count, first_file = list[Path](), list[int](), 0, ""
    for number, file in files:
        count, first_file = count + 1, first_file or file
        if os.path.exists(file):  # noqa: PTH110
            # Only the first and the last are read.
            ends[1:] = [Path(file)] if ends else []
            ends = ends or [Path(file)]
        else:
            missing.append(number)
    remedy = f"correct {kind}, first_frame and frames in session.toml"
    if not ends:
        with faults.collect():
            raise input_error(
                owner, f"all {count} {kind} are missing, the first is {first_file}", "a file for every frame", f"restore them, or {remedy}"
            )
        return []
    remarks = [f"{owner}: {_share(len(missing), count, kind)} ({named(missing)}): {BLIND}; restore them, or {remedy}."] if missing else []
    with faults.collect():
        read(ends[0])
    if len(ends) > 1:
        with faults.collect():
            try:
                read(ends[1])
            except NotSeenError as error:
                remarks.append(f"{owner}: {str(error).rstrip('.')}; in this frame {BLIND.removesuffix(' there')}.")
    return remarks


def _share(count: int, total: int, kind: str) -> str:
    return f"{count} of {total} {kind} {'is' if count == 1 else 'are'} missing"


def _check_video(session: Session, view: View, owner: str, used: int) -> list[str]:
    path = session.video_path(view)
    if path is None:
        return []
    info = probe(path)
    check_size(path, info.size_px, view.camera.size_px)
    remarks = [*_check_rate(path, info.fps, session.fps, view), *_check_gaps(path, view)]
    # The number of each frame in the file, by the number that the user knows.
    numbers = {session.frame_number(frame): number for frame in range(session.frames) if (number := session.file_number(view, frame)) is not None}
    end = readable_frames(path, max(numbers.values(), default=0) + 1)
    readable = {frame: number for frame, number in numbers.items() if number < end}
    if not readable:
        first = min(numbers.values(), default=session.number(view, 0))
        problem, remedy = f"{path} has {readable_frames(path, first + 1)} frames", "correct first_frame and the camera's offset in session.toml"
        raise input_error(owner, problem, f"more than {first}, the number of the first", remedy)
    decoded = {number: frame for frame, number in readable.items() if frame < session.frame_number(used)}
    damaged = [decoded[number] for number in damaged_frames(path, list(decoded))]
    if damaged and len(damaged) == len(decoded):
        raise input_error(owner, f"{path}: every frame is damaged", "a video that can be decoded without errors", "copy the video again")
    if damaged:
        problem = f"{len(damaged)} of {session.frames} frames cannot be decoded without errors ({named(damaged)}), {path} is damaged"
        remarks.append(f"{owner}: {problem}: {BLIND}; copy the video again.")
    lost = [frame for frame in range(session.frame_number(0), session.frame_number(session.frames)) if frame not in numbers]
    if lost:
        remarks.append(f"{owner}: {_share(len(lost), session.frames, 'frames')} ({named(lost)}), {path} has none at their times: {BLIND}.")
    if len(readable) < len(numbers):
        missing = [frame for frame in numbers if frame not in readable]
        problem = f"{_share(len(missing), session.frames, 'frames')} ({named(missing)}), {path} ends before them"
        remarks.append(f"{owner}: {problem}: {BLIND}; copy the video again, or correct first_frame and frames in session.toml.")
    return remarks


def _check_gaps(path: Path, view: View) -> list[str]:
    """A remark on a video that lost frames, in a session that counts them as if it had not."""
    steps = np.diff(read_clock(path).instants)
    if view.spans or not (steps > 1).any():
        return []
    gap = int(np.argmax(steps > 1))
    problem = f"its timestamps show that {int((steps[steps > 1] - 1).sum())} frames were lost, the first after frame {gap}"
    return [f"{path}: {problem}, and session.toml counts the later ones as if it had none: import the recording again, which pairs frames by time."]


def _check_rate(path: Path, stated: float, fps: float, view: View) -> list[str]:
    """Compare the rate that a video states (0 if it does not) with the session's, or with the one that the session expects of this file."""
    expected = view.video_fps or fps
    off = abs(stated - expected) / expected
    if not stated or off <= SAME_RATE:
        return []
    if off <= NEAR_RATE:
        drift = f"after {1 / off / expected:.0f} s the session's times are one frame off"
        return [f"{path}: {stated:g} frames per second, and {expected:g} in session.toml: {drift}; correct fps if the video is right."]
    key = "fps" if view.video_fps is None else f"video_fps of camera '{view.camera.name}'"
    remedy = "name the right video, or correct fps; where the camera filmed at fps but its file states another rate, add video_fps to the camera"
    raise input_error(path, f"{stated:g} frames per second", f"{expected:g}, {key} in session.toml", remedy)


def _check_background(session: Session, view: View) -> None:
    path = session.background_path(view)
    if path is None:
        return
    if path.is_file() and is_image(path):
        read_colour(path, view.camera.size_px)
    else:
        check_size(path, probe(path).size_px, view.camera.size_px)


def named(frames: Sequence[int]) -> str:
    """`frames 3, 7-9` of ascending numbers; the first twenty ranges."""
    ranges: list[list[int]] = []
    for frame in frames:
        if ranges and ranges[-1][1] == frame - 1:
            ranges[-1][1] = frame
        else:
            ranges.append([frame, frame])
    listed = [str(a) if a == b else f"{a}-{b}" for a, b in ranges[:MOST_RANGES]]
    return f"frame{'s' if len(frames) > 1 else ''} " + ", ".join([*listed, *(["..."] if len(ranges) > MOST_RANGES else [])])
