"""A walking cycle in joint angles: modes that were put in are found, people count alike, and what ships explains other people's walks."""

import numpy as np
import pytest
from workshop.learning.walking_fit import aligned, reconstruct

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.model.body.build import build_body
from bayes_body.model.definition import load_body
from bayes_body.model.dynamics.angle_cycle import load_angle_cycle
from bayes_body.recording.readers.mocap import read_motion
from bayes_body.workshop.learning.gait import heel_strikes, height, points_of, terms
from bayes_body.workshop.learning.walking_angles import AngleWalk, angles_of_walk, learn_angles, unusable
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk

BODY, FPS, DOFS = "person_31", 60.0, 25
# Walks of two people whom the cycle was not learned from; the others are long.
FEW = ("35_02", "38_01")
MORE = ("35_01", "35_05", "35_07", "35_08", "35_09", "35_28", "35_30", "38_02")
MOST_DEG = 6.0


@pytest.fixture(scope="module")
def schema():
    return load_body(BODY)


@pytest.fixture(scope="module")
def topology(schema):
    return build_body(BODY, schema).skeleton.topology


@pytest.fixture(scope="module")
def points():
    """Landmarks of a walk of four whole strides; the angles that the tests give with it are their own."""
    return walk(load_cycle(), 6.0, FPS)


@pytest.fixture(scope="module")
def modes():
    """A mean and two modes of unequal size, as Fourier terms: none is part of another."""
    rng = np.random.default_rng(0)
    mean, one, two = (scale * rng.normal(size=(17, DOFS)) / np.arange(1, 18)[:, None] for scale in (0.1, 0.02, 0.004))
    return mean, one, two


def _walk(points, series, subject, name="walk"):
    """Angles by these Fourier terms, at the phase between heel strikes."""
    strikes = heel_strikes(points, FPS, height(points, points_of(points)))
    known = np.concatenate([[2 * strikes[0] - strikes[1]], strikes, [2 * strikes[-1] - strikes[-2]]])
    phase = np.interp(np.arange(len(points["pelvis"])), known, np.arange(len(known)))
    return AngleWalk(name, subject, terms(phase) @ series, points, FPS)


def test_people_count_alike_however_often_they_walk(points, modes, schema):
    mean, one, _ = modes
    walks = [_walk(points, mean + one, "a")] * 3 + [_walk(points, mean - one, "b")]
    found = learn_angles(walks, BODY, schema)
    assert len(found.cycle.modes) == 1 and found.cycle.explained > 0.99
    assert np.allclose(found.cycle.mean, mean, atol=1e-6)
    # Two people at plus and minus one: their standard deviation is one.
    assert min(np.abs(found.cycle.modes[0] - sign * one).max() for sign in (1, -1)) < 1e-6
    assert found.strides == 4 * (len(heel_strikes(points, FPS, height(points, points_of(points)))) - 1)


def test_only_modes_for_the_variance_are_kept(points, modes, schema):
    mean, one, two = modes
    people = {"a": one + two, "b": one - two, "c": -one + two, "d": -one - two}
    found = learn_angles([_walk(points, mean + away, person) for person, away in people.items()], BODY, schema).cycle
    # The second mode has a 25th of the variance of the first.
    assert len(found.modes) == 1 and 0.95 < found.explained < 0.97


def test_turns_and_second_solutions_are_no_variation(points, modes, schema, topology):
    mean, one, _ = modes
    here = _walk(points, mean + one, "a")
    other = here.angles.copy()
    names = list(topology.dof_names[6:])
    y, x, z = (names.index(f"l_shoulder_{axis}") for axis in "yxz")
    other[:, [y, x, z]] = np.stack([other[:, y] + np.pi, np.pi - other[:, x], other[:, z] - np.pi], axis=1)
    other[:, names.index("r_shoulder_z")] -= 2 * np.pi
    found = learn_angles([here, here._replace(angles=other, subject="b"), _walk(points, mean - one, "c")], BODY, schema).cycle
    assert len(found.modes) == 1 and np.abs(found.modes).max() < 1.5 * np.abs(one).max()


