"""All detectors on a session, simulated views first, real recordings where they are."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from initial.detection.people import JOINTS, mask, ring

from bayes_body.base.errors import InputError
from bayes_body.initial.detection.detect import DETECTORS, detect
from bayes_body.initial.detection.detections import LANDMARKS, PARTS, landmark, merge, strongest
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.parsec import import_parsec
from bayes_body.recording.session.session import Session, View


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("spheres")
    cameras, noise = ring(4), np.random.default_rng(1)
    for each in cameras:
        image, silhouette = (folder / f"{each.name}_{kind}0.png" for kind in ("image", "mask"))
        cv2.imwrite(str(image), noise.integers(60, 200, (480, 640, 3), dtype=np.uint8))
        cv2.imwrite(str(silhouette), 255 * mask(each).astype(np.uint8))
    views = tuple(View(each, images=f"{each.name}_image%d.png", masks=f"{each.name}_mask%d.png") for each in cameras)
    return Session(folder, "a person of spheres", "z", 60.0, 2, 0, views)


def test_a_frame_has_landmarks_parts_a_person_notices_and_times(session):
    found = detect(session, read_frame(session, 0))
    assert set(found.landmarks) == set(LANDMARKS) and set(found.parts) <= set(PARTS)
    assert np.linalg.norm(found.landmarks["head"].positions - JOINTS["head"], axis=1).min() < 0.06
    assert np.linalg.norm(found.person.floor_m) < 0.06
    assert "no face was found in any view" in found.notices
    assert set(found.seconds) == {"scene", *DETECTORS} and min(found.seconds.values()) >= 0


def test_the_same_frame_gives_the_same_detections(session):
    first, second = (detect(session, 0) for _ in range(2))
    for name, each in first.landmarks.items():
        assert np.array_equal(each.positions, second.landmarks[name].positions) and np.array_equal(each.weights, second.landmarks[name].weights)


def test_nothing_seen_is_no_error(session):
    # The second frame has no images.
    found = detect(session, 1)
    assert not found.landmarks and not found.parts and found.person is None
    assert found.notices == ("no camera saw this frame",)


def test_a_session_without_silhouettes_says_so(session):
    bare = Session(session.folder, "", "z", 60.0, 1, 0, tuple(View(each.camera, images=each.images) for each in session.views))
    found = detect(bare, 0, ("limbs", "keypoints"))
    assert not found.landmarks and any("no silhouettes" in notice for notice in found.notices)


def test_an_unknown_detector_is_refused(session):
    with pytest.raises(InputError, match=r"detector 'face': no such detector; expected some of .*did you mean 'faces'"):
        detect(session, 0, ("face",))


def test_merged_detections_share_the_weight():
    a, b = (landmark(np.full((n, 3), float(n)), 0.1, np.arange(1.0, n + 1), name) for n, name in ((2, "a"), (3, "b")))
    both = merge([(a, 3.0), (b, 1.0)])
    assert both.weights[:2].sum() == pytest.approx(0.75) and both.source == ("a", "a", "b", "b", "b")
    assert strongest(both, 1).weights == pytest.approx([1.0]) and strongest(both, 1).source == ("a",)
    assert merge([]) is None


def test_the_man_who_hangs_upside_down_is_found_with_his_face(tmp_path):
    data = os.environ.get("BAYES_BODY_DATA")
    if not data or not (Path(data) / "bodytrack_4cam").is_dir():
        pytest.skip("BAYES_BODY_DATA names no folder with bodytrack_4cam")
    session, _ = import_parsec(Path(data) / "bodytrack_4cam", tmp_path / "session", Options())
    found = detect(session, 0)
    # The first pose that comes with the recording: its root, and a yaw of 0.96 rad.
    root = np.array([session.initial[name] for name in ("root_x", "root_y", "root_z")])
    assert np.linalg.norm(found.landmarks["pelvis"].positions - root, axis=1).min() < 0.1
    assert found.person.facing_known and found.person.facing @ [np.cos(0.96), np.sin(0.96), 0] > 0.5
