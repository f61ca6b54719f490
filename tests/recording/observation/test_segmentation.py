"""Silhouettes without masks: a background learned from the recording or from the empty scene, shadows, exposure; nothing depends on the order.

The scenes are drawn by hand, with textures, discs and sinusoidal noise: nothing of the Gaussian model that is fitted to them.
"""

import dataclasses

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.observation import silhouettes
from bayes_body.recording.observation.background import learn_background, shrink, still_background
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.observation.segmentation import foreground_levels, independent_log_odds
from bayes_body.recording.readers.videos.video import read_video_frame
from bayes_body.recording.session.session import Segmentation

ROWS, COLUMNS, FRAMES = 120, 160, 30
PERSON = (60, 90, 220)


def room(seed: int = 1) -> np.ndarray:
    """Coloured blobs, 60 to 200 grey levels, none of the person's colour."""
    field = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(ROWS, COLUMNS)).astype(np.float32), (0, 0), 6)
    level = (field - field.min()) / np.ptp(field)
    return np.stack([200 - 80 * level, 90 + 90 * level, 60 + 60 * level], axis=-1)


def person(column: float) -> np.ndarray:
    """A disc on a post, as a mask."""
    mask = np.zeros((ROWS, COLUMNS), np.uint8)
    cv2.circle(mask, (round(column), 40), 12, 1, -1)
    cv2.rectangle(mask, (round(column) - 8, 45), (round(column) + 8, 100), 1, -1)
    return mask > 0


def photograph(scene: np.ndarray, frame: int, mask: np.ndarray | None = None, gain: float = 1.0, offset: float = 0.0) -> np.ndarray:
    """The scene with a person before it, and an interference pattern that changes from frame to frame."""
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    ripple = 2 * np.sin(0.9 * rows + 1.3 * frame)[..., None] * np.sin(0.7 * columns + 2.1 * frame)[..., None]
    image = scene.copy()
    if mask is not None:
        image[mask] = PERSON
    return np.clip(gain * image + offset + ripple, 0, 255).astype(np.uint8)


def column(frame: int) -> float:
    """Where the person is: comes in from the left, stays around the middle for two thirds of the time, leaves."""
    return float(np.interp(frame, [0, 5, 10, 24, 29], [-30, 20, 70, 78, 200]))


def agreement(found: np.ndarray, true: np.ndarray) -> float:
    return (found & true).sum() / (found | true).sum()


@pytest.fixture(scope="module")
def recording() -> list[np.ndarray]:
    scene = room()
    return [photograph(scene, frame, person(column(frame))) for frame in range(FRAMES)]


@pytest.fixture(scope="module")
def background(recording):
    return learn_background(recording, follow_exposure=True)


def test_one_who_stays_is_not_learned(background):
    assert np.abs(background.mean - room()).mean() < 2
    assert np.abs(background.mean - room()).max() < 25


@pytest.mark.parametrize("frame", [5, 12, 17, 24])
def test_silhouettes_of_the_recording(recording, background, frame):
    levels = foreground_levels(background, recording[frame], Segmentation())
    assert levels is not None and levels.shape == (ROWS, COLUMNS)
    assert agreement(levels > 127, person(column(frame))) > 0.95


def test_an_empty_frame_has_no_silhouette(background):
    levels = foreground_levels(background, photograph(room(), 77), Segmentation())
    assert levels is not None and not (levels > 127).any()


def test_a_frame_s_silhouette_does_not_depend_on_the_frames_before(recording, background):
    copies = [array.copy() for array in background]
    first = foreground_levels(background, recording[12], Segmentation())
    for frame in (3, 20, 29):
        foreground_levels(background, 255 - recording[frame], Segmentation())
    np.testing.assert_array_equal(foreground_levels(background, recording[12], Segmentation()), first)
    for array, before in zip(background, copies, strict=True):
        np.testing.assert_array_equal(array, before)


def test_the_same_frames_give_the_same_background(recording, background):
    for array, again in zip(background, learn_background(recording, follow_exposure=True), strict=True):
        np.testing.assert_array_equal(array, again)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 12.0), (0.85, 0.0), (1.2, 5.0)])
def test_exposure_is_followed(background, gain, offset):
    image = photograph(room(), 50, person(100), gain, offset)
    levels = foreground_levels(background, image, Segmentation())
    assert levels is not None and agreement(levels > 127, person(100)) > 0.93
    fixed = foreground_levels(background, image, Segmentation(follow_exposure=False, shadows=False))
    assert fixed is not None and agreement(fixed > 127, person(100)) < 0.8


def test_drift_while_the_background_is_learned():
    scene = room()
    images = [photograph(scene, frame, person(column(frame)), 1.0, 12 * np.sin(frame / 5)) for frame in range(FRAMES)]
    learned = learn_background(images, follow_exposure=True)
    for frame in (6, 15, 24):
        levels = foreground_levels(learned, images[frame], Segmentation())
        assert levels is not None and agreement(levels > 127, person(column(frame))) > 0.9


