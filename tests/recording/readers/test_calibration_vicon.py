"""Vicon's xcp: the rig that was written, cameras for markers, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.calibration.vicon import read_vicon

R = Rotation.from_euler("xyz", [-80, 20, 5], degrees=True).as_matrix()
CENTRE_MM = (3410.5, -2090.25, 1300.0)
QUATERNION = " ".join(map(repr, Rotation.from_matrix(R).as_quat().tolist()))


def camera(device="2107001", system="DV", kind="Vue", orientation=QUATERNION, radial="ViconRadial2 640.1 360.2 -0.06 0.03 0.001"):
    place = " ".join(map(str, CENTRE_MM))
    return (
        f'<Camera DEVICEID="{device}" TYPE="{kind}" SYSTEM="{system}" SENSOR_SIZE="1280 720" PIXEL_ASPECT_RATIO="1.01"><KeyFrames>'
        '<KeyFrame FRAME="0" FOCAL_LENGTH="1" PRINCIPAL_POINT="1 1" ORIENTATION="0 0 0 1" POSITION="0 0 0"/>'
        f'<KeyFrame FRAME="9" FOCAL_LENGTH="1010" PRINCIPAL_POINT="640.1 360.2" ORIENTATION="{orientation}" POSITION="{place}" '
        f'VICON_RADIAL2="{radial}"/></KeyFrames></Camera>'
    )


@pytest.fixture
def write(tmp_path):
    def call(*cameras):
        path = tmp_path / "walk.xcp"
        path.write_text(f"<?xml version='1.0'?><Cameras VERSION='1.2'>{''.join(cameras)}</Cameras>")
        return path

    return call


def test_the_last_key_frame_is_the_camera(write):
    notes = []
    (seen,) = read_vicon(write(camera(), camera("7", "Vantage", "V5")), notes.append)
    assert (seen.name, seen.size_px, seen.centre_px) == ("2107001", (1280, 720), (640.1, 360.2))
    np.testing.assert_allclose(seen.focal_px, (1010, 1000))
    assert seen.distortion == (-0.06, 0.03, 0.0, 0.0, 0.001)
    np.testing.assert_allclose(seen.rotation, R, atol=1e-12)
    np.testing.assert_allclose(seen.viewpoint_m, np.array(CENTRE_MM) / 1000)
    assert notes == ["walk.xcp: 7 (Vantage V5): cameras for markers, left out."]


REFUSED = {
    "no video camera": ({"system": "Vantage", "kind": "V5"}, "no video camera in it, but Vantage V5"),
    "no quaternion": ({"orientation": "0 0 1"}, "ORIENTATION: '0 0 1'; expected 4 finite numbers"),
    "no rotation": ({"orientation": "0 0 0 2"}, "ORIENTATION: a quaternion of length 2; expected 1"),
    "not finite": ({"radial": "ViconRadial2 0 0 nan 0 0"}, "VICON_RADIAL2: 'nan 0 0'; expected 3 finite numbers"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_refused(write, fault):
    given, sentence = REFUSED[fault]
    with pytest.raises(InputError, match=sentence):
        read_vicon(write(camera(**given)))
