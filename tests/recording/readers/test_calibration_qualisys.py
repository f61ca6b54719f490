"""Qualisys's XML: what is refused, and the real one."""

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.calibration.calibrated import check_rig
from bayes_body.recording.readers.calibration.qualisys import read_qualisys

SOUND = """\
<?xml version='1.0' encoding='ASCII'?>
<calibration><cameras>
<camera serial="26580" model="Miqus Video" viewrotation="0">
<fov_video left="0" top="0" right="1919" bottom="1087"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1" x="4263.3" y="2283.8" z="1794.3"/>
<intrinsic focalLengthU="107872.6" focalLengthV="107880.2" centerPointU="60827.2" centerPointV="32684.0" skew="0.0"
 radialDistortion1="-0.04545" radialDistortion2="0.139604" radialDistortion3="0.01" tangentalDistortion1="0.000615" tangentalDistortion2="-0.000391"/>
</camera></cameras></calibration>
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "room.qca.txt"
    path.write_text(SOUND)
    return path


def test_looks_along_its_negative_z(path):
    (camera,) = read_qualisys(path)
    assert (camera.name, camera.size_px) == ("26580", (1920, 1088))
    assert camera.focal_px[0] == pytest.approx(1685.509, abs=1e-3)
    assert camera.distortion == (-0.04545, 0.139604, 0.000615, -0.000391, 0.01)
    np.testing.assert_allclose(camera.viewpoint_m, [4.2633, 2.2838, 1.7943])
    # Not turned at all, it looks straight down.
    np.testing.assert_allclose(camera.rotation[2], [0, 0, -1], atol=1e-12)


REFUSED = {
    "turned images": ('viewrotation="0"', 'viewrotation="90"', "viewrotation: 90 degrees; expected 0"),
    "skew": ('skew="0.0"', 'skew="1.5"', "skew: 1.5; expected 0"),
    "no number": ('x="4263.3"', 'x="far"', "transform x: 'far'; expected a finite number"),
    "not finite": ('r11="1"', 'r11="nan"', "transform r11: 'nan'; expected a finite number"),
    "missing": ('focalLengthU="107872.6"', "", "intrinsic focalLengthU: missing"),
    "no rotation": ('r33="1"', 'r33="0.5"', "rotation: not a rotation"),
    "marker camera": ('model="Miqus Video"', 'model="Oqus 7"', "no video camera in it"),
    "no serial": ('serial="26580"', "", "without a name"),
    "no fov": ('<fov_video left="0" top="0" right="1919" bottom="1087"/>', "", "no <fov_video>"),
    "cut short": ("</cameras></calibration>", "", "not XML"),
    "entities": ("<calibration>", '<!DOCTYPE a [<!ENTITY b "b">]><calibration>', "a document type or entities"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_refused(path, fault):
    before, after, sentence = REFUSED[fault]
    assert before in SOUND
    path.write_text(SOUND.replace(before, after))
    with pytest.raises(InputError, match=f"^{path}: .*{sentence}") as error:
        read_qualisys(path)
    assert len(str(error.value).splitlines()) == 1


def test_a_hybrid_camera_films_and_a_camera_for_markers_is_said(path):
    camera = SOUND[SOUND.index("<camera ") : SOUND.index("</cameras>")]
    models = {"26580": "Miqus Video", "26581": "Miqus Hybrid", "26582": "Miqus M3"}
    listed = [camera.replace("26580", serial).replace("Miqus Video", model) for serial, model in models.items()]
    path.write_text(SOUND.replace(camera, "".join(listed)))
    notes = []
    assert [camera.name for camera in read_qualisys(path, notes.append)] == ["26580", "26581"]
    assert notes == ["room.qca.txt: 26582 (Miqus M3): cameras for markers, left out."]


def test_an_entity_bomb_in_another_encoding_is_refused(path):
    text = SOUND.replace("<calibration>", '<!DOCTYPE a [<!ENTITY b "b">]><calibration>').replace("ASCII", "UTF-16")
    path.write_bytes(text.encode("utf-16"))
    with pytest.raises(InputError, match="UTF-8"):
        read_qualisys(path)


def test_real_file(pose2sim_beam):
    cameras = read_qualisys(pose2sim_beam / "calibration" / "Calib.qca.txt")
    check_rig("beam", cameras)
    assert [camera.name for camera in cameras] == ["cam01", "cam02", "cam03", "cam04"]
    assert all(camera.size_px == (1088, 1920) for camera in cameras)
    for camera in cameras:
        # All stand 1.5 to 2.2 m high, look down at the beam in the middle, and see it upright: image rows grow downward.
        assert 1.5 < camera.viewpoint_m[2] < 2.2
        beam = camera.rotation @ [-0.5, 0.0, 0.9] + camera.translation_m
        assert beam[2] > 2 and np.abs(beam[:2] / beam[2]).max() < 0.4
        assert camera.rotation[1, 2] < -0.8
