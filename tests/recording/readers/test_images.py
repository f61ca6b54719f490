"""Image files, whole and broken."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.images import NotSeenError, is_image, read_colour, read_grey, read_mask

GREY = np.random.default_rng(3).integers(0, 256, (37, 51), dtype=np.uint8)


@pytest.fixture(params=[".bmp", ".png", ".tiff"])
def path(request, tmp_path):
    """An image of each lossless format."""
    path = tmp_path / f"image0000{request.param}"
    cv2.imwrite(str(path), GREY)
    return path


def test_reads_grey_values_and_masks(path):
    np.testing.assert_array_equal(read_grey(path, (51, 37)), GREY)
    np.testing.assert_array_equal(read_mask(path), GREY > 127)


def test_reads_colours(tmp_path):
    colours = np.random.default_rng(5).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "image.png"), colours)
    np.testing.assert_array_equal(read_colour(tmp_path / "image.png", (30, 20)), colours)
    cv2.imwrite(str(tmp_path / "grey.png"), GREY)
    np.testing.assert_array_equal(read_colour(tmp_path / "grey.png"), np.repeat(GREY[..., None], 3, axis=-1))


def test_what_is_an_image(path, tmp_path):
    (tmp_path / "text.png").write_text("hello")
    assert is_image(path) and not is_image(tmp_path / "text.png")


def test_real_images(bodytrack):
    assert read_grey(bodytrack / "CAM1" / "image0000.bmp", (640, 480)).shape == (480, 640)
    assert 0.02 < read_mask(bodytrack / "FG1" / "image0000.bmp").mean() < 0.2


@pytest.mark.parametrize("share", [0.05, 0.5, 0.98])
def test_cut_short(path, share, capfd):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(NotSeenError, match=f"{path.name}: .*cut short.*; copy the file again"):
        read_grey(path)
    assert "ERROR" not in capfd.readouterr().err


@pytest.mark.parametrize("size", [0, 7, 0xFFFFFFFF])
def test_a_bmp_whose_header_gives_a_wrong_file_size_is_read(tmp_path, size):
    path = tmp_path / "odd.bmp"
    cv2.imwrite(str(path), GREY)
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, 2, size)
    path.write_bytes(content)
    np.testing.assert_array_equal(read_grey(path), GREY)


def test_a_size_that_no_camera_has_is_refused_before_the_image_is_decoded(tmp_path):
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    for side in (60_000, 30_000):
        header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0))
        path = tmp_path / "large.png"
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b""))
        with pytest.raises(InputError, match=r"large.png: more pixels than any camera has, according to its header; expected at most 134217728"):
            read_colour(path)


def test_other_size(path):
    with pytest.raises(InputError, match=f"{path.name}: 51 x 37 pixels; expected 640 x 480 as its camera has; use the images") as error:
        read_grey(path, (640, 480))
    # Not a frame to go on without.
    assert not isinstance(error.value, NotSeenError)


def test_no_image(tmp_path):
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty.png").touch()
    for name, found in [("text.png", "not an image"), ("empty.png", "empty"), ("none.png", "no such file"), ("", "a folder")]:
        with pytest.raises(InputError, match=f"{name}: {found}"):
            read_grey(tmp_path / name)