def test_a_walk_is_reconstructed_and_its_coefficients_found(points, modes, schema, topology):
    mean, one, two = modes
    people = {"a": one + 5 * two, "b": one - 5 * two, "c": -one + 5 * two, "d": -one - 5 * two}
    cycle = learn_angles([_walk(points, mean + away, person) for person, away in people.items()], BODY, schema).cycle
    found = reconstruct(cycle, aligned(_walk(points, mean + 0.5 * one, "e"), cycle, topology), 2)
    # Phases are found on a grid of 0.005.
    assert found.error_deg < 0.5
    away = cycle.mean + np.tensordot(found.coefficients, cycle.modes, 1) - mean
    assert np.abs(away - 0.5 * one).max() < 2e-3


def test_too_few_strides_are_a_sentence(points, modes, schema):
    short = {name: each[:30] for name, each in points.items()}
    with pytest.raises(InputError, match="0 strides; expected at least 2 whole strides"):
        learn_angles([AngleWalk("short", "a", np.zeros((30, DOFS)), short, FPS)], BODY, schema)


def test_the_residual_that_ships_is_that_of_people(topology):
    cycle = load_angle_cycle()
    assert cycle.body == BODY and cycle.names == topology.dof_names[6:]
    assert 3 <= len(cycle.modes) <= 8 and cycle.explained >= 0.95
    assert 2 < np.degrees(np.sqrt(np.mean(cycle.residual**2))) < 8


@pytest.mark.long
@pytest.mark.parametrize("name", [*FEW, *(pytest.param(name, marks=pytest.mark.long) for name in MORE)])
@pytest.mark.usefixtures("optimised")
def test_other_people_walk_by_five_modes(cmu_mocap, schema, topology, name):
    cycle = load_angle_cycle()
    motion = read_motion(cmu_mocap / name[:2] / f"{name}.amc")
    found = aligned(angles_of_walk(name, name[:2], motion, BODY, schema), cycle, topology)
    # No angle is a turn or a second solution away.
    assert np.abs(found.angles.mean(axis=0) - cycle.mean[0]).max() < np.radians(45)
    assert reconstruct(cycle, found, 5).error_deg < MOST_DEG


def test_a_run_and_a_short_walk_are_known_before(cmu_mocap):
    run, alone = (read_motion(cmu_mocap / name[:2] / f"{name}.amc") for name in ("02_03", "35_01"))
    assert unusable("02_03", run) == "02_03: 2.6 m/s is a run: left out"
    assert unusable("35_01", alone) == "35_01: no whole stride: left out"


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_the_command_writes_a_cycle_and_its_source(cmu_mocap, tmp_path, capsys):
    out = tmp_path / "mine.npz"
    with pytest.raises(SystemExit) as stopped:
        main(["learn", "walking-angles", str(cmu_mocap / "05" / "05_01.amc"), str(cmu_mocap / "02" / "02_03.amc"), "--out", str(out)])
    assert stopped.value.code == 0
    said = capsys.readouterr().out.replace("\n", "")
    assert "02_03: 2.6 m/s is a run: left out" in said and "2 strides of 1 people in 1 walks" in said
    told = out.with_suffix(".toml").read_text()
    assert 'motions = ["05_01"]' in told and "bayes-body learn walking-angles $BAYES_BODY_DATA/cmu_mocap/05/05_01.amc" in told
    assert load_angle_cycle(out).body == BODY


def test_the_command_refuses_before_it_works(tmp_path, capsys):
    (tmp_path / "there.npz").write_bytes(b"")
    for out, said in (("there.npz", "already exists"), ("mine.zip", "a file that ends in .npz")):
        with pytest.raises(SystemExit) as stopped:
            main(["learn", "walking-angles", str(tmp_path), "--out", str(tmp_path / out)])
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err.replace("\n", " ")
