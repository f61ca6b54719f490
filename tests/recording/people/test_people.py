"""Who is there: films of two and three people, as a network writes them, and the shares of people who exclude each other."""

import json
from itertools import product

import numpy as np
import pytest
from crowd_walks import CrowdNetwork, background_film, crossing_film, detect, door_film, poster_film, write_project

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.person import distinct_people
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.people.files import in_all_frames, series_of
from bayes_body.recording.readers.people.people import describe_people, people_of
from bayes_body.recording.readers.people.record import read_crowd, write_people
from bayes_body.recording.readers.people.shares import MOST_LOG, joint_shares, mean_field_shares
from bayes_body.recording.readers.people.tracks import MOST_PEOPLE, limited
from bayes_body.recording.session.read import load_session


def seen_people(film, seed):
    """The people of each frame and camera without doubles, and the true number of everybody in them."""
    detections = detect(film, seed=seed)
    people, numbers = [], []
    for frame in range(len(detections.points[0])):
        groups = [camera[frame] for camera in detections.points]
        distinct = [distinct_people(group) if len(group) else group for group in groups]
        rows = [
            [next(i for i, row in enumerate(group) if np.array_equal(row, one, equal_nan=True)) for one in few]
            for group, few in zip(groups, distinct, strict=True)
        ]
        people.append(distinct)
        numbers.append([camera[frame][row] for camera, row in zip(detections.numbers, rows, strict=True)])
    return people, numbers


def identities(person, numbers):
    """The true number of a person in each frame, by the majority of the cameras; 0 where nobody is seen."""
    rows = [
        [numbers[person.first + row][c][place] for c, place in enumerate(places) if place >= 0] for row, places in enumerate(person.places.tolist())
    ]
    return np.array([np.bincount(row).argmax() if row else 0 for row in rows])


def wrong_places(person, numbers):
    """In how many pictures the likeliest detection is of somebody else than in most, and in how many there is one."""
    rows = enumerate(person.places.tolist(), person.first)
    seen = [numbers[frame][c][place] for frame, places in rows for c, place in enumerate(places) if place >= 0]
    return np.sum(np.array(seen) != np.bincount(seen).argmax()), len(seen)


@pytest.mark.slow
def test_two_who_cross_twice_are_not_exchanged():
    film = crossing_film(6)
    people, numbers = seen_people(film, 6)
    persons = people_of(film.rig.cameras, people, film.rig.fps)
    assert len(persons) == 2
    for person in persons:
        seen = identities(person, numbers)
        usual = np.bincount(seen).argmax()
        assert (seen[seen > 0] != usual).sum() <= 3
        assert person.frames == len(people)
        assert person.misfit < 0.05
    # Somebody whom a camera does not see has none of the detections of somebody else there.
    wrong, seen = np.sum([wrong_places(person, numbers) for person in persons], axis=0)
    assert wrong <= 0.005 * seen


@pytest.mark.slow
def test_one_leaves_and_one_enters_and_a_poster_is_nobody():
    film = door_film(0, frames=150, leaves=60, enters=90)
    persons = people_of(film.rig.cameras, seen_people(film, 0)[0], film.rig.fps)
    assert len(persons) == 3
    assert sorted((person.first, person.last) for person in persons) == [
        (pytest.approx(0, abs=10), pytest.approx(59, abs=10)),
        (pytest.approx(0, abs=10), pytest.approx(149, abs=10)),
        (pytest.approx(90, abs=10), pytest.approx(149, abs=10)),
    ]
    film = poster_film(1, frames=90)
    assert len(people_of(film.rig.cameras, seen_people(film, 1)[0], film.rig.fps)) == 1


def test_one_camera_follows_in_the_image():
    film = background_film(2, 40)._replace(cameras=("C1",))
    persons = people_of(film.rig.cameras, seen_people(film, 2)[0], film.rig.fps)
    assert persons[0].bodies.shape[-1] == 2
    assert persons[0].pictures > 30


def test_shares_are_sums_over_all_assignments():
    weights = np.random.default_rng(0).uniform(0.5, 20, (2, 3, 4))
    expected = np.array([summed_shares(frame) for frame in weights])
    np.testing.assert_allclose(joint_shares(weights), expected, atol=2e-3)
    # A detection is of one person at most.
    assert joint_shares(weights).sum(axis=-2).max() <= 1
    # Where somebody explains a detection beyond doubt, both ways exclude the others, also by weights that are as large as they get.
    sure = np.array([[1.0, 1e-12], [0.8, 0.5]])
    for way, scale in product((joint_shares, mean_field_shares), (1e2, np.exp(MOST_LOG))):
        assert way(scale * sure)[0, 0] > 0.9
        assert way(scale * sure)[1, 1] > 0.9


def summed_shares(weights):
    """Shares by all assignments, one after the other."""
    shares, total = np.zeros(weights.shape), 0.0
    people, detections = weights.shape
    for chosen in product(range(detections + 1), repeat=people):
        taken = [k for k in chosen if k < detections]
        if len(set(taken)) < len(taken):
            continue
        weight = np.prod([weights[p, k] for p, k in enumerate(chosen) if k < detections])
        total += weight
        for p, k in enumerate(chosen):
            if k < detections:
                shares[p, k] += weight
    return shares / total


def test_of_a_crowd_the_largest_are_looked_at():
    rng = np.random.default_rng(0)
    # Forty of one shape, in random order of size.
    sizes = rng.permutation(40) + 1.0
    crowd = rng.uniform(0, 10, (15, 3)) * sizes[:, None, None]
    people, most = limited([[crowd]])
    assert most == 40
    (sentence,) = describe_people([], 4, int, most, MOST_PEOPLE)
    assert sentence == "A camera sees 40 people in one frame: the 12 largest of each picture are looked at."
    np.testing.assert_array_equal(people[0][0], crowd[sizes > 40 - MOST_PEOPLE])


