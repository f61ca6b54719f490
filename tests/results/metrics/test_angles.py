"""Clinical angles against true poses: a knee that is bent too far by a known angle, and truths that cannot be used."""

import dataclasses

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.results.metrics import accuracy_figures
from bayes_body.results.metrics.accuracy import LEVELS
from bayes_body.results.metrics.angles import TrueAngles, angles_against_truth, true_angles
from bayes_body.results.metrics.truth import against_truth
from bayes_body.results.posterior import markers

FRAMES, RUNS, DRAWS, OFF_DEG, SD_DEG = 60, 2, 101, 5.0, 4.0


@pytest.fixture(scope="module")
def known(whole):
    """True poses, and draws whose left knee is beside the truth by 5 degrees and 4 at random, all of it if the weights are regarded."""
    rng, names = np.random.default_rng(0), whole.body.dof_names
    truth = np.tile(np.asarray(whole.initial["pose"], float), (FRAMES, 1))
    truth[:, names.index("l_knee")], truth[:, names.index("root_yaw")] = -0.6, np.pi - 0.01
    poses = np.tile(truth[:, None, None], (1, RUNS, DRAWS, 1))
    off = np.radians(OFF_DEG + SD_DEG * rng.normal(size=(FRAMES, RUNS, 1)) + SD_DEG * rng.normal(size=(FRAMES, RUNS, DRAWS)))
    poses[..., names.index("l_knee")] -= off
    # A last draw of no weight, far away; and a whole turn of the body, which is no error.
    poses[..., -1, names.index("l_knee")] = -2.0
    poses[..., names.index("root_yaw")] -= 2 * np.pi
    log_weights = np.zeros((FRAMES, RUNS, DRAWS))
    log_weights[..., -1] = -np.inf
    return truth, poses, log_weights, np.degrees(off[..., :-1].mean(axis=-1))


def test_the_error_of_a_knee_is_known(whole, clouds_of, known, all_markers):
    truth, poses, log_weights, off_deg = known
    found = angles_against_truth(whole, clouds_of(poses, log_weights), TrueAngles(truth, 2))
    place = found.names.index("knee_flexion_l")
    np.testing.assert_allclose(np.abs(found.error_deg[..., place]), np.abs(off_deg), atol=0.02)
    others = np.delete(found.error_deg, place, axis=-1)
    assert np.abs(others).max() < 0.02 and len(found.names) > 10
    # Of normal draws with the sd of the error's random part, the truth is inside 90 % where it is without the offset; five degrees are 1.25 sd.
    assert found.coverage[LEVELS.index(0.9), place] == pytest.approx(0.63, abs=4 * np.sqrt(0.63 * 0.37 / FRAMES / RUNS))
    names = whole.body.markers.names
    places = all_markers(names, markers(whole, truth.astype(np.float32)))
    figures = accuracy_figures(against_truth(whole, clouds_of(poses, log_weights), places, TrueAngles(truth, 2)), mode_seeker=False)
    rms = np.sqrt((off_deg**2).mean())
    assert next(iter(figures["angle_rms_deg_by_angle"])) == "knee_flexion_l"
    assert figures["angle_rms_deg_by_angle"]["knee_flexion_l"] == pytest.approx(rms, abs=0.02)
    assert figures["angle_rms_deg"] == pytest.approx(rms / np.sqrt(len(found.names)), abs=0.02)
    seeker = accuracy_figures(against_truth(whole, clouds_of(poses, log_weights), places, TrueAngles(truth, 2)), mode_seeker=True)
    assert seeker["angle_coverage_90"] is seeker["angle_coverage_90_by_angle"] is None and seeker["angle_rms_deg"] > 0


def test_true_angles_are_those_of_this_body(whole, textured_session, tmp_path):
    frames, names, path = textured_session.frames, np.array(whole.body.dof_names), tmp_path / "truth.npz"
    session = dataclasses.replace(textured_session, truth=str(path))
    angles = np.random.default_rng(0).normal(size=(frames + 2, len(names)))

    def written(**arrays):
        np.savez(path, **arrays)
        return true_angles(session, whole)

    whole_body = {"dof_names": names, "body": np.array(whole.body.name)}
    np.testing.assert_array_equal(written(angles=angles, **whole_body).poses, angles[:frames])
    assert written(angles=angles, dof_names=names[::-1], body=whole_body["body"]) is None
    assert written(angles=angles, dof_names=names, body=np.array("another")) is None
    assert written(markers=angles) is None and true_angles(dataclasses.replace(session, truth=None), whole) is None
    with pytest.raises(InputError, match=r"truth\.npz: angles: float64 of shape"):
        written(angles=angles[: frames - 1], **whole_body)
    with pytest.raises(InputError, match="not finite"):
        written(angles=np.full_like(angles, np.nan), **whole_body)
