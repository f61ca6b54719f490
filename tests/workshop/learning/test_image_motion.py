"""The noise of image motion from grey values with a known mixture, and smooth motion from curves with known derivatives."""

from pathlib import Path

import numpy as np
import pytest
from learn_image_motion import _mixture, motion_noise, motion_pairs
from learn_smooth_motion import FPS, Track, smooth_noise

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.model.definition import load_body, load_definition
from bayes_body.view.report.dependence import BINS, log_density


def test_noise_and_outliers_are_found_again():
    rng = np.random.default_rng(3)
    cosine = rng.uniform(0.2, 1.0, 40_000)
    difference = rng.normal(0, 3.0 / cosine)
    outlier = rng.random(len(cosine)) < 0.15
    difference[outlier] = rng.uniform(-128, 128, outlier.sum())
    sd, share = _mixture(difference, cosine)
    assert sd == pytest.approx(3.0, rel=0.03) and share == pytest.approx(0.15, abs=0.01)


def test_what_cannot_be_learned_is_said(textured_session):
    with pytest.raises(InputError, match="no point of the body in any pair of frames"):
        motion_noise([])
    with pytest.raises(InputError, match="its likelihoods are silhouette_edges; expected one of the kind image_motion"):
        next(motion_pairs(textured_session, load_definition("arm"), 1))
    with pytest.raises(InputError, match="no truth"):
        next(motion_pairs(textured_session, load_definition("sidenbladh_2000_arm"), 1))


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_the_program_learns_from_a_film(tmp_path, program_runner):
    """A film of the simulator has noise of one to two grey levels, and clothes that move: sums over points are too sharp."""
    film = ["simulate", "walk", "--rig", "side_1", "--frames", "12", "--out", str(tmp_path / "walk")]
    with pytest.raises(SystemExit) as stopped:
        main(film)
    assert stopped.value.code == 0
    program = Path(__file__).parents[3] / "inference" / "learn" / "learn_image_motion.py"
    done = program_runner(program, tmp_path / "walk", "--model", "sidenbladh_2000_walking", "--frames", 4)
    assert done.status == 0, done.err
    told = done.out.splitlines()[-3:]
    noise, share, precision = (float(line.split(" = ")[1]) for line in told)
    assert 0.5 < noise < 5 and 0.005 < share < 0.3 and 0.02 < precision < 2


def test_smooth_motion_of_a_sine_is_known():
    schema, times = load_body("arm_4"), np.arange(240) / FPS
    rate, size = 2 * np.pi * 1.5, 0.4
    waves = size * np.sin(rate * times[:, None] + np.linspace(0, 2, 4))
    found = smooth_noise([Track("a", waves), Track("b", np.zeros((50, 4)))], "arm_4", schema)
    # Half a second difference, and the first difference of a central one; two people, one of whom stands still.
    second = 2 * size * (1 - np.cos(rate / FPS)) / np.sqrt(2) / 2
    change = 2 * size * np.sin(rate / FPS) * FPS * np.sin(rate / FPS / 2) / np.sqrt(2)
    assert set(found.pose) == {"shoulder_x", "shoulder_y", "shoulder_z", "elbow"}
    for name in found.pose:
        assert found.pose[name] == pytest.approx(second / np.sqrt(2), rel=0.02)
        assert found.velocity[name] == pytest.approx(change / np.sqrt(2), rel=0.02)


def test_a_log_posterior_is_relative_to_its_frame_s_mode():
    angles = np.array([[0.0, 0.0, 30.0, 60.0], [10.0, 10.0, 10.0, 10.0]])
    weights = np.array([[0.25, 0.25, 0.3, 0.2], [0.1, 0.2, 0.3, 0.4]])
    found = log_density(angles, weights)
    assert found.values.shape == (BINS, 2) and (found.low, found.high) == (0.0, 60.0)
    assert found.values[0, 0] == 0 and found.values[-1, 0] == pytest.approx(np.log(0.4)) and found.values[BINS // 2, 0] == pytest.approx(np.log(0.6))
    assert np.isfinite(found.values[:, 1]).sum() == 1
