"""The filmed arm: its angles, where it is put on the person, and what counts as known."""

import jax.numpy as jnp
import numpy as np
import pytest
from bending_arm import BEND_DEG, FRAMES, STRAIGHT, TwistInterval, arm_angles, film_arm, with_arm

from bayes_body.base.errors import InputError
from bayes_body.model.body.build import build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.definition import load_body
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk


def test_the_arm_is_straight_and_then_bends_smoothly_from_rest():
    angles = np.degrees(arm_angles(20.0))
    body = build_body("arm_4", load_body("arm_4"))
    low, high = (np.degrees(np.asarray(side)) for side in (body.skeleton.low, body.skeleton.high))
    assert ((low <= angles) & (angles <= high)).all() and (angles[:, 2] == 20).all()
    assert np.ptp(angles[: STRAIGHT + 1, 3]) == 0 and angles[-1, 3] - angles[0, 3] == pytest.approx(-BEND_DEG)
    # No speed at the start, and no jump of the speed.
    assert np.abs(angles[1] - angles[0]).max() < 0.2 and np.abs(np.diff(angles, 2, axis=0)).max() < 0.6


def test_a_twist_beyond_the_limits_is_a_sentence(tmp_path):
    with pytest.raises(InputError, match="the twist: 200 degrees; expected -90 to 90; give one"):
        film_arm(tmp_path / "film", twist_deg=200.0)


def test_the_person_has_the_arm_and_faces_where_it_bends():
    still = {name: np.repeat(each[:1], FRAMES, axis=0) for name, each in walk(load_cycle(), 1.0, 30.0).items()}
    body = build_body("arm_4", load_body("arm_4"))
    places = np.stack(
        [np.asarray(marker_positions(body.skeleton, body.markers, jnp.asarray(pose, jnp.float32))) for pose in arm_angles(20.0)[[0, -1]]]
    )
    arm = {name: np.repeat(places[:1, k], FRAMES, axis=0) for k, name in enumerate(body.markers.names)}
    person = with_arm(still, arm)
    for name in ("l_shoulder", "l_elbow", "l_wrist"):
        np.testing.assert_allclose(person[name], arm[name], atol=1e-9)
    # Distances between the other points are kept, and the left arm is on the left of a person who faces where the forearm goes.
    assert np.linalg.norm(person["head"][0] - person["r_ankle"][0]) == pytest.approx(np.linalg.norm(still["head"][0] - still["r_ankle"][0]))
    bent = (places[1, 2] - places[0, 2])[:2]
    left = (person["l_hip"] - person["r_hip"])[0, :2]
    assert bent[0] * left[1] - bent[1] * left[0] > 0


@pytest.mark.parametrize(
    ("low", "high", "passes"),
    [((-80, 0), (80, 40), True), ((-50, 0), (50, 40), False), ((-80, -20), (80, 50), False), ((-80, 25), (80, 60), False)],
)
def test_a_filter_passes_if_the_twist_is_unknown_before_and_known_after(low, high, passes):
    ends = [np.where(np.arange(FRAMES) < STRAIGHT, before, after).astype(float) for before, after in (low, high)]
    assert TwistInterval(*ends, true=20.0, ess=1.0).passes == passes
