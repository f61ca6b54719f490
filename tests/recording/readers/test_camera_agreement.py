"""Cameras that do not fit the others are named, and no others; limbs are measured on triangulated keypoints."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bayes_body.cli.import_ import _compare_cameras
from bayes_body.recording.readers.agreement.camera_sentences import describe_errors, warn_of_cameras
from bayes_body.recording.readers.agreement.cameras import compare_cameras
from bayes_body.recording.readers.keypoints.measured_lengths import measure_body, with_measured_lengths
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.pose2sim import import_pose2sim
from bayes_body.recording.session.session import CameraSpec, Session, Subject, View

FRAMES, FPS, SD_PX = 120, 30.0, 3.0
LIMBS = {"thigh": 0.41, "calf": 0.39, "upper_arm": 0.28, "forearm": 0.25}
NAMES = tuple(f"{side}_{joint}" for side in "lr" for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"))


def camera(i):
    """One of four cameras in the corners of a square, 4 m from its middle."""
    centre = np.array([4 * np.cos(0.8 + np.pi / 2 * i), 4 * np.sin(0.8 + np.pi / 2 * i), 1.5 + 0.3 * i])
    forward = np.array([0, 0, 0.9]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return CameraSpec(f"c{i}", (1280, 960), (900.0, 900.0), (640.0, 480.0), 0.0, (-0.1, 0.02, 0.0, 0.0, 0.0), R, -R @ centre)


CAMERAS = [camera(i) for i in range(4)]


def turned(spec, right, up=0.0):
    """A camera whose calibration is off by these angles, degrees."""
    R = cv2.Rodrigues(np.radians([up, right, 0.0]))[0]
    return replace(spec, rotation=R @ spec.rotation, translation_m=R @ spec.translation_m)


def walker(times_s):
    """Joints (frame, joint, 3) of someone who walks and swings the limbs, left and right in turn; metres."""

    def below(start, length, angle):
        return start + length * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)

    joints = []
    for sign in (1, -1):
        swing, bend = 0.6 * sign * np.sin(2 * np.pi * times_s), 0.5 + 0.5 * np.sin(2 * np.pi * times_s + sign)
        for y, z, upper, lower, turn in ((0.1, 0.9, "thigh", "calf", 1), (0.18, 1.4, "upper_arm", "forearm", -1)):
            start = np.stack([0.4 * times_s - 0.8, np.full_like(times_s, y * sign), np.full_like(times_s, z)], axis=1)
            middle = below(start, LIMBS[upper], turn * swing)
            joints += [start, middle, below(middle, LIMBS[lower], turn * (swing - bend))]
    return np.stack(joints, axis=1)


def detected(ahead=(0, 0, 0, 0), moves=True):
    """Keypoints (camera, frame, joint, 3) with errors of 3 px, of which 2 % are far off; frame k of a camera shows the time of frame k + `ahead`."""
    rng, keypoints = np.random.default_rng(0), []
    for spec, frames in zip(CAMERAS, ahead, strict=True):
        points = walker((np.arange(FRAMES) + frames) / FPS if moves else np.ones(FRAMES))
        K = np.array([[spec.focal_px[0], 0, spec.centre_px[0]], [0, spec.focal_px[1], spec.centre_px[1]], [0, 0, 1]])
        pixels = cv2.projectPoints(points.reshape(-1, 3), cv2.Rodrigues(spec.rotation)[0], spec.translation_m, K, np.array(spec.distortion))[0]
        pixels = pixels.reshape(FRAMES, -1, 2) + rng.normal(0, SD_PX, (FRAMES, len(NAMES), 2))
        pixels += 300 * (rng.random(pixels.shape[:2]) < 0.02)[..., None]
        keypoints.append(np.dstack([pixels, np.full(pixels.shape[:2], 0.9)]))
    return np.stack(keypoints)


def recorded(folder, keypoints, cameras=CAMERAS):
    """A session of these keypoints, without pictures."""
    for spec, series in zip(cameras, keypoints, strict=True):
        write_series(folder / f"{spec.name}.npz", KeypointSeries(series, NAMES, 0))
    views = tuple(View(spec, video=f"{spec.name}.mp4", keypoints=f"{spec.name}.npz") for spec in cameras)
    return Session(folder, "a walk", "z", FPS, FRAMES, 0, views)


def clocks_of(agreement):
    return [camera.clock for camera in agreement if camera.clock is not None]


@pytest.mark.parametrize("ahead", [(0, 0, 2, 0), (0, -3, 0, 2), (0, 0, 0, 0)])
def test_a_camera_that_is_ahead_or_late_is_named_and_no_other(ahead):
    agreement = compare_cameras(CAMERAS, detected(ahead))
    # Two cameras that are off spoil each other's points: the import with the offsets tells what remains.
    tolerance = 1 if ahead[1] else 0
    clocks = clocks_of(agreement)
    assert all(abs(clock.frames + frames) <= tolerance for clock, frames in zip(clocks, ahead, strict=True))
    assert [clock.frames != 0 for clock in clocks] == [frames != 0 for frames in ahead]
    assert all(abs(clock.interpolated + frames) < tolerance + 0.4 for clock, frames in zip(clocks, ahead, strict=True))
    sentences = warn_of_cameras(agreement, {"c1": 5})
    assert len(sentences) == sum(frames != 0 for frames in ahead)
    if ahead[2]:
        # In the words of the option: an offset of the camera, with the sign by which it is imported.
        assert "frame k - 2 of camera 'c2' fits frame k of the other cameras best" in sentences[0]
        assert "--offset c2=-2 --overwrite" in sentences[0]
    if ahead[1]:
        # It was imported with an offset of 5.
        assert f"--offset c1={5 + clocks[1].frames} --overwrite" in sentences[0]


def test_of_two_cameras_the_second_is_compared_with_the_first():
    # Opposite each other, so that neither sees the same motion along the other's rays.
    agreement = compare_cameras(CAMERAS[1::2], detected((0, 0, 0, 3))[1::2])
    assert [clock.frames for clock in clocks_of(agreement)] == [0, -3]
    assert "frame k - 3 of camera 'c3' fits frame k of camera 'c1' best" in warn_of_cameras(agreement, {})[0]


def test_nothing_is_claimed_of_someone_who_stands():
    assert warn_of_cameras(compare_cameras(CAMERAS, detected((0, 0, 2, 0), moves=False)), {}) == []


def test_a_wrong_calibration_is_named_and_is_no_wrong_clock():
    agreement = compare_cameras([CAMERAS[0], turned(CAMERAS[1], 2.0), *CAMERAS[2:]], detected())
    assert [clock.frames for clock in clocks_of(agreement)] == [0, 0, 0, 0]
    (sentence,) = warn_of_cameras(agreement, {})
    assert "camera 'c1' fits worse than the others: its keypoints are" in sentence
    assert "c1" in describe_errors(agreement) and "%" in describe_errors(agreement)
    # The same ratios of errors that are as small as a network's say nothing.
    small = 0.003 * agreement[1].diagonal_px / agreement[1].left_out_px
    precise = [camera._replace(left_out_px=small * camera.left_out_px, error_px=small * camera.error_px) for camera in agreement]
    assert warn_of_cameras(precise, {}) == []


def test_if_no_camera_is_to_blame_all_are():
    (sentence,) = warn_of_cameras(compare_cameras([CAMERAS[0], turned(CAMERAS[1], 0.0, 3.0)], detected()[:2]), {})
    assert "the cameras do not fit each other" in sentence


def test_the_import_prints_a_line_and_warnings(tmp_path, capsys):
    _compare_cameras(recorded(tmp_path, detected((0, 0, 2, 0))), {})
    printed = capsys.readouterr().out
    assert "note: Median reprojection error of the triangulated keypoints" in printed
    assert "warning     frame k - 2 of camera 'c2'" in printed
    one_camera = recorded(tmp_path, detected()[:1], CAMERAS[:1])
    _compare_cameras(one_camera, {})
    assert capsys.readouterr().out == ""


def test_limbs_are_measured_in_all_frames(tmp_path):
    session = recorded(tmp_path, detected())
    limbs, widths = measure_body(session)
    assert {name: measure.length_m for name, measure in limbs.items()} == pytest.approx(LIMBS, abs=0.004)
    assert all(0.004 < measure.sd_m < 0.03 for measure in limbs.values())
    assert widths["shoulders"].length_m == pytest.approx(0.36, abs=0.004)
    measured, remarks = with_measured_lengths(session)
    assert measured.subject.lengths_m == {f"{side}_{name}": round(limbs[name].length_m, 3) for side in "lr" for name in LIMBS}
    assert measured.subject.body == "deutscher_31"
    assert f"thigh {limbs['thigh'].length_m:.3f} (0.0" in remarks[0] and "--no-lengths" in remarks[0]
    # Lengths that are known are not replaced.
    known = replace(session, subject=Subject(body="deutscher_31", lengths_m={"l_thigh": 0.5}))
    assert with_measured_lengths(known) == (known, [])


@pytest.mark.slow
def test_the_real_cameras_are_synchronised_and_the_third_fits_worst(pose2sim_beam, tmp_path, capsys):
    session, remarks = import_pose2sim(pose2sim_beam, tmp_path / "beam", Options(offsets={"cam02": 3}))
    _compare_cameras(session, {"cam02": 3})
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert len(warnings) == 2
    assert "frame k - 3 of camera 'cam02'" in warnings[0] and "--offset cam02=0" in warnings[0]
    assert "camera 'cam03' fits worse than the others" in warnings[1]
    assert any("Lengths of the limbs are measured" in remark for remark in remarks)
    assert 0.37 < session.subject.lengths_m["l_thigh"] < 0.43
    session, remarks = import_pose2sim(pose2sim_beam, tmp_path / "beam", Options(measures_lengths=False))
    assert not session.subject.lengths_m
    _compare_cameras(session, {})
    assert "frame k" not in capsys.readouterr().out
