"""Pictures: they are written, of the size of the images, and show what they say."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import build_model
from bayes_body.results.metrics.fit import Outline, outlines, projected_masks
from bayes_body.results.posterior import CentralPose
from bayes_body.tracking.track import track
from bayes_body.view import overlay
from bayes_body.view.colours import OVER_IMAGE, WORLD_AXES, bgr
from bayes_body.view.overlay import colour, draw_overlay, mosaic, paint, write_png
from bayes_body.view.rig_check import WIDEST, draw_check, padded, whole_image
from bayes_body.view.windows import EMPTY, STILL_HEIGHT, person_windows


@pytest.fixture(scope="module")
def model(textured_session):
    return build_model("arm", textured_session)


def test_the_silhouette_covers_what_the_surface_projects_to(model, textured_session):
    """Points on the axes of the parts, projected by OpenCV, lie in the mask; the image's corners do not."""
    pose = np.asarray(model.initial["pose"])
    masks = projected_masks(model, pose, textured_session)
    body = model.body
    shoulder, elbow, wrist = np.asarray(model.markers(jnp.asarray(pose)))
    assert np.isclose(np.linalg.norm(elbow - shoulder), body.lengths[0], atol=1e-5)
    points = np.array([shoulder + t * (elbow - shoulder) for t in (0.1, 0.5, 0.9)] + [elbow + t * (wrist - elbow) for t in (0.1, 0.5, 0.9)])
    for mask, view in zip(masks, textured_session.views, strict=True):
        camera = view.camera
        K = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
        rotation = cv2.Rodrigues(camera.rotation)[0]
        pixels = cv2.projectPoints(points, rotation, camera.translation_m, K, np.array(camera.distortion))[0][:, 0]
        columns, rows = np.round(pixels).astype(int).T
        inside = (columns >= 0) & (rows >= 0) & (columns < mask.shape[1]) & (rows < mask.shape[0])
        assert inside.any() and mask[rows[inside], columns[inside]].all()
        assert not mask[[0, 0, -1, -1], [0, -1, 0, -1]].any()


def test_an_outline_behind_a_camera_is_not_drawn(model, textured_session):
    camera = textured_session.views[0].camera
    turned = dataclasses.replace(
        camera, rotation=np.diag([-1.0, 1.0, -1.0]) @ camera.rotation, translation_m=np.diag([-1.0, 1.0, -1.0]) @ camera.translation_m
    )
    away = dataclasses.replace(textured_session, views=(dataclasses.replace(textured_session.views[0], camera=turned),))
    assert outlines(build_model("arm", away), np.asarray(model.initial["pose"])) == [[]]


def test_overlay_video_and_stills(model, textured_session, tmp_path, monkeypatch):
    draws = track(jax.random.key(0), textured_session, model, build_kernel(), particles=30, runs=2)
    video, *stills = draw_overlay(textured_session, draws, tmp_path)
    reader = cv2.VideoCapture(str(video))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and reader.get(cv2.CAP_PROP_FPS) == 60
    assert [path.name for path in stills] == [f"frame_{frame:06d}.png" for frame in range(5)]
    picture = cv2.imread(str(stills[0]))
    # A still shows what the video shows, larger.
    assert reader.get(cv2.CAP_PROP_FRAME_HEIGHT) == 480 and picture.shape[0] == STILL_HEIGHT
    assert abs(picture.shape[1] / reader.get(cv2.CAP_PROP_FRAME_WIDTH) - STILL_HEIGHT / 480) < 0.02
    # The arm's parts have no side: their outlines are green, on grey images.
    assert _green(picture) > 500
    assert _green(cv2.imread(str(textured_session.folder / "a" / "image0000.png"))) == 0
    # A long recording: every third frame, at the same speed.
    monkeypatch.setattr(overlay, "MOST_PICTURES", 2)
    video, *stills = draw_overlay(textured_session, draws, tmp_path / "long")
    reader = cv2.VideoCapture(str(video))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 2 and reader.get(cv2.CAP_PROP_FPS) == 20
    assert [path.name for path in stills] == ["frame_000000.png", "frame_000003.png"]
    assert _green(cv2.imread(str(stills[1]))) > 500


def test_sides_have_colours():
    assert [colour(name) for name in ("l_thigh", "r_calf", "torso")] == [bgr(OVER_IMAGE[side]) for side in ("l", "r", "")]


