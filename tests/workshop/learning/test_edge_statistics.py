"""What filters answer on boundaries: found again from draws of a known law, learned from rendered people, and held against real and unseen ones."""

import itertools
import math
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from learn_edge_statistics import Images, fit, mean_log_density

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.model.definition import load_definition
from bayes_body.model.likelihood.edge_phase import PHASE_SD, EdgeStatistics
from bayes_body.recording.evidence.edge_phase import Response
from bayes_body.recording.observation.edge_phase import Points, displaced, elsewhere_points, outline_points, responses, sampled


def _shipped():
    (term,) = load_definition("poon_fleet_2002_legs").likelihoods
    return {
        scale.wavelength_px: EdgeStatistics(*(np.array(getattr(scale, name)) for name in ("epsilon", "amplitude", "log_amplitude", "log_occluded")))
        for scale in term.options.scale
    }


def test_a_known_law_is_found_again():
    rng = np.random.default_rng(0)
    number = 40_000
    share = rng.beta(3.0, 1.6, number)
    edge = rng.random(number) < 0.4 + 0.5 * share
    phase = np.where(edge, rng.normal(math.pi / 2, PHASE_SD, number), rng.uniform(0, math.pi, number))
    amplitude = np.exp(0.5 + 3.0 * share)
    weak = np.exp(rng.normal(0.0, 1.0, number))
    turn = rng.uniform(0, 2 * math.pi, number)
    found = fit(Response(amplitude * np.cos(phase), amplitude * np.sin(phase)), Response(weak * np.cos(turn), weak * np.sin(turn)))
    # Of the ends of the range one in a hundred is cut off.
    assert np.allclose(found.epsilon, [0.4, 0.9], atol=0.08)
    assert np.allclose(found.log_amplitude, [0.5, 3.5], atol=0.45)
    # Hidden lies half way between a boundary and elsewhere.
    on = mean_log_density(Response(amplitude * np.cos(phase), amplitude * np.sin(phase)), found)
    off = mean_log_density(Response(weak * np.cos(turn), weak * np.sin(turn)), found)
    assert on > found.log_occluded + 1 and np.isclose(found.log_occluded, (on + off) / 2)


def test_too_few_points_are_said():
    few = Response(np.ones(50), np.ones(50))
    with pytest.raises(InputError, match="50 points on boundaries, 50 elsewhere; expected at least 200 of each; give more frames"):
        fit(few, few)


def test_points_stand_on_the_outline_and_look_across_it():
    mask = np.zeros((200, 300), np.uint8)
    cv2.circle(mask, (150, 100), 60, 1, -1)
    points = outline_points(mask > 0)
    outward = points.places - np.array([150.0, 100.0])
    radius = np.linalg.norm(outward, axis=1)
    assert len(radius) > 60 and np.abs(radius - 60).max() < 0.8
    assert np.sum(points.normals * outward / radius[:, None], axis=1).min() > 0.99
    rng = np.random.default_rng(0)
    moved = np.linalg.norm(displaced(points, 5.0, rng).places - np.array([150.0, 100.0]), axis=1)
    assert np.allclose(np.abs(moved - radius), 5.0, atol=0.1)
    away = np.linalg.norm(elsewhere_points(mask > 0, 200, rng).places - np.array([150.0, 100.0]), axis=1)
    assert len(away) == 200 and np.abs(away - 60).min() > 10


def test_what_the_border_cuts_is_no_outline():
    mask = np.zeros((100, 100), bool)
    mask[40:, 30:70] = True
    points = outline_points(mask)
    assert points.places[:, 1].max() < 93 and len(outline_points(np.zeros((50, 50), bool)).places) == 0


PROGRAM = Path(__file__).parents[3] / "inference" / "learn" / "learn_edge_statistics.py"


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walks")
    for name, subject in (("one", "1"), ("another", "2")):
        command = ["simulate", "walk", "--rig", "side_1", "--subject", subject, "--seed", subject, "--frames", "8", "--masks"]
        with pytest.raises(SystemExit) as end:
            main([*command, "--out", str(folder / name)])
        assert end.value.code in (0, None)
    return folder


@pytest.mark.long
def test_it_learns_from_one_and_holds_on_another(walks, program_runner, tmp_path):
    done = program_runner(PROGRAM, walks / "one", "--frames", 6, "--held-out", walks / "another", "--plot", tmp_path / "p.png")
    assert done.status == 0
    said = done.out
    tables = tomllib.loads(said)["likelihood"]["scale"]
    assert [table["wavelength_px"] for table in tables] == [8.0, 16.0]
    assert cv2.imread(str(tmp_path / "p.png")).shape[1] > 800
    rows = [[float(word) for word in line[1:].split()] for line in said.splitlines() if line.startswith("#  ")]
    assert len(rows) == 2
    for _, there, *others in rows:
        assert there > max(others) + 0.3


