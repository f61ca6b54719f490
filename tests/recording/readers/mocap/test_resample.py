"""Another rate: exact frames stay, cubics come back, turns are even, gaps stay gaps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.mocap import Motion, resample


def motion(positions, fps=120.0, rotations=None):
    joints = tuple(f"j{k}" for k in range(positions.shape[1]))
    return Motion("a", fps, joints, (-1,) * len(joints), positions, rotations)


def test_half_the_rate_takes_every_second_frame():
    rng = np.random.default_rng(0)
    positions, rotations = rng.normal(size=(21, 4, 3)), Rotation.random(84, rng=rng).as_matrix().reshape(21, 4, 3, 3)
    positions[6, 1], rotations[8, 2] = np.nan, np.nan
    halved = resample(motion(positions, rotations=rotations), 60.0)
    assert halved.fps == 60
    assert np.array_equal(halved.positions_m, positions[::2], equal_nan=True) and np.array_equal(halved.rotations, rotations[::2], equal_nan=True)
    same = resample(motion(positions, 59.94), 59.94)
    assert np.array_equal(same.positions_m, positions, equal_nan=True)


def test_a_curve_comes_back():
    """Of a parabola cubic interpolation is exact inside; of a sine it is of the order of a ten-thousandth; linear would be a hundredth."""
    t = np.arange(40) / 30
    positions = np.stack([t**2, 3 * t, np.sin(5 * t)], axis=-1)[:, None]
    fine = resample(motion(positions, 30.0), 100.0)
    s = np.arange(len(fine.positions_m)) / 100
    assert len(s) == 131 and s[-1] <= t[-1]
    inside = (s > t[1]) & (s < t[-2])
    assert np.allclose(fine.positions_m[inside, 0, :2], np.stack([s**2, 3 * s], axis=-1)[inside])
    assert np.abs(fine.positions_m[inside, 0, 2] - np.sin(5 * s)[inside]).max() < 1e-3
    assert np.abs(fine.positions_m[:, 0] - np.stack([s**2, 3 * s, np.sin(5 * s)], axis=-1)).max() < 4e-3


def test_turns_are_even():
    axis = np.array([0.6, 0.0, 0.8])
    angles = np.radians([0.0, 170.0, 350.0])
    rotations = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()[:, None]
    fine = resample(motion(np.zeros((3, 1, 3)), 1.0, rotations), 10.0).rotations[:, 0]
    # By 170 and then by 180 degrees less a hair, or the other way round: the first is the shorter way.
    assert np.allclose(fine[:11], Rotation.from_rotvec(np.radians(17.0 * np.arange(11))[:, None] * axis).as_matrix())
    assert np.allclose(fine @ np.swapaxes(fine, -1, -2), np.eye(3)) and np.allclose(np.linalg.det(fine), 1)


def test_what_is_unknown_stays_unknown():
    positions = np.linspace(0, 1, 12).repeat(6).reshape(12, 2, 3)
    positions[4:6, 0] = np.nan
    rotations = np.broadcast_to(np.eye(3), (12, 2, 3, 3)).copy()
    rotations[7, 1] = np.nan
    fine = resample(motion(positions, 10.0, rotations), 40.0)
    unknown = np.isnan(fine.positions_m).any(axis=-1)
    # Between frames 3 and 6, and nowhere else; frames 3 and 6 themselves are known.
    assert np.flatnonzero(unknown[:, 0]).tolist() == list(range(13, 24)) and not unknown[:, 1].any()
    assert (
        np.flatnonzero(np.isnan(fine.rotations[:, 1]).any(axis=(1, 2))).tolist() == list(range(25, 32)) and not np.isnan(fine.rotations[:, 0]).any()
    )
    known = fine.positions_m[~unknown[:, 0], 0, 0]
    assert np.allclose(known, (np.arange(45) / 44)[~unknown[:, 0]])


def test_one_frame_and_rates_that_are_none():
    one = motion(np.ones((1, 2, 3)), rotations=np.broadcast_to(np.eye(3), (1, 2, 3, 3)).copy())
    assert np.array_equal(resample(one, 60.0).positions_m, one.positions_m) and resample(one, 60.0).rotations.shape == (1, 2, 3, 3)
    for fps, sentence in ((0.0, "fps: 0; expected"), (float("nan"), "fps: nan"), (-5.0, "fps: -5")):
        with pytest.raises(InputError, match=sentence):
            resample(one, fps)
    with pytest.raises(InputError, match=r"\d+ frames; expected at most 10000000 frames"):
        resample(motion(np.zeros((200_000, 1, 3)), 1.0), 1000.0)