def _green(picture):
    blue, green, red = np.moveaxis(picture.astype(int), -1, 0)
    return int(((green > blue + 30) & (green > red + 30)).sum())


def test_the_mean_is_translucent_and_a_draw_lies_over_it():
    grey = np.full((100, 100, 3), 120, np.uint8)
    grey[40:60] = 180
    square = np.array([(10, 10), (90, 10), (90, 90), (10, 90)], float)
    across = np.array([(50, 5), (50, 95)], float)
    mean = paint(grey, [Outline("torso", square)], [])
    both = paint(grey, [Outline("torso", square)], [[Outline("l_thigh", across)]] * 8)
    inside, band, edge = (mean[row, column].astype(int) for row, column in ((30, 30), (50, 30), (10, 30)))
    middle = np.array(bgr(OVER_IMAGE[""]))
    # What is in the image is seen through the body and through its outline's colour.
    assert (band - inside > 40).all() and (inside != 120).any() and (edge != middle).any()
    assert abs(edge - middle).max() < abs(inside - middle).max()
    # The draw is to be seen inside of the body and across its outline, and nothing else changes.
    assert both[30, 50, 0] > mean[30, 50, 0] + 60 and both[10, 50, 0] > mean[10, 50, 0] + 60
    assert (both[:, :40] == mean[:, :40]).all()


def _lowered(session):
    """The session with its cameras a metre lower: the world's origin, at their feet, comes into view."""
    views = []
    for view in session.views:
        camera = dataclasses.replace(view.camera, translation_m=view.camera.translation_m + view.camera.rotation @ [0, 0, 1.0])
        views.append(dataclasses.replace(view, camera=camera))
    return dataclasses.replace(session, views=tuple(views))


def _count(picture, ink):
    return int((np.abs(picture.astype(int) - ink).max(axis=-1) < 40).sum())


@pytest.mark.slow
@pytest.mark.parametrize("origin_in_view", [True, False])
def test_the_import_picture_shows_the_axes_where_the_origin_is_in_view(textured_session, tmp_path, origin_in_view):
    session = _lowered(textured_session) if origin_in_view else textured_session
    picture = cv2.imread(str(draw_check(session, build_model("arm", session), tmp_path / "made" / "check.png")))
    # The whole image of each camera, 4 by 3 and 8 by 9, and beside it the part that shows the body; the lowered cameras do not see it.
    shape = (1, 4 / 3 + 8 / 9) if origin_in_view else (2, 4 / 3 + 1)
    assert picture.shape[:2] == tuple(round(STILL_HEIGHT * side) for side in shape)
    for ink in WORLD_AXES:
        assert (_count(picture, bgr(ink)) > 30) == origin_in_view


def test_the_import_picture_shows_which_way_is_up_and_a_floor_of_metres(textured_session, tmp_path):
    """The corners of the floor's tiles, projected by OpenCV, lie on light lines; seen from above they would be elsewhere if another axis were up."""
    session = dataclasses.replace(_lowered(textured_session), folder=_flat(textured_session, tmp_path))
    tile = cv2.imread(str(draw_check(session, build_model("arm", session), tmp_path / "check.png")))
    view = session.views[0]
    corners = np.array([(x, y, 0) for x in range(-2, 1) for y in range(-1, 2) if (x, y) != (0, 0)], float)
    columns, rows = (_projected(corners, view.camera) * STILL_HEIGHT / view.camera.size_px[1]).round().astype(int).T
    width = STILL_HEIGHT * view.camera.size_px[0] // view.camera.size_px[1]
    inside = (columns > 5) & (columns < width - 5) & (rows > 5) & (rows < STILL_HEIGHT - 5)
    assert inside.sum() >= 3
    grey = tile[:STILL_HEIGHT, :width].max(axis=-1)
    for column, row in zip(columns[inside], rows[inside], strict=True):
        assert grey[row - 4 : row + 5, column - 4 : column + 5].max() > 90
    other = cv2.imread(str(draw_check(dataclasses.replace(session, up="y"), build_model("arm", session), tmp_path / "other.png")))
    assert (tile != other).any()


