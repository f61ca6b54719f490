"""Videos of an overlay: a browser plays them, and they are whole or refused."""

import base64
import re
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.view.video import h264_video

SIZE, FPS, FRAMES = (160, 120), 10.0, 12
# Within the page itself, so that its script may read the colours.
PLAYER = """<!doctype html><video muted src="data:video/mp4;base64,{}"></video><script>
const video = document.querySelector("video"), page = document.documentElement.dataset;
function tell() {{
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
  const pen = canvas.getContext("2d");
  pen.drawImage(video, 0, 0);
  Object.assign(page, {{width: video.videoWidth, height: video.videoHeight, ready: video.readyState, time: video.currentTime,
    left: pen.getImageData(40, 60, 1, 1).data, right: pen.getImageData(120, 60, 1, 1).data}});
}}
for (const event of ["timeupdate", "ended"]) video.addEventListener(event, tell);
video.addEventListener("error", () => page.fault = video.error.message);
video.play();
</script>"""


@pytest.fixture
def video(tmp_path):
    """Blue on the left, red on the right; BGR."""
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    picture[:, :80], picture[:, 80:] = (200, 0, 0), (0, 0, 200)
    with h264_video(tmp_path / "video.mp4", FPS, SIZE) as write:
        for _ in range(FRAMES):
            write(picture)
    return tmp_path / "video.mp4"


def test_a_browser_plays_it(browser, video, tmp_path):
    page = tmp_path / "player.html"
    page.write_text(PLAYER.format(base64.b64encode(video.read_bytes()).decode()))
    html, _ = browser(page, "--dump-dom", "--autoplay-policy=no-user-gesture-required")
    found = dict(re.findall(r'data-(\w+)="([^"]*)"', html))
    assert "fault" not in found, found
    assert (int(found["width"]), int(found["height"])) == SIZE
    assert float(found["time"]) > 0 and int(found["ready"]) >= 2
    left, right = (np.array(found[side].split(","), int)[:3] for side in ("left", "right"))
    np.testing.assert_allclose(left, [0, 0, 200], atol=12)
    np.testing.assert_allclose(right, [200, 0, 0], atol=12)


def test_it_is_what_browsers_play_and_begins_with_its_index(video):
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", Fraction(10))
        assert sum(1 for _ in container.decode(stream)) == FRAMES
    content = video.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_a_video_that_cannot_be_written_is_an_error_with_its_reason(tmp_path):
    path = tmp_path / "none" / "a.mp4"
    with pytest.raises(InputError, match=r"cannot be written as a video \(No such file"), h264_video(path, FPS, SIZE) as write:
        write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))


@pytest.mark.parametrize(("fps", "rate"), [(1e-9, 0.1), (0.001, 0.1), (29.97, 29.97), (70_000.0, 1000), (1e10, 1000)])
def test_a_rate_that_no_player_shows_is_the_nearest_one_that_it_does(tmp_path, fps, rate):
    with h264_video(tmp_path / "a.mp4", fps, SIZE) as write:
        for _ in range(3):
            write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert float(stream.average_rate) == pytest.approx(rate) and sum(1 for _ in container.decode(stream)) == 3


def test_a_picture_that_is_too_large_for_the_encoder(tmp_path):
    size = (20_000, 16)
    with pytest.raises(InputError, match=r"the encoder refuses 20000 x 16 pixels; .* 16384"), h264_video(tmp_path / "a.mp4", FPS, size) as write:
        write(np.zeros((size[1], size[0], 3), np.uint8))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, which is a full disk")
def test_a_full_disk_is_an_error(tmp_path):
    (tmp_path / "a.mp4").symlink_to("/dev/full")
    with pytest.raises(InputError, match="No space left"), h264_video(tmp_path / "a.mp4", FPS, SIZE) as write:
        write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
