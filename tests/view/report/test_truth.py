"""The section on the true markers: there only where they are known, its sentences and its table from figures that are known."""

import re

import numpy as np
import pytest

from bayes_body.model.build import build_model
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.results.posterior import markers
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.report.figures import MOST_POINTS, style
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.page import LARGEST, SECTIONS, fitted, sections_of
from bayes_body.view.report.truth import measured, truth_section

DOFS = ("shoulder_x", "shoulder_y", "shoulder_z", "elbow")
ARM = {"dofs": DOFS, "units": ("rad",) * 4}
NAMES = ("l_shoulder", "l_elbow", "l_wrist")


@pytest.fixture(scope="module")
def arm(textured_session):
    return build_model("arm", textured_session)


def truth_of(arm, poses, beside):
    """The arm's markers at the poses (frame, dof), moved by `beside`; those that it has not are unknown."""
    truth = np.full((len(poses), 15, 3), np.nan)
    truth[:, [MARKERS.index(name) for name in NAMES]] = markers(arm, poses.astype(np.float32)) + np.asarray(beside)
    return truth


def still(frames, runs=2, draws=60, spread=0.0):
    """Poses (chain, draw, frame, dof) around others at each frame, and these."""
    rng = np.random.default_rng(4)
    centres = rng.uniform(-0.5, 0, (frames, 4))
    return centres + spread * rng.normal(size=(runs, draws, frames, 4)), centres


def rows(found) -> dict[str, list[str]]:
    """A table's rows by their first cell."""
    cells = [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", found)]
    return {first: rest for first, *rest in cells}


def test_without_a_truth_there_is_no_section_and_with_one_it_is_led_to(inspect, parse, arm):
    pose, centres = still(5, spread=0.1)
    it = inspect(**ARM, pose=pose, truth=truth_of(arm, centres, [0, 0, 0.01]))
    with style():
        found = parse(fitted(it, [truth_section(it)], LARGEST))
    led_to = [name for name, _, _ in SECTIONS if name not in ("gait", "joint", "chains", "messages", "unknowns")]
    assert [each["href"][1:] for each in found.of("a")] == led_to == [name for name, _, _ in sections_of(it)]
    assert [each["id"] for each in found.of("section")] == ["truth"]
    without = inspect()
    assert measured(without.run) is None and "truth" not in [name for name, _, _ in sections_of(without)]


def test_sentences_and_table_say_what_is_so(inspect, parse, arm):
    """All particles on one pose: the error is what the truth was moved by, and no interval holds it."""
    pose, centres = still(12)
    beside = [[0.0, 0.01, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.06]]
    it = inspect(**ARM, frames=12, pose=pose, truth=truth_of(arm, centres, beside))
    with style():
        found = truth_section(it)
    text = parse(found).text
    assert "The mean markers are 30 mm from the true ones (standard deviation over the frames 0 mm)" in text
    assert "for the best particle of each frame 30 mm" in text and "relative to the pelvis" not in text
    assert re.search(r"The 90 % intervals contain the truth in \d+ % of cases: too narrow\.", text)
    assert "With the offset between the two skeletons fitted, the error is" in text
    table = rows(found)
    assert list(table)[1:] == ["left wrist", "left elbow", "left shoulder"], "largest error first"
    head = table["marker"]
    assert head == ["error, mm", "offset fitted, mm", "length of the offset, mm", "inside 90\u00a0%"]
    assert [table[name][0] for name in ("left shoulder", "left elbow", "left wrist")] == ["10", "20", "60"]
    alts = [image["alt"] for image in parse(found).of("img")]
    assert alts[0] == "Error of the mean markers over the frames, from 30 to 30 mm." and "90 %: " in alts[1]
    # No truth is nearer to the median than the draws, which all lie on it: the mean of the levels below 1 is the error.
    assert alts[2] == "Expected calibration error: median over the markers 0.50, worst 0.50 of left shoulder."
    assert alts[3] == "Mean error from 30 mm in the most certain tenth of the frames to 30 mm in all."
    assert "All markers together (TARP): coverage differs by -0.95" in text and "level 0.95: too narrow." in text


@pytest.mark.slow
def test_of_a_sound_posterior_the_intervals_are_about_right(inspect, parse, arm):
    pose, _ = still(60, draws=201, spread=0.1)
    truth = truth_of(arm, pose[0, 0], np.zeros(3))
    # The shoulder cannot move: an interval without width.
    truth[:, MARKERS.index("l_shoulder")] = np.nan
    it = inspect(**ARM, frames=60, draws=200, pose=pose[:, 1:], truth=truth)
    with style():
        found = truth_section(it)
    assert "about right" in parse(found).text and rows(found)["left shoulder"] == ["–"] * 4
    plain = measured(it.run).plain
    error, expected = plain.frame_error, plain.expected
    assert abs(((expected[:, [0]] < error) & (error < expected[:, [3]])).mean() - 0.9) < 4 * np.sqrt(0.9 * 0.1 / 60)


def test_a_mode_seeker_promises_nothing(inspect, parse, arm):
    pose, centres = still(5, spread=0.1)
    it = inspect(**ARM, pose=pose, log_evidence=np.full((2, 5), np.nan), truth=truth_of(arm, centres, [0, 0, 0.01]))
    with style():
        found = truth_section(it)
    assert "a mode seeker's particles is not a measure of uncertainty" in parse(found).text and "intervals contain" not in parse(found).text
    # Five frames are too few for an offset.
    assert rows(found)["marker"] == ["error, mm"] and len(parse(found).of("img")) == 1 and "90 % interval" not in parse(found).text


@pytest.mark.slow
def test_a_long_run_is_thinned_and_each_frame_meets_its_own_truth(inspect, parse, arm):
    frames = MOST_POINTS + 1
    pose, centres = still(frames, runs=1, draws=20)
    beside = np.zeros((frames, 1, 3))
    # Only frames that are shown are right.
    beside[1::2] = 0.5
    it = inspect(**ARM, runs=1, draws=20, frames=frames, pose=pose, truth=truth_of(arm, centres, beside))
    with style():
        found = parse(truth_section(it))
    assert "The mean markers are 0 mm from the true ones" in found.text
    assert f"Measured in every 2nd frame of {frames:,}; summary.json has all." in found.text


@pytest.mark.slow
def test_a_truth_that_is_gone_or_of_other_markers_is_said(make_run, inspect, parse, arm):
    pose, centres = still(5)
    folder = make_run(**ARM, pose=pose, truth=truth_of(arm, centres, [0, 0, 0.01]))
    (folder.parent / "session" / "truth.npz").unlink()
    with load_run(folder) as run:
        assert "can no longer be compared with the truth" in parse(truth_section(Inspection(run))).text
    # Another file of the same name, such as a stranger's run may name.
    np.savez(folder.parent / "session" / "truth.npz", markers=truth_of(arm, centres, [0, 0, 1]), names=np.array(MARKERS))
    with load_run(folder) as run:
        assert "truth.npz: not the file of the time of the run" in parse(truth_section(Inspection(run))).text
    # The posterior of this one is of another body than its definition says.
    other = parse(truth_section(inspect(truth=truth_of(arm, centres, [0, 0, 0.01])))).text
    assert "can no longer be compared with the truth" in other and "dofs root_x" in other
    nothing = parse(truth_section(inspect(**ARM, pose=pose, truth=np.full((5, 15, 3), np.nan)))).text
    assert "None of the body's markers has a true position" in nothing