def test_shadows_are_background_if_so_wished(background):
    scene = room()
    shadow = np.zeros((ROWS, COLUMNS), bool)
    shadow[100:115, 60:140] = True
    scene[shadow] *= 0.65
    image = photograph(scene, 9, person(100))
    with_shadows, without = (foreground_levels(background, image, Segmentation(shadows=shadows)) for shadows in (False, True))
    only_shadow = shadow & ~person(100)
    assert with_shadows is not None and (with_shadows > 127)[only_shadow].mean() > 0.9
    assert without is not None and (without > 127)[only_shadow].mean() < 0.02
    assert agreement(without > 127, person(100)) > 0.9


def test_a_grey_camera_has_no_shadows_and_dark_clothes():
    grey = np.repeat(room()[..., :1], 3, axis=-1).astype(np.uint8)
    background = still_background(grey)
    assert background.mean.shape == (ROWS, COLUMNS, 1)
    image = grey.copy()
    image[person(80)] = (0.7 * image[person(80)]).astype(np.uint8)
    levels = foreground_levels(background, image, Segmentation())
    assert levels is not None and agreement(levels > 127, person(80)) > 0.9


def test_the_probability_is_that_of_the_formula():
    """A square that differs in one channel by d standard deviations: log-odds of (d² - threshold) / 2."""
    scene = np.random.default_rng(2).integers(80, 170, (60, 80, 3)).astype(np.uint8)
    background = still_background(scene)
    for off in (20, 23, 25, 27, 40):
        image = scene.copy()
        image[20:40, 30:50, 1] += off
        log_odds = independent_log_odds(background, image, Segmentation(shadows=False, follow_exposure=False))
        assert log_odds is not None and log_odds[30, 40] == pytest.approx(((off / 6.0) ** 2 - 16) / 2, abs=1e-4)
        assert log_odds[5, 5] == -8


def test_what_has_the_person_s_colour_is_the_person_s():
    """A leg that hardly differs from what is behind it, below a body of the same colour that does; a spot elsewhere differs as little."""
    scene = np.full((ROWS, COLUMNS, 3), (120, 100, 90), np.uint8)
    scene[70:] = (100, 140, 100)
    clothes, other = (88, 133, 108), (112, 133, 108)
    image = scene.copy()
    image[20:90, 60:90] = clothes
    image[72:88, 120:150] = other
    levels = foreground_levels(still_background(scene), image, Segmentation(shadows=False, follow_exposure=False))
    alone = independent_log_odds(still_background(scene), image, Segmentation(shadows=False, follow_exposure=False))
    assert levels is not None and alone is not None
    assert alone[80, 75] == alone[80, 135] < 0
    assert (levels[75:85, 65:85] > 127).all()
    assert not (levels[70:, 110:] > 127).any()


def test_what_is_in_doubt_is_what_its_neighbours_are():
    """Spots within a person and beside it, of a colour that is neither the person's nor quite the background's."""
    scene = np.full((ROWS, COLUMNS, 3), (120, 100, 90), np.uint8)
    image = scene.copy()
    image[20:90, 60:90] = PERSON
    for rows, columns in ((slice(30, 33), slice(70, 73)), (slice(60, 63), slice(75, 78)), (slice(40, 43), slice(120, 123))):
        image[rows, columns] = scene[rows, columns] + 13
    options = Segmentation(shadows=False, follow_exposure=False)
    alone, levels = independent_log_odds(still_background(scene), image, options), foreground_levels(still_background(scene), image, options)
    assert alone is not None and levels is not None
    assert alone[31, 71] == alone[61, 76] == alone[41, 121] < 0
    assert (levels[30:33, 70:73] > 127).all() and (levels[60:63, 75:78] > 127).all()
    assert not (levels[38:46, 118:126] > 127).any()


@pytest.mark.parametrize("level", [0, 255])
def test_an_image_that_shows_nothing_has_no_silhouette(background, level):
    assert foreground_levels(background, np.full((ROWS, COLUMNS, 3), level, np.uint8), Segmentation()) is None


def test_large_images_are_worked_on_small():
    scene = cv2.resize(room().astype(np.uint8), (1600, 1200), interpolation=cv2.INTER_CUBIC)
    background = still_background(scene)
    assert background.mean.shape == (480, 640, 3)
    image, mask = scene.copy(), cv2.resize(person(100).astype(np.uint8), (1600, 1200)) > 0
    image[mask] = PERSON
    levels = foreground_levels(background, shrink(image), Segmentation())
    assert levels is not None and levels.shape == (480, 640)
    assert agreement(cv2.resize(levels, (1600, 1200), interpolation=cv2.INTER_LINEAR) > 127, mask) > 0.97