@pytest.mark.long
def test_a_recording_without_known_silhouettes_is_said(walks, program_runner):
    for mask in sorted((walks / "another" / "true_masks").rglob("*.png")):
        mask.rename(mask.with_suffix(".kept"))
    try:
        done = program_runner(PROGRAM, walks / "another")
        assert done.status == 2 and "no known silhouettes" in done.err
    finally:
        for mask in sorted((walks / "another" / "true_masks").rglob("*.kept")):
            mask.rename(mask.with_suffix(".png"))


@pytest.mark.long
@pytest.mark.parametrize("wavelengths", ["8,x", "", "1"])
def test_wavelengths_that_cannot_be_are_said(walks, wavelengths, program_runner):
    done = program_runner(PROGRAM, walks / "one", "--wavelengths", wavelengths)
    assert done.status == 2 and "numbers from 3 up" in done.err


# Boundaries of the walker of sports2d_walk, frame 100, traced by hand on the enlarged picture: column and row.
TRACED = [
    [(990.5, 733.4), (985.7, 754.8), (977.7, 774.9), (968.8, 793.7), (964.0, 809.7)],
    [(962.1, 837.9), (960.3, 867.3)],
    [(1022.4, 769.6), (1013.0, 784.3), (1002.3, 797.7), (994.3, 809.7), (991.1, 827.1), (989.5, 848.6), (987.6, 870.0)],
    [(1023.8, 770.9), (1033.1, 787.0), (1045.2, 808.4), (1054.6, 828.5), (1069.3, 843.2), (1082.7, 855.3), (1094.7, 870.0)],
    [(1061.8, 741.4), (1065.3, 762.9), (1072.0, 789.6), (1080.0, 808.4), (1093.4, 824.5), (1104.1, 840.5), (1114.8, 859.3)],
    [(1069.3, 628.9), (1068.8, 658.4)],
    [(1067.7, 687.9), (1066.6, 714.6)],
    [(994.3, 687.9), (995.6, 709.3)],
    [(1001.0, 661.1), (970.2, 675.8), (946.1, 690.5)],
    [(1018.4, 666.4), (997.0, 685.2), (964.8, 701.3)],
    [(1069.3, 698.6), (1080.0, 720.0), (1086.7, 733.4)],
    [(1076.0, 671.8), (1084.0, 690.5), (1090.7, 716.0)],
    [(959.5, 872.7), (955.4, 888.8), (950.1, 904.8)],
    [(979.6, 872.7), (972.9, 891.4)],
]


def _traced():
    """A point every two pixels."""
    places, normals = [], []
    for line in TRACED:
        for first, second in itertools.pairwise(line):
            along = np.subtract(second, first)
            length = np.linalg.norm(along)
            steps = (np.arange(int(length // 2)) + 0.5) * 2 / length
            places += [np.asarray(first) + step * along for step in steps]
            normals += [np.array([-along[1], along[0]]) / length] * len(steps)
    return Points(np.array(places), np.array(normals))


@pytest.mark.slow
def test_on_a_real_still_the_true_boundary_wins(sports2d_walk):
    video = cv2.VideoCapture(str(next(sports2d_walk.rglob("*.mp4"))))
    video.set(cv2.CAP_PROP_POS_FRAMES, 100)
    grey = cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2GRAY)
    points, rng = _traced(), np.random.default_rng(0)
    around = Points(rng.uniform([900, 600], [1180, 920], (2000, 2)), np.stack([np.cos(a := rng.uniform(0, math.pi, 2000)), np.sin(a)], axis=1))
    total = {}
    for wavelength, statistics in _shipped().items():
        maps = responses(grey, wavelength)
        for name, where in [(f"{by:g}", displaced(points, by, np.random.default_rng(1))) for by in (0.0, 2.0, 5.0, 10.0)] + [("elsewhere", around)]:
            total[name] = total.get(name, 0.0) + mean_log_density(sampled(maps, where), statistics)
    print({name: round(value, 2) for name, value in total.items()})
    assert total["0"] > max(value for name, value in total.items() if name != "0") + 0.2


def test_images_without_a_person_give_no_points():
    nothing = Images([(np.zeros((60, 60), np.uint8), np.zeros((60, 60), bool))])
    assert [len(each.even) for each in nothing.at(8.0, (0.0, None))] == [0, 0]
