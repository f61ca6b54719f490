"""PARSEC's bodytrack: what is read is what the files say, and what is wrong with them is said in a sentence."""

import re
import shutil

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.recording.readers.check import check_session
from bayes_body.recording.readers.parsec import import_parsec
from bayes_body.recording.readers.parsec_subject import DOFS, PARTS
from bayes_body.recording.session.read import load_session, save_session


@pytest.fixture
def imported(bodytrack, tmp_path):
    """The recording's session, and the importer's remarks."""
    return import_parsec(bodytrack, tmp_path / "session")


def refused(copy) -> tuple[str, ...]:
    """The sentences with which an import fails; nothing may have been written."""
    target = copy.folder.parent / "session"
    with pytest.raises(FaultyFileError) as error:
        import_parsec(copy.folder, target)
    assert not target.exists()
    return error.value.sentences


def replaced(position: int, text: str):
    return lambda numbers: [*numbers[:position], text, *numbers[position + 1 :]]


def test_reads_metres_and_names(imported, bodytrack):
    session, _ = imported
    assert (session.up, session.fps, session.frames, session.first_frame) == ("z", 60.0, 4, 0)
    assert [view.camera.name for view in session.views] == ["CAM1", "CAM2", "CAM3", "CAM4"]
    assert session.views[0].camera.size_px == (640, 480)
    np.testing.assert_allclose(session.views[0].camera.translation_m, [0.20611832, -0.19732268, 4.52453648], atol=1e-8)
    assert session.subject.lengths_m["r_pelvis"] == pytest.approx(0.112973551984717, abs=1e-9)
    assert session.subject.lengths_m["head"] == pytest.approx(0.268030179506415, abs=1e-9)
    assert session.subject.radii_m["l_forearm"] == (0.04, 0.03)
    assert session.subject.sections["torso"] == (0.883801457794, 1.0)
    assert session.initial["root_y"] == pytest.approx(0.940095)
    assert session.initial["head_z"] == pytest.approx(0.383283)
    assert session.subject.motion_sd["root_z"] == pytest.approx(0.002379470, abs=1e-9)
    assert session.subject.motion_sd["l_knee"] == pytest.approx(0.092811089, abs=1e-9)
    assert session.image_path(session.views[2], 3) == bodytrack.resolve() / "CAM3" / "image0003.bmp"
    check_session(session)


def test_projects_as_the_files_camera_does(imported, bodytrack):
    # Against OpenCV on the file's own numbers: millimetres and the Rodrigues vector, which the session does not keep.
    point_m = np.array([[0.1, 0.9, 1.2]])
    for number, view in enumerate(imported[0].views, 1):
        c = np.array((bodytrack / "CALIB" / f"Camera{number}.cal").read_text().split(), float)
        K = np.array([[c[0], 0, c[2]], [0, c[1], c[3]], [0, 0, 1]])
        expected, _ = cv2.projectPoints(1000 * point_m, c[22:25], c[19:22], K, c[5:10])
        spec = view.camera
        K = np.array([[spec.focal_px[0], 0, spec.centre_px[0]], [0, spec.focal_px[1], spec.centre_px[1]], [0, 0, 1]])
        found, _ = cv2.projectPoints(point_m, cv2.Rodrigues(spec.rotation)[0], spec.translation_m, K, np.array(spec.distortion))
        np.testing.assert_allclose(found, expected, atol=1e-3)


def test_names_are_those_of_the_body(imported, deutscher):
    from bayes_body.base.toml.read import read_toml
    from bayes_body.model.body.schema import BodySchema

    body = BodySchema.model_validate(read_toml(deutscher))
    assert {dof.name for joint in body.joints for dof in joint.dofs} == set(DOFS) == set(imported[0].initial)
    assert {part.name for part in body.parts} == set(PARTS)
    assert set(body.lengths_of_height) == set(imported[0].subject.lengths_m)


def test_remarks_name_what_was_changed(imported):
    remarks = "\n".join(imported[1])
    assert "l_elbow 48.9 deg becomes -48.9" in remarks
    assert "r_knee 4.5 deg becomes -4.5" in remarks
    assert re.search(r"PoseParameters.txt: its limits exclude the initial pose in \d+ of 31 angles; .* deutscher_31 apply", remarks)
    assert "60 frames per second are assumed" in remarks


def test_save_and_load_is_the_same_session(imported):
    session, _ = imported
    assert load_session(save_session(session)) == session


def test_calibration_with_24_numbers(copy):
    copy.edit("CALIB/Camera2.cal", lambda numbers: numbers[:-1])
    (sentence,) = refused(copy)
    assert "Camera2.cal: 24 numbers; expected 25: focal length (2)" in sentence
    assert "restore the file" in sentence


@pytest.mark.parametrize("value", ["0.0", "-584.2"])
def test_focal_length_not_positive(copy, value):
    copy.edit("CALIB/Camera3.cal", replaced(0, value))
    (sentence,) = refused(copy)
    assert f"Camera3.cal: focal length x = {float(value):g}; expected a positive number of pixels; copy it" in sentence


def test_reflection_instead_of_rotation(copy):
    copy.edit("CALIB/Camera1.cal", lambda numbers: [*numbers[:10], *(str(-float(n)) for n in numbers[10:19]), *numbers[19:]])
    (sentence,) = refused(copy)
    assert "Camera1.cal: numbers 11 to 19: a reflection, det R = -1; expected a rotation" in sentence
    assert "flip the sign" in sentence