@pytest.fixture
def session(textured_session, recording, tmp_path):
    """`session(**fields of the view)`: one camera, image files, no masks."""
    for frame, image in enumerate(recording):
        cv2.imwrite(str(tmp_path / f"image{frame:04d}.png"), image)
    cv2.imwrite(str(tmp_path / "empty.png"), photograph(room(), 40))

    def make(frames: int = FRAMES, **fields):
        view = dataclasses.replace(textured_session.views[0], images="image%04d.png", masks=None, **fields)
        return dataclasses.replace(textured_session, folder=tmp_path, views=(view,), frames=frames)

    return make


def filmed(path, frames: range) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (COLUMNS, ROWS))
    for frame in frames:
        writer.write(photograph(room(), frame))
    writer.release()


def test_a_silhouette_is_made_once_for_its_picture(session, tmp_path, monkeypatch):
    made = []

    def counted(*arguments):
        made.append(arguments)
        return foreground_levels(*arguments)

    monkeypatch.setattr(silhouettes, "foreground_levels", counted)
    first, again = (np.asarray(read_frame(session(background="empty.png"), 15).masks[0]) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(made) == 1
    # The same number, another picture; and another background.
    cv2.imwrite(str(tmp_path / "image0015.png"), photograph(room(), 15))
    assert not np.asarray(read_frame(session(background="empty.png"), 15).masks[0]).any()
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((ROWS, COLUMNS, 3), 90, np.uint8))
    _ = read_frame(session(background="empty.png"), 15).masks[0]
    assert len(made) == 3


@pytest.mark.parametrize("source", ["recording", "empty image", "empty video"])
def test_silhouettes_of_a_session(session, tmp_path, source):
    filmed(tmp_path / "empty.avi", range(40, 60))
    fields = {"recording": {}, "empty image": {"background": "empty.png"}, "empty video": {"background": "empty.avi"}}[source]
    frame = read_frame(session(**fields), 15)
    assert frame.masks is not None and frame.foreground is not None
    mask, foreground = frame.masks[0], frame.foreground[0]
    assert mask is not None and foreground is not None and foreground.dtype == np.float32
    assert agreement(mask, person(column(15))) > 0.93
    np.testing.assert_array_equal(mask, foreground > 0.5)
    assert foreground.min() >= 0 and foreground.max() <= 1


def test_an_empty_scene_makes_few_frames_enough(session):
    few = session(frames=3)
    assert read_frame(few, 0).masks is None
    masks = read_frame(session(frames=6, background="empty.png"), 5).masks
    assert masks is not None and masks[0] is not None and agreement(masks[0], person(column(5))) > 0.93


def test_frames_that_were_not_seen_are_not_learned_from(session, tmp_path):
    made = session()
    for frame in range(10, 20):
        cv2.imwrite(str(tmp_path / f"image{frame:04d}.png"), np.zeros((ROWS, COLUMNS, 3), np.uint8))
    (tmp_path / "image0004.png").unlink()
    masks = read_frame(made, 24).masks
    assert masks is not None and masks[0] is not None and agreement(masks[0], person(column(24))) > 0.9
    assert read_frame(made, 12).masks[0] is None


def test_too_few_frames_seen(session, tmp_path):
    made = session()
    for frame in range(5, FRAMES):
        (tmp_path / f"image{frame:04d}.png").unlink()
    with pytest.raises(InputError, match=r"camera 'a': 5 of its frames can be read, .*; expected 10 or more to learn .*; give it `background`"):
        read_frame(made, 0).masks[0]


def test_a_background_is_learned_once(session, monkeypatch):
    calls = []
    learn = silhouettes.learn_background
    monkeypatch.setattr(silhouettes, "learn_background", lambda *arguments: calls.append(1) or learn(*arguments))
    made = session(frames=FRAMES - 1)
    first = [read_frame(made, index).masks[0] for index in (12, 3)]
    again = [read_frame(dataclasses.replace(made), index).masks[0] for index in (12, 3)]
    assert calls == [1]
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.long
def test_a_real_drift_of_exposure_leaves_the_masks_clean(sports2d_walk):
    """Of frame 180 onwards the image is up to 12 grey levels brighter: the woman at the left is there, the box, the facade and the lawn are not."""
    path = sports2d_walk / "videos" / "demo.mp4"
    background = learn_background([shrink(read_video_frame(path, number)) for number in range(0, 230, 6)], follow_exposure=True)
    bright, plain = (read_video_frame(path, number) for number in (180, 120))
    drift = (bright[::4, 1100:1300:4].astype(float) - plain[::4, 1100:1300:4]).mean()
    assert drift > 5
    levels = foreground_levels(background, shrink(bright), Segmentation())
    assert levels is not None
    mask = cv2.resize(levels, bright.shape[1::-1], interpolation=cv2.INTER_LINEAR) > 127
    # She walks within columns 40 to 320 and rows 500 to 994 of this picture.
    assert mask[500:, 40:320].mean() > 0.1
    assert mask[500:, 400:1500].mean() < 0.01
    assert mask[200:480, :500].mean() < 0.01
    unfollowed = foreground_levels(background, shrink(bright), Segmentation(follow_exposure=False))
    assert unfollowed is not None and (unfollowed > 127).mean() > 2 * mask.mean()
