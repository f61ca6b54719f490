"""One code of colours: chosen in one file, and told apart by people who do not see all colours."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

import bayes_body
from bayes_body.view.colours import OVER_IMAGE, PEOPLE, RUN_LINES, SIDES, side_of

PACKAGE = Path(bayes_body.__file__).parent
CHOICE = re.compile(r"""["'](\#[0-9a-fA-F]{3,8}|C\d|tab:\w+|0\.\d+)["']|cmap=["']|colou?r=["'](?!white|black|none)""")
# What deuteranopes and protanopes see of linear red, green, blue (Machado, Oliveira & Fernandes 2009, severity 1).
SEEN = {
    "everyone": np.eye(3),
    "deuteranopes": np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
    "protanopes": np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
}


def test_no_other_file_chooses_a_colour():
    files = [
        file for room in ("view", "calibration", "clinical", "recording") for file in (PACKAGE / room).rglob("*.py") if file.name != "colours.py"
    ]
    chosen = {file.name: found[0] for file in files if (found := CHOICE.search(file.read_text(encoding="utf-8")))}
    assert len(files) > 80 and chosen == {}


@pytest.mark.parametrize("people", SEEN)
def test_sides_differ_for_all_people(people):
    """Distances in CIELAB: about 2 can be seen at all, 30 are different colours."""
    for colours in ([tuple(bytes.fromhex(ink[1:])) for ink in SIDES.values()], list(OVER_IMAGE.values())):
        left, right, middle = (lab(SEEN[people] @ linear(colour)) for colour in colours)
        assert np.linalg.norm(left - right) > 90
        assert min(np.linalg.norm(left - middle), np.linalg.norm(right - middle)) > 30


@pytest.mark.parametrize("people", SEEN)
def test_tracked_people_differ_for_all_people(people):
    for colours in ([tuple(bytes.fromhex(ink[1:])) for ink, _ in PEOPLE], [colour for _, colour in PEOPLE]):
        places = [lab(SEEN[people] @ linear(colour)) for colour in colours]
        assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(places, 2)) > 20


def linear(colour):
    share = np.array(colour) / 255
    return np.where(share > 0.04045, ((share + 0.055) / 1.055) ** 2.4, share / 12.92)


def lab(rgb):
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ rgb / [0.9505, 1.0, 1.089]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(np.maximum(xyz, 0)), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_sides_of_names():
    names = {
        "l_knee": "l",
        "r_elbow": "r",
        "knee_flexion_l": "l",
        "hip_rotation_r": "r",
        "torso": "",
        "lumbar_extension": "",
        "root_x": "",
        "left": "",
    }
    assert {name: side_of(name) for name in names} == names


def test_runs_have_different_lines():
    assert all(a != b for a, b in itertools.combinations(RUN_LINES, 2))
