"""The judge of a rig: what makes the rays of keypoints meet is named, for the whole rig and for a camera, and a good rig gets no word."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_rigs import LANDSCAPE, NAMES, PORTRAIT, crowd, rig

from bayes_body.recording.readers.agreement.changes import CHANGES, FLIP, POSES, scaled, turned
from bayes_body.recording.readers.agreement.judge import judge
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS, read_openpose
from bayes_body.recording.readers.keypoints.triangulate import project


def as_written(convention, camera):
    """What a program of another convention writes of a camera."""
    match convention:
        case "inverted":
            return CHANGES["inverted"].apply(camera)
        case "centres":
            return replace(camera, translation_m=-camera.rotation.T @ camera.translation_m)
        case "opengl":
            return replace(camera, rotation=FLIP @ camera.rotation, translation_m=FLIP @ camera.translation_m)
        case "transposed":
            return replace(camera, rotation=camera.rotation.T)
        case "opengl_centres":
            return replace(camera, rotation=FLIP @ camera.rotation, translation_m=-camera.rotation.T @ camera.translation_m)
        case "inverted_opengl":
            return CHANGES["inverted"].apply(as_written("opengl", camera))
        case _:
            return replace(camera, centre_px=camera.centre_px[::-1])


@pytest.mark.parametrize("convention", [*POSES, "exchanged_centre"])
@pytest.mark.parametrize(("count", "size"), [(2, LANDSCAPE), (3, PORTRAIT), (4, LANDSCAPE), pytest.param(8, PORTRAIT, marks=pytest.mark.slow)])
def test_the_convention_of_a_rig_is_named(count, size, convention):
    cameras = rig(count, size)
    verdict = judge([as_written(convention, camera) for camera in cameras], crowd(cameras), NAMES)
    # Two cameras may agree roughly by chance.
    assert verdict.contradicts or count == 2
    assert verdict.remedies[0] == {"": convention}


@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_a_good_rig_gets_no_word(count):
    for size, seed in ((LANDSCAPE, 1), (PORTRAIT, 2)):
        cameras = rig(count, size, seed)
        verdict = judge(cameras, crowd(cameras, seed=seed), NAMES)
        assert not verdict.contradicts
        assert (verdict.remedies, verdict.causes) == ([], {})


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize(("count", "size"), [(3, (900, 900)), (4, LANDSCAPE), (8, PORTRAIT)])
def test_the_turned_pictures_of_a_camera_are_named(count, size, quarters):
    cameras = rig(count, size)
    shown = [turned(camera, quarters) if camera.name == "c1" else camera for camera in cameras]
    calibrated = [replace(camera, size_px=picture.size_px) for camera, picture in zip(cameras, shown, strict=True)]
    verdict = judge(calibrated, crowd(shown), NAMES)
    assert not verdict.contradicts
    assert {c: cause.change for c, cause in verdict.causes.items()} == {1: f"turned_{90 * quarters}"}


@pytest.mark.parametrize("quarters", [1, 3])
def test_turned_pictures_of_all_cameras_and_of_half_of_them_are_named(quarters):
    cameras = rig(4, (900, 900))
    for chosen, remedy in ((range(4), {"": f"turned_{90 * quarters}"}), ((0, 1), {"c0": f"turned_{90 * quarters}", "c1": f"turned_{90 * quarters}"})):
        shown = [turned(camera, quarters) if c in chosen else camera for c, camera in enumerate(cameras)]
        verdict = judge(cameras, crowd(shown), NAMES)
        assert (verdict.contradicts, verdict.remedies) == (True, [remedy])


def test_keypoints_of_other_pictures_are_named():
    cameras = rig(4)
    people = crowd(cameras)
    sides = [NAMES.index({"l": "r", "r": "l"}[name[0]] + name[1:]) if name[1] == "_" else k for k, name in enumerate(NAMES)]
    for words, change in {
        "its keypoints belong to pictures of half the size": lambda group: group * [0.5, 0.5, 1.0],
        "its keypoints belong to pictures of twice the size": lambda group: group * [2.0, 2.0, 1.0],
        "left and right of its keypoints are exchanged": lambda group: group[:, sides],
    }.items():
        verdict = judge(cameras, [[*frame[:3], change(frame[3])] for frame in people], NAMES)
        assert {c: cause.words for c, cause in verdict.causes.items()} == {3: words}
    small = [scaled(camera, (640, 360)) for camera in cameras]
    # The file does not state the size of its pictures: the session takes that of the recording.
    unstated = [replace(camera, size_px=(640, 360)) for camera in cameras]
    assert judge(unstated, crowd(small), NAMES).remedies == [{"": "half_size"}]


def test_strangers_in_one_camera_are_no_fault_of_the_rig():
    cameras = rig(4)
    people = crowd(cameras)
    verdict = judge(cameras, [[*frame[:3], frame[3] + [200.0, 0.0, 0.0]] for frame in people], NAMES)
    assert (verdict.contradicts, verdict.agreement.dissenting, verdict.causes, verdict.remedies) == (False, [3], {}, [])
    nobody = [[frame[0], *[np.zeros((0, len(NAMES), 3))] * 3] for frame in people]
    assert judge(cameras, nobody, NAMES) is None


@pytest.mark.parametrize("skew", [0.0, 0.02])
def test_a_camera_turns_and_grows_with_its_pictures(skew):
    camera = replace(rig(1)[0], skew=skew, distortion=(-0.1, 0.05, 0.004, -0.003, 0.01))
    points = np.random.default_rng(3).uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 2.0], (40, 3))
    width, height = camera.size_px
    pixels = project(camera, points)
    places = {
        1: [height - 1 - pixels[:, 1], pixels[:, 0]],
        2: [width - 1 - pixels[:, 0], height - 1 - pixels[:, 1]],
        3: [pixels[:, 1], width - 1 - pixels[:, 0]],
    }
    for quarters, place in places.items():
        np.testing.assert_allclose(project(turned(camera, quarters), points), np.stack(place, axis=-1), atol=1e-6)
    assert turned(camera, 1).size_px == (height, width)
    # The middle of a picture stays its middle.
    np.testing.assert_allclose(project(scaled(camera, (width // 2, height // 2)), points), (pixels + 0.5) / 2 - 0.5, atol=1e-6)


def test_the_cameras_around_a_man_on_a_beam_agree(pose2sim_beam):
    """They are not quite synchronised, and two see another person too."""
    cameras = [record.spec(record.size_px) for record in read_qualisys(pose2sim_beam / "calibration" / "Calib.qca.txt")]
    people = zip(*(read_openpose(pose2sim_beam / "pose" / f"{camera.name}_json", range(100)) for camera in cameras), strict=True)
    people, names = list(people), LAYOUTS["BODY_25B"]
    for chosen in ((0, 1, 2, 3), (0, 2), (1, 3), (0, 2, 3)):
        verdict = judge([cameras[c] for c in chosen], [[frame[c] for c in chosen] for frame in people], names)
        assert (verdict.agreement.has_majority, verdict.agreement.dissenting, verdict.remedies, verdict.causes) == (True, [], [], {})
    for change in ("opengl", "transposed"):
        assert judge([CHANGES[change].apply(camera) for camera in cameras], people, names).remedies == [{"": change}]