def test_matrix_that_is_no_rotation(copy):
    copy.edit("CALIB/Camera1.cal", replaced(10, "0.9"))
    (sentence,) = refused(copy)
    assert "Camera1.cal: numbers 11 to 19: not a rotation" in sentence


def test_rodrigues_vector_of_another_rotation(copy):
    copy.edit("CALIB/Camera4.cal", replaced(22, "0.5"))
    (sentence,) = refused(copy)
    assert "Camera4.cal: the Rodrigues vector (numbers 23 to 25) contradicts the matrix" in sentence


@pytest.mark.parametrize("value", ["nan", "inf", "0,5", "fc_x"])
def test_not_a_finite_number(copy, value):
    copy.edit("CALIB/Camera2.cal", replaced(4, value))
    (sentence,) = refused(copy)
    assert f"Camera2.cal: line 5: '{value}'; expected a finite number; correct it" in sentence


def test_missing_image(copy):
    (copy.own("CAM3") / "image0002.bmp").unlink()
    (sentence,) = refused(copy)
    assert "CAM3: 1 of 4 images are missing, the first is image0002.bmp; expected image0000.bmp to image0003.bmp" in sentence


def test_missing_first_image_is_said_once(copy):
    (copy.own("CAM3") / "image0000.bmp").unlink()
    sentences = refused(copy)
    assert sum("image0000.bmp" in sentence and "missing" in sentence for sentence in sentences) == len(sentences) == 1


def test_truncated_first_image(copy):
    folder = copy.own("CAM2")
    whole = (folder / "image0000.bmp").read_bytes()
    (folder / "image0000.bmp").unlink()
    (folder / "image0000.bmp").write_bytes(whole[:-1000])
    (sentence,) = refused(copy)
    assert f"CAM2/image0000.bmp: cut short, 1000 of {len(whole)} bytes are missing; expected a whole image; copy the file again" in sentence


def test_masks_of_another_size(copy):
    folder = copy.own("FG4")
    (folder / "image0000.bmp").unlink()
    cv2.imwrite(str(folder / "image0000.bmp"), np.zeros((240, 320), np.uint8))
    (sentence,) = refused(copy)
    assert "FG4/image0000.bmp: 320 x 240 pixels; expected 640 x 480 as its camera has" in sentence


def test_missing_masks_of_one_camera(copy):
    (copy.folder / "FG3").unlink()
    (sentence,) = refused(copy)
    assert "FG3: missing; expected the same files for camera 3 as for the other cameras; restore it" in sentence


def test_no_masks_at_all_is_a_remark(copy, tmp_path):
    for number in range(1, 5):
        (copy.folder / f"FG{number}").unlink()
    session, remarks = import_parsec(copy.folder, tmp_path / "session")
    assert all(view.masks is None for view in session.views)
    assert any("no silhouettes" in remark for remark in remarks)


def test_camera_without_calibration(copy):
    (copy.folder / "CALIB" / "Camera2.cal").unlink()
    (sentence,) = refused(copy)
    assert "Camera2.cal: missing; expected the same files for camera 2" in sentence


@pytest.mark.parametrize(("name", "count"), [("BodyShapeParameters.txt", 58), ("InitialPose.txt", 31), ("PoseParameters.txt", 93)])
def test_a_number_too_few_anywhere(copy, name, count):
    copy.edit(name, lambda numbers: numbers[1:])
    (sentence,) = refused(copy)
    assert f"{name}: {count - 1} numbers; expected {count}" in sentence


def test_shape_in_metres(copy):
    copy.edit("BodyShapeParameters.txt", lambda numbers: [str(float(n) / 1000) for n in numbers])
    (sentence,) = refused(copy)
    assert "longest length is 0.578571 mm; expected millimetres; it looks like metres" in sentence


def test_negative_radius(copy):
    copy.edit("BodyShapeParameters.txt", replaced(4, "-90"))
    (sentence,) = refused(copy)
    assert "BodyShapeParameters.txt: l_thigh, base radius = -90; expected a positive number" in sentence


def test_everything_wrong_is_said_at_once(copy):
    copy.edit("CALIB/Camera1.cal", replaced(0, "0"))
    copy.edit("CALIB/Camera2.cal", lambda numbers: numbers[:-1])
    copy.edit("InitialPose.txt", replaced(2, "nan"))
    (copy.own("FG2") / "image0001.bmp").unlink()
    sentences = refused(copy)
    assert len(sentences) == 4
    assert all(any(name in sentence for sentence in sentences) for name in ("Camera1.cal", "Camera2.cal", "InitialPose.txt", "FG2"))


def test_not_a_recording(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder; expected a bodytrack recording"):
        import_parsec(tmp_path / "nowhere", tmp_path / "session")
    with pytest.raises(InputError, match=r"CALIB: no Camera\*.cal in it"):
        import_parsec(tmp_path, tmp_path / "session")


def test_percent_sign_in_the_folders_name(copy, tmp_path):
    folder = tmp_path / "50% speed %d"
    shutil.move(copy.folder, folder)
    for name in ("CAM1", "CAM2", "CAM3", "CAM4", "FG1", "FG2", "FG3", "FG4"):
        original = (folder / name).resolve()
        (folder / name).unlink()
        shutil.copytree(original, folder / name)
    check_session(import_parsec(folder, tmp_path / "session")[0])
