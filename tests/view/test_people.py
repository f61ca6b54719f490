"""Several people of one recording: who belongs together, and the pictures that show all of them."""

import shutil
import tomllib

import cv2
import numpy as np
import pytest
import tomlkit
from people_runs import person_run
from sealed import seal

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.results.metrics.fit import Outline
from bayes_body.results.storage.names import person_number
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.colours import bgr, person_colour
from bayes_body.view.overlay_people import Rectangle, _write_names, draw_people
from bayes_body.view.people import open_people, people_of


@pytest.fixture
def runs(make_run, textured_session, tmp_path):
    """The runs of two arms of one recording of frames 0 to 4: one in 0 to 2, the other in 2 to 4."""
    run = make_run()
    shutil.copytree(textured_session.folder, tmp_path / "session", dirs_exist_ok=True)
    return [
        person_run(run, tmp_path / "study", 1, range(3)),
        person_run(run, tmp_path / "study", 2, range(2, 5), {"shoulder_z": 1.5}),
    ]


def edited(run, change):
    """The run with another session."""
    document = tomllib.loads((run / "run.toml").read_text(encoding="utf-8"))
    session = tomllib.loads(document["session"]["text"])
    change(session)
    document["session"]["text"] = tomlkit.dumps(session)
    (run / "run.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
    seal(run, 3)
    return run


def test_who_is_there_and_when(runs, tmp_path):
    with open_people(runs[::-1]) as people:
        assert [person.name for person in people.persons] == ["person_1", "person_2"] and people.frames == range(5)
        assert [[(person.number, index) for person, index in people.present(frame)] for frame in range(5)] == [
            [(1, 0)],
            [(1, 1)],
            [(1, 2), (2, 0)],
            [(2, 1)],
            [(2, 2)],
        ]
        assert people.folder == tmp_path / "study" and people.session.frames == 5
        # A person of the recording of whom there is no run is named.
        recording = people.persons[0].run.session.folder.parents[1]
        assert people.missing == ""
        (recording / "people" / "person_4").mkdir()
        (recording / "people" / "person_4" / "session.toml").touch()
        assert people.name == recording.name and people.missing == "Not shown, for want of a finished run: person 4."
        second = people.persons[1]
        # Every second frame of the recording, from its first on.
        assert second.part_of(range(0, 5, 2)) == range(2, 5, 2) and second.part_of(range(1, 5, 2)) == range(3, 5, 2)
        assert not second.part_of(range(2)) and people.persons[0].part_of(range(5)) == range(3)
        poses = list(second.poses(range(2, 5, 2), 7))
        assert [pose.frame for pose in poses] == [2, 4] and all(pose.draws.shape == (7, 4) for pose in poses)
        stored = np.asarray(second.run.tree["posterior"]["pose"].isel(frame=2)).reshape(-1, 4)
        assert all((np.abs(stored - draw).max(axis=1) == 0).any() for draw in poses[1].draws)


def test_names_of_people():
    names = {"person_2": 2, "walk_person_13": 13, "person_0": None, "person": None, "person_2b": None, "walk": None}
    assert {name: person_number(name) for name in names} == names


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda session: session.update(fps=50.0), "50 frames a second; expected 60"),
        (lambda session: session.update(up="y"), "y points up; expected z"),
        (lambda session: session["camera"][1].update(name="c"), "the cameras a, c; expected a, b"),
        (lambda session: session["camera"][0].update(focal_px=[201.0, 205.0]), "camera 'a' is calibrated otherwise"),
        (lambda session: session["camera"][0].update(offset=1), "camera 'a' is calibrated otherwise, or has another offset"),
    ],
    ids=["rate", "up", "cameras", "calibration", "offset"],
)
def test_runs_of_different_recordings(runs, change, fault):
    edited(runs[1], change)
    with pytest.raises(InputError, match=fault), open_people(runs):
        pass