def _projected(points, camera):
    K = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    return cv2.projectPoints(points, cv2.Rodrigues(camera.rotation)[0], camera.translation_m, K, np.array(camera.distortion))[0][:, 0]


def _flat(session, folder):
    """Images of one dark grey, with a corner that tells them from a covered camera's."""
    for view in session.views:
        (folder / view.camera.name).mkdir()
        image = np.full(view.camera.size_px[::-1], 20, np.uint8)
        image[-20:, -20:] = 60
        for frame in range(session.frames):
            cv2.imwrite(str(folder / view.camera.name / f"image{frame:04d}.png"), image)
            cv2.imwrite(str(folder / view.camera.name / f"mask{frame:04d}.png"), image)
    return folder


def test_the_import_picture_of_a_session_without_masks(textured_session, tmp_path):
    session = dataclasses.replace(textured_session, views=tuple(dataclasses.replace(view, masks=None) for view in textured_session.views))
    assert draw_check(session, build_model("arm", session), tmp_path / "check.png").exists()


@pytest.fixture
def coloured(textured_session, model, tmp_path):
    """Cameras that see red, the second of which misses a frame."""
    folder = _flat(textured_session, tmp_path)
    for view in textured_session.views:
        image = np.zeros((*view.camera.size_px[::-1], 3), np.uint8)
        image[:, : image.shape[1] // 2] = (0, 0, 120)
        cv2.imwrite(str(folder / view.camera.name / "image0001.png"), image)
    (folder / "b" / "image0002.png").unlink()
    return dataclasses.replace(textured_session, folder=folder)


def test_pictures_are_in_colour_and_dark_where_a_camera_did_not_see(coloured, model):
    pose = np.asarray(model.initial["pose"])
    windows = person_windows(coloured, model, np.stack([pose] * coloured.frames))
    red = mosaic(coloured, model, 1, CentralPose(pose, True), pose[None], windows)
    assert _count(red, (0, 0, 120)) > 0.2 * red[..., 0].size
    half = mosaic(coloured, model, 2, CentralPose(pose, False), pose[None], windows)
    assert red.shape == half.shape
    unseen = half[:, windows[0].tile[0] : windows[0].tile[0] + windows[1].tile[0]]
    assert (unseen == EMPTY).all(axis=-1).mean() > 0.5
    # Its name, what is missing, and the posterior are there all the same.
    assert _count(unseen, (255, 255, 255)) > 100 and _green(unseen) > 100


def test_a_folder_that_cannot_be_written_is_said(model, textured_session, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        draw_check(textured_session, model, tmp_path / "file" / "check.png")


@pytest.mark.parametrize("size", [(3000, 1), (1, 3000), (640, 480), (100_000, 40)])
def test_a_camera_of_any_shape_has_a_tile(size):
    tile = padded(whole_image(size).cut(np.full((size[1], size[0], 3), 200, np.uint8)))
    assert tile.shape[0] == STILL_HEIGHT and 1 <= tile.shape[1] <= WIDEST
    assert tile.max() == 200


@pytest.mark.slow
def test_a_thin_camera_is_drawn(model, textured_session, tmp_path):
    first, *others = textured_session.views
    thin = dataclasses.replace(first, camera=dataclasses.replace(first.camera, name="thin", size_px=(3000, 1)), images=None, masks=None)
    session = dataclasses.replace(textured_session, views=(thin, *others))
    mask = np.full((1, 3000), 255, np.uint8)
    folder = _flat(textured_session, tmp_path)
    (folder / "thin").mkdir()
    for frame in range(session.frames):
        cv2.imwrite(str(folder / "thin" / f"image{frame:04d}.png"), mask)
    thin = dataclasses.replace(thin, images="thin/image%04d.png", masks="thin/image%04d.png")
    session = dataclasses.replace(session, folder=folder, views=(thin, *others))
    assert draw_check(session, build_model("arm", session), tmp_path / "check.png").exists()
    draws = track(jax.random.key(0), session, build_model("arm", session), build_kernel(), particles=30, frames=2)
    assert all(path.exists() for path in draw_overlay(session, draws, tmp_path))


def test_a_picture_that_is_too_large_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"large\.png: 2000000 x 1 pixels cannot be written"):
        write_png(tmp_path / "large.png", np.zeros((1, 2_000_000), np.uint8))
    assert not list(tmp_path.iterdir())
