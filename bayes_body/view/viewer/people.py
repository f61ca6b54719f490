"""Several people of one recording as one 3D scene: each in a colour with the name above the head, with one time line.

Somebody who is not there in a frame is not shown in it. Images are those of the run of the first person who is there, for each run shows only files
from which it was made; keypoints are those of all who are there.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bayes_body.base.files.atomic import check_free, has_mark, make_folder, write_text
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.storage.names import PEOPLE_VIEW_FILE
from bayes_body.view.colours import CAMERAS, TRUTH
from bayes_body.view.people import People
from bayes_body.view.report.markup import Markup, joined, tag
from bayes_body.view.viewer.motion import LARGEST, Budget, Pose, read_poses
from bayes_body.view.viewer.page import CONTROLS, MARK, MEDOID, SEEKER, dot, filled, lost_sentence
from bayes_body.view.viewer.recording import Recording, Seen, read_recording
from bayes_body.view.viewer.scene import Figure, Scene, deaf_server, look_at


def write_people_view(
    people: People, out: Path | None = None, draws: int = 50, frames: range | None = None, watch: Watch = unwatched, overwrite: bool = False
) -> tuple[Path, list[str]]:
    """Write the 3D scene of several people: one HTML file. Return its path, and sentences on what it does not show.

    Args:
        people: the people.
        out: the file; by default PEOPLE_VIEW_FILE in the folder that holds the runs.
        draws: number of draws of each frame, all people together.
        frames: the frames, counted from the first in which anybody is there; all by default.
        watch: wraps the places of the frames to show progress.
        overwrite: whether to replace a file that is not a view.

    Raises:
        InputError: the file exists and is not a view, it cannot be written, or a file of a run or the recording cannot be used.
    """
    path = out or people.folder / PEOPLE_VIEW_FILE
    check_free(path, overwrite or has_mark(path, MARK))
    first = people.frames.start
    chosen = range(len(people.frames)) if frames is None else frames
    recordings = [read_recording(person.run) for person in people.persons]
    parts = max(len(person.run.model.body.topology.names) for person in people.persons)
    # All bodies share the page.
    person_draws = draws // len(people.persons)
    budget = Budget(len(people.persons) * person_draws * parts, max(sum(recording.pictured) for recording in recordings))
    step = budget.step(len(chosen))
    while True:
        shown = range(first + chosen.start, first + chosen.stop, chosen.step * step)
        remarks = list(_remarks(people, recordings, shown, len(chosen), step))
        page = _page(people, recordings, shown, person_draws, budget.side(len(shown)), remarks, watch)
        if len(page.encode()) < LARGEST or len(shown) == 1:
            break
        step *= 2
    make_folder(path.parent)
    write_text(path, page)
    return path, remarks


def _remarks(people: People, recordings: Sequence[Recording], shown: range, frames: int, step: int) -> Iterator[str]:
    if people.missing:
        yield people.missing
    for person in people.persons:
        numbers = person.part_of(shown)
        indices = range(numbers.start - person.run.first_frame, numbers.stop - person.run.first_frame, numbers.step)
        yield from (f"{person.label.capitalize()}: {sentence}" for sentence in lost_sentence(person.run, indices))
    if step > 1:
        yield f"One frame in {step} of {frames:,} is shown, so that the file stays small. Fewer draws leave room for more frames."
    if any(person.run.mode_seeker for person in people.persons):
        yield SEEKER
    yield from dict.fromkeys(sentence for recording in recordings for sentence in recording.missing)


def _page(people: People, recordings: Sequence[Recording], shown: range, draws: int, side: int, remarks: Sequence[str], watch: Watch) -> str:
    """Return the page's HTML."""
    figures = [Figure(person.run.settled_model.body, person.label, person.colour) for person in people.persons]
    poses: list[dict[int, Pose]] = []
    for person in people.persons:
        numbers = person.part_of(shown)
        indices = range(numbers.start - person.run.first_frame, numbers.stop - person.run.first_frame, numbers.step)
        count = 0 if person.run.mode_seeker else draws
        poses.append(dict(zip(numbers, read_poses(person.run, indices, count), strict=True)))
    cameras = [view.camera for view in people.session.views]
    with deaf_server() as server:
        look = look_at([pose for track in poses for pose in track.values()], cameras, people.session.up)
        # Keypoints are dark: their usual colour is that of a person here.
        scene = Scene(server.scene, people.session.up, look, CAMERAS)
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = look.eye, look.middle, look.fov
        record = server.get_scene_serializer()
        has_truth = has_keypoints = False
        for place in watch(range(len(shown))):
            evidence = _evidence(people, recordings, shown[place], side)
            has_truth, has_keypoints = has_truth or bool(len(evidence.truth)), has_keypoints or bool(len(evidence.keypoints))
            bodies = [(figure, track.get(shown[place])) for figure, track in zip(figures, poses, strict=True)]
            scene.show(bodies, evidence, f"frame {shown[place]}, {(shown[place] - people.frames.start) / people.fps:.2f} s")
            if len(shown) > 1:
                record.insert_sleep(shown.step / people.fps)
        html = record.as_html()
    medoids = sum(not pose.is_mean for track in poses for pose in track.values())
    sentences = [MEDOID.format(count=medoids, frames=sum(map(len, poses)))] if medoids else []
    return filled(html, f"{people.name} in 3D", _text(people, draws, has_truth, has_keypoints, [*sentences, *remarks]))


def _evidence(people: People, recordings: Sequence[Recording], number: int, side: int) -> Seen:
    """Return what the recordings of those who are there have in a frame; cameras without images if nobody is."""
    present = [(person, recording) for person, recording in zip(people.persons, recordings, strict=True) if number in person.frames]
    # The images of the first are those of all.
    evidence = [recording.frame(number - person.run.first_frame, None if place else side) for place, (person, recording) in enumerate(present)]
    if not evidence:
        cameras = [view.camera for view in recordings[0].session.views]
        return Seen(cameras, [None] * len(cameras), np.zeros((0, 3)), np.zeros((0, 3)))
    return evidence[0]._replace(
        truth=np.concatenate([entry.truth for entry in evidence]), keypoints=np.concatenate([entry.keypoints for entry in evidence])
    )


def _text(people: People, draws: int, has_truth: bool, has_keypoints: bool, remarks: Sequence[str]) -> Markup:
    layers = [
        *(tag("li", dot(person.colour), f"{person.label}, frames {person.frames.start} to {person.frames[-1]}") for person in people.persons),
        *([tag("li", f"Lines: {draws} draws from the posterior of each person and frame. A line is the axis of a part.")] if draws else []),
        *([tag("li", dot(TRUTH), "true markers")] if has_truth else []),
        *([tag("li", dot(CAMERAS), "keypoints, triangulated")] if has_keypoints else []),
    ]
    axes = "World axes: x red, y green, z blue. Tiles of the floor: 1 m."
    return joined([tag("ul", *layers, tag("li", axes)), *(tag("p", remark) for remark in remarks), tag("p", CONTROLS, class_="soft")])