def test_one_person_is_not_several(runs):
    with load_run(runs[0]) as first, load_run(runs[0]) as twin:
        with pytest.raises(InputError, match="1 run; expected two or more"):
            people_of([first])
        with pytest.raises(InputError, match=r"a run of the same person as .*person_1"):
            people_of([first, twin])


def inked(picture, number):
    """How many pixels have the hue of a person's colour, on images that are grey."""
    hue, saturation, _ = np.moveaxis(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV).astype(int), -1, 0)
    wanted = int(cv2.cvtColor(np.array([[bgr(person_colour(number))]], np.uint8), cv2.COLOR_BGR2HSV)[0, 0, 0])
    return int(((abs(hue - wanted) < 8) & (saturation > 80)).sum())


def test_a_video_and_stills_of_all(runs, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["overlay", *map(str, runs)])
    assert stopped.value.code == 0
    path = tmp_path / "study" / "overlay.mp4"
    assert capsys.readouterr().out == f"{path}: {path.stat().st_size / 1e6:.1f} MB; 5 stills in {path.with_suffix('')}.\n"
    reader = cv2.VideoCapture(str(path))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and reader.get(cv2.CAP_PROP_FPS) == 60
    stills = sorted((tmp_path / "study" / "overlay").iterdir())
    assert [still.name for still in stills] == [f"frame_{frame:06d}.png" for frame in range(5)]
    # Who is not there is not drawn.
    drawn = [[inked(cv2.imread(str(still)), number) > 500 for number in (1, 2)] for still in stills]
    assert drawn == [[True, False], [True, False], [True, True], [False, True], [False, True]]


def test_nobody_is_said_and_no_image_is_shown(runs, tmp_path):
    later = person_run(tmp_path / "run", tmp_path / "study", 3, range(4, 5))
    with open_people([runs[0], later]) as people:
        _, *stills = draw_people(people, tmp_path / "all.mp4")
    # No run was made from the image of frame 3, so its file may be another one.
    assert np.median(cv2.imread(str(stills[3]))) == 30 and np.median(cv2.imread(str(stills[2]))) != 30


def test_a_video_of_another_name(runs, tmp_path, capsys):
    def status(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main(["overlay", *map(str, [*runs, *arguments])])
        return stopped.value.code, capsys.readouterr().err

    (tmp_path / "mine.mp4").write_text("mine")
    assert "already exists" in status("--out", tmp_path / "mine.mp4")[1] and (tmp_path / "mine.mp4").read_text() == "mine"
    assert "the suffix .mp4" in status("--out", tmp_path / "mine.avi")[1]
    assert status("--out", tmp_path / "new" / "all.mp4") == (0, "") and (tmp_path / "new" / "all" / "frame_000004.png").is_file()


def test_names_do_not_lie_on_each_other(runs, monkeypatch):
    written = []
    monkeypatch.setattr("bayes_body.view.overlay_people.write_text", lambda tile, text, place, *style: written.append((text, place)))
    head = [Outline("head", np.array([(100, 40), (120, 40), (110, 60)], float))]
    at_the_edge = [Outline("head", np.array([(290, -30), (310, 20), (300, 30)], float)), Outline("torso", np.array([(0, 0), (9, 9), (0, 9)], float))]
    outside = [Outline("head", np.array([(400, 40), (420, 40), (410, 60)], float))]
    with open_people(runs) as people:
        first, second = people.persons
        _write_names(np.zeros((200, 300, 3), np.uint8), [(first, "a", head), (second, "b", head), (first, "c", at_the_edge), (second, "d", outside)])
    places = dict(written)
    assert places["a"][1] == 32 and abs(places["b"][1] - 32) > 12 and "d" not in places
    assert places["c"][0] < 290 and places["c"][1] > 10


def test_rectangles_overlap():
    box = Rectangle(10, 10, 20, 20)
    assert box.overlaps(Rectangle(19, 19, 30, 30)) and box.overlaps(Rectangle(0, 0, 40, 40))
    assert not box.overlaps(Rectangle(20, 10, 30, 20)) and not box.overlaps(Rectangle(10, 0, 20, 10))
