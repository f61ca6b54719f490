import re
from pathlib import Path

import pytest

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.runs.study.people_pages import pages_units, people_groups
from bayes_body.runs.study.study import plan
from bayes_body.runs.study.study_file import StudyFile, read_study_file, write_study_file
from bayes_body.runs.study.unit_queue import UnitQueue
from bayes_body.runs.study.units import Unit, units_of

SESSION = 'frames = 300\n[[camera]]\nname = "C1"\nsize_px = [640, 480]\n'
STUDY = """
title = "Two ways"
sessions = ["sessions/*/"]
runs = 2
seed = 5
particles = 300
set = { step = 0.1, carry = "means" }
steps = ["smooth", "report", "gait"]
export = ["trc", "mot"]

[[variant]]
name = "laplace"

[[variant]]
name = "slow"
model = "mine.toml"
kernel = "tempered"
particles = 50
frames = 20
"""


@pytest.fixture
def folder(tmp_path):
    for name in ("b", "a"):
        (tmp_path / "sessions" / name).mkdir(parents=True)
        (tmp_path / "sessions" / name / "session.toml").write_text(SESSION)
    (tmp_path / "sessions" / "notes").mkdir()
    return tmp_path


def test_a_study_in_writing(folder):
    (folder / "study.toml").write_text(STUDY)
    notes = []
    study, units = plan(read_study_file(folder / "study.toml"), folder / "out", notes.append)
    assert notes == [f"note: {folder}/sessions/notes: no session.toml in it, left out."]
    assert [Path(session).name for session in study.sessions] == ["a", "b"]
    assert [unit.name for unit in units[:6]] == ["laplace_run_1", "laplace_run_2", "laplace_closing", "slow_run_1", "slow_run_2", "slow_closing"]
    assert len(units) == 12 and [unit.frames for unit in units[:6]] == [300, 300, None, 20, 20, None]
    track, smooth = units[4].commands
    assert track == (
        "track", f"{folder}/sessions/a", "--out", f"{folder}/out/a/slow_run_2", "--runs", "1", "--seed", "6", "--model", f"{folder}/mine.toml",
        "--kernel", "tempered", "--particles", "50", "--frames", "20", "--set", "step=0.1", "--set", 'carry="means"', "--no-pictures",
    )  # fmt: skip
    assert smooth[:4] == ("smooth", f"{folder}/out/a/slow_run_2", "--out", f"{folder}/out/a/slow_run_2_smoothed")
    verbs = [(command[0], Path(command[1]).name) for command in units[5].commands]
    combined = "slow_all_runs_smoothed"
    assert verbs == [
        ("combine", "slow_run_1"), ("combine", "slow_run_1_smoothed"), ("report", combined), ("gait", combined), ("export", combined),
    ]  # fmt: skip
    assert units[5].folder.name == combined and units[5].needs == ("a/slow_run_1", "a/slow_run_2")
    # One shape for each variant: the sessions' cameras are alike.
    assert len({unit.shape for unit in units}) == 4
    # What is written into the folder gives the same units, even if the folder is moved.
    write_study_file(study, folder / "out")
    assert units_of(read_study_file(folder / "out" / "study.toml"), folder / "out") == units
    moved = units_of(study, folder / "elsewhere")
    assert [(unit.digest, unit.work) for unit in moved] == [(unit.digest, unit.work) for unit in units]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('sessions = ["x"]\nrunz = 2', r"study.toml: runz: unknown key; did you mean 'runs'\?"),
        ('sessions = "x"', r'study.toml: sessions = "x"; expected a list; write its entries in brackets, with commas between.'),
        ("runs = 2", r"study.toml: sessions: missing; expected a list; add it."),
        ('sessions = ["x"]\nruns = 0', r"study.toml: runs = 0; expected a number greater than or equal to 1"),
        ('sessions = ["x"]\nsteps = ["gait"]', r'steps has "gait" without "smooth"'),
        ('sessions = ["x"]\n[[variant]]\nname = "a b"', r"study.toml: variant 'a b'.name = \"a b\""),
        ('sessions = ["x"]\n[[variant]]\nname = "a"\n[[variant]]\nname = "a"', r"variant 'a' is given twice"),
        ('sessions = ["nowhere/*/"]', r"nowhere/\*: matches nothing; expected folders made by `bayes-body import`; correct the pattern."),
        ('sessions = ["sessions/notes*/"]', r"none with a session.toml"),
    ],
)
def test_faults_of_a_study_are_sentences(folder, capsys, text, sentence):
    (folder / "study.toml").write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(["study", str(folder / "study.toml"), "--out", str(folder / "out"), "--dry-run"])
    error = capsys.readouterr().err
    assert stop.value.code == 2 and re.search(sentence, error) and "Traceback" not in error


def test_two_sessions_of_one_name_are_refused(folder):
    other = folder / "more" / "a"
    other.mkdir(parents=True)
    (other / "session.toml").write_text(SESSION)
    study = StudyFile(sessions=[str(folder / "sessions" / "*"), str(other)])
    with pytest.raises(InputError, match=r"sessions/a and .*more/a have one name; expected one name for each session.*rename one of them"):
        plan(study, folder / "out", print)


