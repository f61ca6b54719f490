import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from bayes_body.base.errors import InputError
from bayes_body.runs.study import study as study_module
from bayes_body.runs.study.attempt import Attempts
from bayes_body.runs.study.driver import Driver, Share, check_digests
from bayes_body.runs.study.overview import Overview
from bayes_body.runs.study.places import LocalPlaces
from bayes_body.runs.study.records import UnitFiles
from bayes_body.runs.study.status import counts_of, states_of, status
from bayes_body.runs.study.study import run_study
from bayes_body.runs.study.study_file import StudyFile
from bayes_body.runs.study.units import units_of
from bayes_body.view.study.rows import FAILED

STUB = Path(__file__).with_name("stub_unit.py")
SESSION = 'frames = 3\n[[camera]]\nname = "C1"\nsize_px = [640, 480]\n'


@pytest.fixture
def sessions(tmp_path):
    """Folders of three sessions of one shape."""
    folders = [tmp_path / "sessions" / f"walk_{letter}" for letter in "abc"]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "session.toml").write_text(SESSION)
    return folders


def study_of(sessions, **table):
    return StudyFile.model_validate({"sessions": [str(folder) for folder in sessions], "runs": 2} | table)


def driven(study, out, retries=3, most=2):
    """Compute a study of stubs; return the driver, its units and what it said."""
    lines, units = [], units_of(study, out)
    overview = Overview(study, units, out)
    driver = Driver(units, out, LocalPlaces(most, 1, Attempts((str(STUB),))), Share(retries=retries), lines.append, overview.note)
    driver.run()
    overview.write()
    return driver, units, lines


def computed(session):
    path = session / "computed"
    return Counter(path.read_text().splitlines()) if path.exists() else Counter()


def test_all_units_are_computed_once_and_a_failure_stops_nothing_else(sessions, tmp_path):
    out = tmp_path / "out"
    (sessions[1] / "fails").touch()
    driver, units, lines = driven(study_of(sessions), out)
    assert len(units) == 9 and len(driver.done) == 6
    assert set(driver.failures) == {"walk_b/run_1", "walk_b/run_2"}
    assert all("a stub that fails; expected another; remove `fails`" in sentence for sentence in driver.failures.values())
    assert any(line.startswith("places") and "2 units at once" in line for line in lines)
    once = Counter(f"run_{run} {frame}" for run in (1, 2) for frame in range(3))
    assert computed(sessions[0]) == computed(sessions[2]) == once
    states = states_of(units, out)
    assert counts_of(states) == {"done": 6, "running": 0, "failed": 2, "waiting": 1}
    (closing,) = [state for state in states if state.unit.key == "walk_b/closing"]
    assert closing.sentence == "needs walk_b/run_1, walk_b/run_2"
    page = (out / "index.html").read_text()
    assert "a stub that fails" in page and "walk_b/run_2" in page
    assert [line.split(",")[2] for line in (out / "study.csv").read_text().splitlines()[1:]] == ["done", "failed", "done"]
    # A session that is gone leaves its failures.
    (sessions[1] / "session.toml").rename(sessions[1] / "aside")
    assert counts_of(states_of(units_of(study_of(sessions), out), out))["failed"] == 2
    (sessions[1] / "aside").rename(sessions[1] / "session.toml")
    # The same call again computes only what failed, once its cause is removed.
    (sessions[1] / "fails").unlink()
    again, _, _ = driven(study_of(sessions), out)
    assert len(again.done) == 9 and not again.failures
    assert [computed(folder) for folder in sessions] == [once] * 3


def test_a_killed_unit_goes_on_after_its_last_frame(sessions, tmp_path):
    # It dies after each of its three frames: no frame is computed twice, and a death with a new frame is no failure.
    (sessions[0] / "dies").touch()
    driver, _, lines = driven(study_of(sessions[:1], runs=1, steps=[]), tmp_path / "out", retries=2)
    assert driver.done == {"walk_a/run_1"} and not driver.failures
    assert computed(sessions[0]) == Counter(f"run_1 {frame}" for frame in range(3))
    assert sum("SIGKILL" in line for line in lines) == 3


def test_a_unit_that_dies_again_and_again_stops_with_a_sentence(sessions, tmp_path):
    (sessions[0] / "dies_at_once").touch()
    driver, units, _ = driven(study_of(sessions[:2], runs=1, steps=[]), tmp_path / "out", retries=3)
    assert driver.done == {"walk_b/run_1"}
    sentence = driver.failures["walk_a/run_1"]
    assert "3 processes died one after the other without a new frame" in sentence and "run_1.log" in sentence
    assert [state.state for state in states_of(units, tmp_path / "out")] == [FAILED, "done"]