def test_one_who_is_detected_twice_everywhere_is_one_person():
    film = background_film(2, 16).alone(1)
    people = [list(frame) for frame in zip(*detect(film, CrowdNetwork(doubled=1.0), 2).points, strict=True)]
    assert sum(len(group) == 2 for frame in people for group in frame) > 50
    # As an import leaves the second detections out, and even with all of them.
    distinct = [[distinct_people(group) if len(group) else group for group in frame] for frame in people]
    for frames in (distinct, people):
        (person,) = people_of(film.rig.cameras, frames, film.rig.fps)
        assert person.pictures > 50


def test_frames_in_which_nobody_is_detected():
    """As files are read: without people a frame has no keypoints either."""
    film = background_film(2, 40)
    people, _ = seen_people(film, 2)
    for c in range(len(people[20])):
        people[20][c] = np.zeros((0, 0, 3))
    people[21][1] = np.zeros((0, 0, 3))
    few = [[np.full((1, len(MARKERS), 3), np.nan)] for _ in range(10)]
    few[0][0][0, :3] = 5.0
    assert people_of(film.rig.cameras[:1], few, film.rig.fps) == []
    # Two who leave in the same frame.
    nobody = [np.zeros((0, 0, 3))] * len(film.rig.cameras)
    gone = people_of(film.rig.cameras, [*people[:12], *[nobody] * 12], film.rig.fps)
    assert [person.last for person in gone] == [11, 11]
    persons = people_of(film.rig.cameras, people, film.rig.fps)
    assert len(persons) == 2
    series = series_of(in_all_frames(persons[0], people), film.rig.cameras[1], 1, people, MARKERS, 0)
    assert series.frame(20) == {}
    assert len(series.bystanders_in(20)) == 0
    crowd = [[np.zeros((0, 0, 3)), np.ones((40, len(MARKERS), 3))]]
    assert [len(group) for group in limited(crowd)[0][0]] == [0, MOST_PEOPLE]


@pytest.mark.slow
def test_everybody_becomes_a_session(tmp_path, capsys, monkeypatch):
    write_project(tmp_path / "project", background_film(2, 60), seed=2)
    with pytest.raises(SystemExit, match="0"):
        main(["import", "pose2sim", str(tmp_path / "project"), str(tmp_path / "session"), "--up", "z", "--fps", "60"])
    assert "There are 2 people. Person 1 is the subject" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="0"):
        main(["people", str(tmp_path / "session")])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if line[:1].isdecimal()] == ["1", "2"]
    for number in (1, 2):
        session = load_session(tmp_path / "session" / "people" / f"person_{number}")
        assert session.frames == 60
        assert (session.folder / "picture.png").exists()
        series = read_series(session.keypoints_path(session.views[0]))
        assert series.candidates.shares.sum(axis=1).max() <= 1
        assert len(series.bystanders_in(10)) >= 1
    # What somebody has edited is kept when it is made anew, and said; what nobody has edited is not.
    edited = tmp_path / "session" / "people" / "person_2" / "session.toml"
    text = edited.read_text(encoding="utf-8") + "# corrected by hand\n"
    edited.write_text(text, encoding="utf-8")
    session = load_session(tmp_path / "session")
    _, remarks = write_people(session, read_crowd(session))
    assert [remark for remark in remarks if "edited" in remark] == [
        f"person 2: its session.toml was edited, and is made anew. The edited one is now {edited.with_name('session_edited.toml')}: "
        "repeat the changes that still hold."
    ]
    assert edited.with_name("session_edited.toml").read_text(encoding="utf-8") == text and "by hand" not in edited.read_text(encoding="utf-8")
    # Whoever tracks without a choice is told whom, and what else can be chosen.
    monkeypatch.setattr("bayes_body.cli.track._run", lambda *arguments: None)
    record = tmp_path / "session" / "detections" / "people.json"
    rows = json.loads(record.read_text())
    assert [row["last"] for row in rows] == [59, 59] and rows[0]["pictures"] >= rows[1]["pictures"]
    for text, sentence, is_close in (
        (json.dumps(rows), f"most cameras for the longest time: in {rows[0]['pictures']} pictures of 4 cameras, frames 0 to 59, person 2 in", True),
        (json.dumps([rows[0], rows[1] | {"pictures": 20}]), "person 2 in 20. --person 2 tracks another one, --person all everybody;", False),
        ('[{"pictures": ', "Several people are in view: person 1 is tracked, who is seen by most cameras", False),
        ("[]", "", False),
    ):
        record.write_text(text)
        with pytest.raises(SystemExit, match="0"):
            main(["track", str(tmp_path / "session"), "--out", str(tmp_path / "run")])
        output = " ".join(capsys.readouterr().out.split())
        assert sentence in output and bool(sentence) == ("is tracked" in output) and is_close == ("Person 2 is seen nearly as much" in output)
    for text, sentence in (("7", "--person: 7, but"), ("two", "--person: 'two'; expected the number of a person, from 1 up, or all"), ("0", "'0'")):
        with pytest.raises(SystemExit, match="2"):
            main(["track", str(tmp_path / "session"), "--person", text])
        assert sentence in capsys.readouterr().err


def test_a_session_without_several_people_says_so(tmp_path):
    from keypoint_walks import Network, person_of, shipped_walk, walk_session

    session, _ = walk_session(tmp_path / "walk", person_of(shipped_walk(2, 0), False), Network())
    with pytest.raises(InputError, match="one person is tracked without --person"):
        read_crowd(session)
