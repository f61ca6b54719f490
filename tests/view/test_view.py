"""Pictures: they are written, of the size of the images, and show what they say."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.errors import InputError
from bayes_body.kernels.particle_filter import build_kernel
from bayes_body.model import load_model
from bayes_body.tracking import track
from bayes_body.view.overlay import LEFT, MIDDLE, RIGHT, colour, draw_overlay, grid
from bayes_body.view.rig_check import AXIS_COLOURS, draw_check
from bayes_body.view.silhouette import outlines, projected_masks


@pytest.fixture(scope="module")
def model(textured_session):
    return load_model("arm", textured_session)


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
    assert outlines(load_model("arm", away), np.asarray(model.initial["pose"])) == [[]]


def test_overlay_video_and_stills(model, textured_session, tmp_path):
    draws = track(textured_session, model, build_kernel(), jax.random.key(0), particles=30, runs=2)
    video, *stills = draw_overlay(textured_session, draws, tmp_path)
    reader = cv2.VideoCapture(str(video))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and reader.get(cv2.CAP_PROP_FPS) == 60
    assert [path.name for path in stills] == [f"frame_{frame:06d}.png" for frame in range(5)]
    picture = cv2.imread(str(stills[0]))
    assert picture.shape[1] == int(reader.get(cv2.CAP_PROP_FRAME_WIDTH)) and picture.shape[0] == 480
    # The arm's parts have no side: their strong outline has the middle's colour, on grey images.
    assert (np.abs(picture.astype(int) - MIDDLE).max(axis=-1) < 40).sum() > 100


def test_sides_have_colours():
    assert [colour(name) for name in ("l_thigh", "r_calf", "torso")] == [LEFT, RIGHT, MIDDLE]


def test_tiles_of_any_width_make_a_grid():
    tiles = [np.zeros((480, width, 3), np.uint8) for width in (101, 200, 333)]
    assert grid(tiles).shape == (960, 334, 3)


def _lowered(session):
    """The session with its cameras a metre lower: the world's origin, at their feet, comes into view."""
    views = []
    for view in session.views:
        camera = dataclasses.replace(view.camera, translation_m=view.camera.translation_m + view.camera.rotation @ [0, 0, 1.0])
        views.append(dataclasses.replace(view, camera=camera))
    return dataclasses.replace(session, views=tuple(views))


def _count(picture, ink):
    return int((np.abs(picture.astype(int) - ink).max(axis=-1) < 40).sum())


@pytest.mark.parametrize("origin_in_view", [True, False])
def test_the_import_picture_shows_the_axes_where_the_origin_is_in_view(textured_session, tmp_path, origin_in_view):
    session = _lowered(textured_session) if origin_in_view else textured_session
    picture = cv2.imread(str(draw_check(session, load_model("arm", session), tmp_path / "made" / "check.png")))
    assert picture.shape[0] == 480
    for ink in AXIS_COLOURS:
        assert (_count(picture, ink) > 30) == origin_in_view


def test_a_folder_that_cannot_be_written_is_said(model, textured_session, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        draw_check(textured_session, model, tmp_path / "file" / "check.png")