def test_pages_of_all_people_of_each_recording_and_variant(folder):
    out, sessions = folder / "out", []
    for recording, count in (("hall", 2), ("yard", 2), ("alone", 1)):
        people = [folder / recording / "people" / f"person_{number}" for number in range(1, count + 1)]
        for session in (folder / recording, *people):
            session.mkdir(parents=True)
            (session / "session.toml").write_text(SESSION)
        sessions += map(str, people)
    table = {"sessions": sessions, "pictures": False, "steps": ["smooth", "view"], "plugins": ["mine.py"]}
    study = StudyFile.model_validate(table | {"variant": [{"name": "slow"}, {"name": "quick", "pictures": True}]})
    units = units_of(study, out)
    keys = {unit.key for unit in units}
    assert [(group.title, group.folder.relative_to(out).as_posix()) for group in people_groups(study, units, out)] == [
        (f"{recording}, {variant}", f"{recording}_people/{variant}") for recording in ("hall", "yard") for variant in ("slow", "quick")
    ]
    for unit in units:
        unit.folder.mkdir(parents=True, exist_ok=True)
        (unit.folder / "summary.json").touch()
    # One fails in one way: then there is a single other person. A closing unit that fails takes no run away.
    failed = {"yard_person_2/quick_run_1", "hall_person_1/slow_closing"}
    over = keys - failed - {"yard_person_2/quick_closing"}
    hall, hall_quick, yard = pages_units(study, units, out, over, failed)
    assert (hall.key, hall_quick.key, yard.key) == ("hall_people/slow_pages", "hall_people/quick_pages", "yard_people/slow_pages")
    # Without pictures there is no video of all people either.
    runs = [str(out / f"hall_person_{number}" / "slow_run_1_smoothed") for number in (1, 2)]
    assert hall.commands == (
        ("report", *runs, "--out", str(hall.folder / "people.html"), "--plugin", "mine.py"),
        ("view", *runs, "--out", str(hall.folder / "people_3d.html"), "--plugin", "mine.py"),
    )
    assert [command[0] for command in hall_quick.commands] == ["overlay", "report", "view"]
    remarks = [group.remark(over, failed) for group in people_groups(study, units, out)]
    assert remarks == ["", "", "", "none, because the tracking of person 2 has failed"]
    # Of people who are still tracked there are no pages yet.
    assert not pages_units(study, units, out, {"hall_person_1/slow_run_1"}, set())


def test_several_sessions_in_one_track_are_a_study(folder, capsys, monkeypatch):
    from bayes_body.cli import study

    started = []
    monkeypatch.setattr(study, "start", lambda *arguments, **options: started.append((arguments, options)))
    sessions = [str(folder / "sessions" / name) for name in ("a", "b")]
    options = ["--runs", "3", "--set", 'carry="means"', "--set", "step=0.1", "--no-pictures"]
    command = ["track", *sessions, "--out", str(folder / "out"), *options]
    with pytest.raises(SystemExit) as stop:
        main(command)
    assert stop.value.code == 0
    ((described, out, cluster), _) = started[0]
    assert described.sessions == sessions and described.runs == 3 and cluster is None and out == folder / "out"
    assert described.set == {"carry": "means", "step": 0.1} and described.pictures is False
    for changed, sentence in (
        (command[:3], "--out: missing; expected a folder for the study of several sessions"),
        ([*command, str(folder / "sessions" / "notes")], "notes: no session.toml in it; expected the folder of a session"),
        ([*command, "--live", str(folder)], "--live: given with 2 sessions; expected one session"),
        ([*command, "--particles", "0"], "particles = 0"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(changed)
        assert stop.value.code == 2 and sentence in capsys.readouterr().err


def test_the_state_of_no_study_is_a_sentence(folder, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["status", str(folder)])
    assert stop.value.code == 2 and "no study.toml in it; expected the folder of a study" in capsys.readouterr().err


def unit_of(name, shape="s", needs=()):
    return Unit("walk", "", name, (), Path(name), shape, "", "", None, needs)


def test_others_of_a_shape_wait_until_its_first_unit_has_compiled():
    first, second, other = unit_of("run_1"), unit_of("run_2"), unit_of("run_1b", "other shape")
    closing = unit_of("closing", "closing", needs=(first.key, second.key))
    queue = UnitQueue([first, second, other, closing], [])
    assert queue.take() == (first, True)
    assert queue.take() == (other, True)
    assert queue.take() is None and queue and queue.compiling == [first, other]
    queue.has_compiled(first)
    assert queue.take() == (second, False)
    # A unit that dies while it compiles leaves its place to the next of its shape.
    queue.leave(other, is_done=False, is_over=False)
    queue.put(other)
    assert queue.take() == (other, True)
    queue.leave(first, is_done=True, is_over=True)
    assert queue.take() is None
    queue.leave(second, is_done=True, is_over=True)
    assert queue.take() == (closing, True)
    queue.leave(closing, is_done=True, is_over=True)
    assert not queue