DRIVER = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from test_driver import driven, study_of
driven(study_of([Path(path) for path in sys.argv[2:]]), Path(sys.argv[1]))
"""


def test_a_killed_driver_takes_its_units_along_and_the_next_one_goes_on(sessions, tmp_path):
    out = tmp_path / "out"
    (sessions[1] / "waits").touch()
    script = tmp_path / "drive.py"
    script.write_text(DRIVER.format(path=[str(STUB.parent)]))
    process = subprocess.Popen([sys.executable, str(script), str(out), *map(str, sessions)], start_new_session=True)
    units = units_of(study_of(sessions), out)
    waiting = UnitFiles(out, "walk_b", "run_1")
    deadline = time.monotonic() + 60
    while not (waiting.is_locked() and waiting.read()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert counts_of(states_of(units, out))["running"] >= 1
    process.send_signal(signal.SIGKILL)
    process.wait()
    while waiting.is_locked() and time.monotonic() < deadline:
        time.sleep(0.05)
    # The unit has ended with its driver, which is no death of its own.
    assert not waiting.is_locked() and waiting.read().deaths == 0
    (sessions[1] / "waits").unlink()
    driver, _, _ = driven(study_of(sessions), out)
    assert len(driver.done) == 9
    assert all(set(computed(folder).values()) == {1} for folder in sessions)


def test_a_unit_of_another_driver_is_left_alone(sessions, tmp_path):
    out = tmp_path / "out"
    unit = units_of(study_of(sessions[:1]), out)[0]
    files = UnitFiles(out, unit.session, unit.name)
    files.log.parent.mkdir(parents=True)
    with files.lock:
        driver = Driver([unit], out, LocalPlaces(1, 1, Attempts((str(STUB),))), Share(), print, lambda event: None)
        job = driver._job(unit, False)
        assert Attempts((str(STUB),)).run(job).state == "elsewhere"
    assert not computed(sessions[0])


def people_of(recording, count):
    """Sessions of the people of a recording."""
    recording.mkdir(parents=True)
    (recording / "session.toml").write_text(SESSION)
    folders = [recording / "people" / f"person_{number}" for number in range(1, count + 1)]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "session.toml").write_text(SESSION)
    return folders


def test_pages_of_all_people_follow_their_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(study_module, "LocalPlaces", lambda most, cpus: LocalPlaces(2, 1, Attempts((str(STUB),))))
    out, people = tmp_path / "out", people_of(tmp_path / "hall", 3)

    def computed_again(study):
        lines = []
        return run_study(study, out, lines.append, bar=False), "\n".join(lines)

    def shown(page):
        return [Path(line).parent.name for line in page.read_text().splitlines()]

    # One whose run fails is left out.
    (people[1] / "fails").touch()
    study = study_of(people, runs=1)
    is_done, text = computed_again(study)
    assert not is_done and "note: pages of all people of hall: without person 2, whose tracking has failed." in text
    for name in ("overlay.mp4", "people.html", "people_3d.html"):
        assert shown(out / name) == ["hall_person_1", "hall_person_3"]
    # The report shows the pictures, so these are made first.
    assert (out / "made").read_text().split() == ["overlay", "report", "view"]
    index = (out / "index.html").read_text()
    assert 'All people: <a href="./people.html">report</a>' in index and "without person 2, whose tracking has failed." in index
    assert counts_of(status(out)[1]) == {"done": 5, "running": 0, "failed": 1, "waiting": 1}
    # The same command again fails again, and makes no page again.
    assert not computed_again(study)[0] and (out / "made").read_text().split() == ["overlay", "report", "view"]
    (people[1] / "fails").unlink()
    is_done, text = computed_again(study)
    assert is_done and "without" not in text and shown(out / "people.html") == ["hall_person_1", "hall_person_2", "hall_person_3"]
    assert computed_again(study)[0] and len((out / "made").read_text().split()) == 6
    assert "without" not in (out / "index.html").read_text()
    # A page that was removed is made again.
    (out / "people_3d.html").unlink()
    assert computed_again(study)[0] and (out / "people_3d.html").exists()


def test_other_options_than_those_of_the_folder_are_refused(sessions, tmp_path):
    out = tmp_path / "out"
    driven(study_of(sessions[:1]), out)
    # More runs, sessions and results extend a study; another seed or number of particles makes other draws.
    for table in ({"runs": 3}, {"steps": ["smooth", "report"]}, {"pictures": False}):
        check_digests(units_of(study_of(sessions, **table), out), out)
    for table in ({"particles": 50}, {"seed": 1}, {"set": {"step": 0.1}}):
        with pytest.raises(InputError, match=r"run_1 was made with other options.*name another folder with --out"):
            check_digests(units_of(study_of(sessions, **table), out), out)
    (sessions[0] / "session.toml").write_text(SESSION + "# corrected\n")
    with pytest.raises(InputError, match="its session has changed since"):
        check_digests(units_of(study_of(sessions[:1]), out), out)


def test_places_are_as_many_as_memory_allows(tmp_path):
    class Measured(Attempts):
        def peaks(self):
            return {"walk/run_1": 3_000_000_000}

    places = LocalPlaces(8, 1, Measured(), free=lambda: 10_000_000_000)
    assert places.capacity() == 1
    places.measure()
    # 15 % stay free.
    assert places.capacity() == 2
    assert places.describe() == "2 units at once, with one core each (a unit needs 3.0 GB, 10 GB are free)"
    assert LocalPlaces(8, 1, Measured(), free=lambda: None).describe().startswith("1 unit at once")


def test_a_full_disk_in_the_folder_of_states_is_a_failure_of_that_unit(sessions, tmp_path):
    out = tmp_path / "out"
    (out / ".study").mkdir(parents=True)
    # Where a folder is needed is a file: nothing can be written there.
    (out / ".study" / "walk_a").touch()
    driver, _, _ = driven(study_of(sessions[:2], runs=1, steps=[]), out)
    assert driver.done == {"walk_b/run_1"} and "cannot be made" in driver.failures["walk_a/run_1"]


def test_the_record_of_a_unit_survives_damage(tmp_path):
    files = UnitFiles(tmp_path, "walk", "run_1")
    assert files.read() is None
    files.log.parent.mkdir(parents=True)
    for text in ("", "{", "[]", json.dumps({"state": "done"})):
        (tmp_path / ".study" / "walk" / "run_1.json").write_text(text)
        assert files.read() is None
