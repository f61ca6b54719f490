"""The check of a whole session, on a damaged copy of the real recording."""

import cv2
import numpy as np
import pytest

from bayes_body.errors import FaultyFileError
from bayes_body.recording.check import check_session
from bayes_body.recording.parsec import import_parsec


@pytest.fixture
def damaged(copy, tmp_path):
    """A good session whose images of CAM2 and FG2 can then be spoilt."""
    folders = copy.own("CAM2"), copy.own("FG2")
    session, _ = import_parsec(copy.folder, tmp_path / "session")
    return session, *folders


def sentences(session) -> tuple[str, ...]:
    with pytest.raises(FaultyFileError) as error:
        check_session(session)
    return error.value.sentences


def test_missing_images_are_one_sentence_a_camera(damaged):
    session, images, _ = damaged
    for number in (1, 2):
        (images / f"image000{number}.bmp").unlink()
    (sentence,) = sentences(session)
    assert "camera 'CAM2': 2 of 4 images are missing, the first is" in sentence
    assert "CAM2/image0001.bmp; expected a file for every frame; restore them, or correct images, first_frame and frames" in sentence


def test_last_image_cut_short_and_mask_of_another_size(damaged):
    session, images, masks = damaged
    whole = (images / "image0003.bmp").read_bytes()
    (images / "image0003.bmp").unlink()
    (images / "image0003.bmp").write_bytes(whole[:5000])
    (masks / "image0003.bmp").unlink()
    cv2.imwrite(str(masks / "image0003.bmp"), np.zeros((100, 200), np.uint8))
    cut, size = sentences(session)
    assert "CAM2/image0003.bmp: cut short, 303278 of 308278 bytes are missing" in cut
    assert "FG2/image0003.bmp: 200 x 100 pixels; expected 640 x 480 as its camera has; use the images" in size
