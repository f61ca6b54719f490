"""The films of `crowd_walks`: paths cross twice, detections belong to the people, and `bayes-body import` reads what is written."""

import numpy as np
import pytest
from crowd_walks import count_crossings, crossing_film, detect, door_film, poster_film, write_project

from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.pose2sim import import_pose2sim
from bayes_body.recording.readers.truth import read_truth
from bayes_body.workshop.simulation.visibility import pixels


@pytest.mark.slow
def test_two_people_cross_twice_and_their_detections_are_in_random_order():
    film = crossing_film(2, frames=150)
    first, second = (member.person.markers[:, MARKERS.index("pelvis"), :2] for member in film.members)
    assert count_crossings(first[::5], second[::5]) == 2
    assert np.linalg.norm(first - second, axis=1).min() > 0.4
    seen, alone = detect(film), detect(film.alone(2))
    numbers = seen.numbers[0]
    pairs = [tuple(frame) for frame in numbers if sorted(frame) == [1, 2]]
    assert 0.3 < np.mean([pair == (1, 2) for pair in pairs]) < 0.7
    # Doubles, and frames in which one hides the other or the network misses one.
    assert any(len(frame) > 2 for frame in numbers) and any(len(set(frame)) < 2 for camera in seen.numbers for frame in camera)
    errors = []
    for camera, points, people, copies in zip(film.rig.cameras, seen.points, seen.numbers, alone.points, strict=True):
        for frame, (rows, who) in enumerate(zip(points, people, strict=True)):
            truth = {member.number: pixels(camera, member.person.markers[frame])[0] for member in film.members}
            errors += [np.linalg.norm(row[:, :2] - truth[number], axis=1) for row, number in zip(rows, who, strict=True)]
            # The same errors as when filmed alone.
            for row in rows[who == 2]:
                assert any((np.isclose(row, copy) | np.isnan(row)).all() for copy in copies[frame])
    assert np.nanmedian(errors) < 5


@pytest.mark.slow
def test_a_project_is_imported_and_a_poster_stands_still(tmp_path):
    film = poster_film(0, 12)
    found = write_project(tmp_path / "project", film)
    assert not (np.concatenate(found.numbers[0]) == 2).any() and (np.concatenate(found.numbers[2]) == 2).any()
    session, _ = import_pose2sim(tmp_path / "project", tmp_path / "session", Options(up="z", fps=60.0))
    assert session.frames == 12 and all(view.keypoints for view in session.views)
    assert len(np.unique(read_truth(tmp_path / "project/truth_person_2.npz", 12)[:, 0], axis=0)) == 1


@pytest.mark.slow
def test_one_leaves_and_one_enters():
    film = door_film(0, frames=60, leaves=20, enters=40)
    frames = [{number for camera in detect(film).numbers for number in camera[frame]} for frame in range(60)]
    assert all(2 not in numbers for numbers in frames[20:]) and all(3 not in numbers for numbers in frames[:40])
    assert 2 in frames[18] | frames[19] and 3 in frames[40] | frames[41]
