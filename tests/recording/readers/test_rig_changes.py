"""Changes of a calibration that an import makes because its file says so, or names because the pictures have another size."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_rigs import crowd, rig, walk, write_recording, write_toml

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.agreement.changes import CHANGES, scaled, turned
from bayes_body.recording.readers.check import check_session
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.readers.opencv import import_opencv
from bayes_body.recording.readers.options import Options

POINTS = np.random.default_rng(0).uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 2.0], (200, 3))
SMALL = (60, 100)


def small_rig(size=SMALL):
    """Four cameras with small pictures."""
    return [scaled(camera, size) for camera in rig(4, (size[0] * 10, size[1] * 10), seed=7)]


def import_toml(source, tmp_path, **options):
    session, remarks = import_opencv(source, tmp_path / "s", Options("m", "z", fps=30.0, keypoints=source / "pose", **options))
    return [view.camera for view in session.views], remarks


def same(cameras, expected):
    for camera, wanted in zip(cameras, expected, strict=True):
        assert camera.size_px == wanted.size_px
        np.testing.assert_allclose(project(camera, POINTS), project(wanted, POINTS), atol=1e-3)


@pytest.mark.parametrize(("turns", "size"), [(1, SMALL), (3, (80, 80)), (2, SMALL), (-1, SMALL)])
def test_a_calibration_turns_with_pictures_if_its_file_says_so(tmp_path, turns, size):
    cameras = small_rig(size)
    shown = [turned(camera, turns) for camera in cameras]
    source = write_recording(tmp_path / "lab", shown, crowd(shown, noise_px=0.2, places=walk(12)))
    write_toml(source / "array.toml", cameras, f"rotation_count = {turns}", nested=True)
    read, remarks = import_toml(source, tmp_path)
    same(read, shown)
    angle = {1: "90° clockwise", 2: "180°", 3: "90° counterclockwise"}[turns % 4]
    assert (
        f"rotation_count: the calibration of c0, c1, c2, c3 was turned by {angle} with the pictures; if they were not turned, give --rig as_given."
        in remarks
    )


def test_pictures_that_were_not_turned_keep_their_calibration(tmp_path):
    cameras = small_rig()
    source = write_recording(tmp_path / "lab", cameras, crowd(cameras, noise_px=0.2, places=walk(12)))
    write_toml(source / "array.toml", cameras, "rotation_count = 1", nested=True)
    read, remarks = import_toml(source, tmp_path)
    same(read, cameras)
    assert not any("rotation_count" in remark for remark in remarks)
    # A turn by 180° does not show in their size: the file is believed, the keypoints contradict it, and the user decides.
    write_toml(source / "array.toml", cameras, "rotation_count = 2", nested=True)
    read, _ = import_toml(source, tmp_path, rig={"": "as_given"})
    same(read, cameras)


@pytest.mark.parametrize("quarters", [1, 3])
@pytest.mark.parametrize("chosen", [(2,), (0, 1, 2, 3)])
def test_the_turn_of_pictures_with_exchanged_sides_is_named_by_the_keypoints(tmp_path, quarters, chosen):
    cameras = small_rig()
    shown = [turned(camera, quarters) if c in chosen else camera for c, camera in enumerate(cameras)]
    source = write_recording(tmp_path / "lab", shown, crowd(shown, noise_px=0.2, places=walk(12)))
    write_toml(source / "Calib.toml", cameras)
    change = f"turned_{90 * quarters}"
    written = f"c2={change}" if len(chosen) == 1 else change
    with pytest.raises(InputError, match=rf"100 x 60 pixels; expected 60 x 100, .* the rays of the keypoints meet .* with --rig {written}\.$"):
        import_toml(source, tmp_path)
    read, remarks = import_toml(source, tmp_path, rig={"c2" if len(chosen) == 1 else "": change})
    same(read, shown)
    assert f"--rig {written}: the calibration was changed, since {CHANGES[change].meaning}." in remarks
    for path in source.glob("pose/*/*"):
        path.unlink()
    for path in source.glob("pose/*"):
        path.rmdir()
    # Nothing tells in which direction.
    with pytest.raises(InputError, match=r"turned_90 \(90° clockwise\) or --rig .*turned_270 \(90° counterclockwise\)\.$"):
        import_opencv(source, tmp_path / "t", Options("m", "z", fps=30.0))


@pytest.mark.parametrize(("factor", "words"), [(2, "half the"), (1.25, "0.8 times the")])
def test_a_calibration_of_larger_pictures_is_scaled_on_request(tmp_path, factor, words):
    shown = small_rig()
    cameras = [scaled(camera, (int(SMALL[0] * factor), int(SMALL[1] * factor))) for camera in shown]
    source = write_recording(tmp_path / "lab", shown, crowd(shown, noise_px=0.2, places=walk(12)))
    write_toml(source / "Calib.toml", cameras)
    with pytest.raises(InputError, match=rf"the pictures have exactly {words} size: .* scale the calibration by --rig scaled"):
        import_toml(source, tmp_path)
    read, remarks = import_toml(source, tmp_path, rig={"": "scaled"})
    same(read, shown)
    assert "--rig scaled: the calibration was scaled to the size of the pictures." in remarks
    write_toml(source / "Calib.toml", [replace(camera, size_px=(60, 80)) for camera in shown])
    with pytest.raises(InputError, match=r"--rig c1=scaled: pictures of 60 x 100; expected the shape of 60 x 80"):
        import_toml(source, tmp_path, rig={"c1": "scaled"})


def test_a_session_whose_cameras_were_changed_is_noticed_before_a_run(tmp_path):
    cameras = small_rig()
    source = write_recording(tmp_path / "lab", cameras, crowd(cameras, noise_px=0.2, places=walk(12)))
    write_toml(source / "Calib.toml", cameras)
    session, _ = import_opencv(source, tmp_path / "s", Options("m", "z", fps=30.0, keypoints=source / "pose"))
    assert check_session(session) == []
    edited = replace(session, views=tuple(replace(view, camera=CHANGES["opengl"].apply(view.camera)) for view in session.views))
    (sentence,) = check_session(edited)
    assert sentence.startswith(
        "session.toml: the keypoints contradict it: no two of 4 cameras agree on where a person is; the rays of the keypoints meet if"
    )


# What an import says of any good recording without masks.
USUAL = ("There are no masks", "Lengths of the limbs", "Distances between the keypoints")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1030))
def test_good_recordings_get_no_sentence(tmp_path, seed):
    """Rigs of 2 to 12 cameras, upright and lying pictures, some turned, networks that are off by up to 0.7 % of the diagonal."""
    rng = np.random.default_rng(seed)
    size = SMALL if seed % 2 else SMALL[::-1]
    cameras = [scaled(camera, size) for camera in rig(2 + seed % 11, (size[0] * 10, size[1] * 10), seed)]
    cameras = [turned(camera, 2) if rng.random() < 0.1 else camera for camera in cameras]
    people = crowd(cameras, noise_px=float(rng.uniform(0.1, 0.8)), seed=seed, places=walk(12, float(rng.uniform(1.2, 1.95))))
    source = write_recording(tmp_path / "lab", cameras, people)
    write_toml(source / "Calib.toml", cameras)
    session, remarks = import_opencv(source, tmp_path / "s", Options("m", "z", fps=30.0, keypoints=source / "pose"))
    assert [remark for remark in remarks if not remark.startswith(USUAL)] == []
    assert check_session(session) == []


def test_among_several_people_no_majority_need_see_the_same_one(tmp_path):
    cameras = small_rig()
    people = [crowd(cameras, noise_px=0.2, places=walk(6) + np.array(place)) for place in ([0.0, 0.0, 0.0], [0.9, 1.0, 0.0], [-0.8, 0.9, 0.0])]
    # Cameras c2 and c3 see one other person each.
    shown = [[first[0], first[1], second[2], third[3]] for first, second, third in zip(*people, strict=True)]
    single = write_recording(tmp_path / "single", cameras, shown)
    write_toml(single / "Calib.toml", cameras)
    with pytest.raises(
        InputError, match=r"2 of 4 cameras agree on where a person is; expected more than half of the cameras to agree; .*--rig as_given"
    ):
        import_toml(single, tmp_path)
    # In one picture somebody else is seen too: whom the others see is open.
    shown = [[*frame[:3], np.concatenate([frame[3], second[3]])] for frame, second in zip(shown, people[1], strict=True)]
    several = write_recording(tmp_path / "several", cameras, shown)
    write_toml(several / "Calib.toml", cameras)
    _, remarks = import_toml(several, tmp_path)
    assert any("keypoints contradict the other" in remark for remark in remarks)
