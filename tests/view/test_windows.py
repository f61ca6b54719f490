"""Windows on the person: they hold the body in every frame, map points as they map the image, and do not shake."""

import dataclasses
from itertools import pairwise

import cv2
import numpy as np
import pytest

from bayes_body.model.build import build_model
from bayes_body.results.metrics.fit import outlines
from bayes_body.view.windows import EMPTY, SHAPES, TILE_HEIGHT, Window, columns_of, grid, person_windows


@pytest.fixture(scope="module")
def model(textured_session):
    return build_model("arm", textured_session)


@pytest.fixture(scope="module")
def poses(model):
    """An arm that swings."""
    pose = np.asarray(model.initial["pose"])
    return np.stack([pose + np.array([0.2 * np.sin(k), 0, 0, 0.3 * np.cos(k)]) for k in range(5)])


def test_the_body_is_in_every_tile_and_tiles_have_one_size(textured_session, model, poses):
    windows = person_windows(textured_session, model, poses)
    assert len({window.tile for window in windows}) == 1
    for frame, pose in enumerate(poses):
        for window, view, parts in zip(windows, textured_session.views, outlines(model, pose), strict=True):
            polygon = np.concatenate([part.polygon for part in parts])
            inside = ((polygon >= 0) & (polygon < view.camera.size_px)).all(axis=1)
            placed = window.place(polygon[inside], frame)
            assert inside.any() and (placed >= 0).all() and (placed < window.tile).all()


@pytest.mark.parametrize(("size", "tile"), [((120, 80), (360, 240)), ((150, 100), (75, 50)), ((300, 200), (150, 100))])
def test_a_point_is_placed_where_its_pixel_is_shown(size, tile):
    """A small dot of the image is found in the tile where `place` says, enlarged, made smaller, and beyond the image's edge."""
    image, dot = np.full((160, 200, 3), 100, np.uint8), np.array([[101.0, 71.0]])
    cv2.circle(image, (101, 71), 4, (255, 255, 255), -1, cv2.LINE_AA)
    window = Window(size, np.array([[0.0, 0.0], [96.3, 78.6]]), tile)
    shown = window.cut(image, 1)
    assert shown.shape == (tile[1], tile[0], 3)
    bright = np.clip(shown[..., 0].astype(float) - 130, 0, None)
    rows, columns = np.indices(bright.shape)
    middle = [(columns * bright).sum() / bright.sum(), (rows * bright).sum() / bright.sum()]
    np.testing.assert_allclose(window.place(dot, 1)[0], middle, atol=0.6)
    assert (shown[0, 0] == EMPTY).all() == (size[0] > 200)


def test_a_window_follows_without_shaking(textured_session, model, poses):
    """Its centre moves less from frame to frame than the body's box does."""
    long = np.concatenate([poses] * 8)
    session = dataclasses.replace(textured_session, frames=len(long), fps=30.0)
    window = person_windows(session, model, long)[0]
    boxes = [np.concatenate([part.polygon for part in outlines(model, pose)[0]]) for pose in long]
    middles = np.array([(box.min(axis=0) + box.max(axis=0)) / 2 for box in boxes])
    steps = [np.abs(np.diff(path, axis=0)).max() for path in (window.centres, middles)]
    assert steps[0] < steps[1] / 3


def test_a_body_that_no_image_shows_leaves_the_whole_image(textured_session, model, poses):
    away = []
    for view in textured_session.views:
        turned = dataclasses.replace(view.camera, rotation=np.diag([-1.0, 1.0, -1.0]) @ view.camera.rotation)
        away.append(dataclasses.replace(view, camera=turned))
    session = dataclasses.replace(textured_session, views=tuple(away))
    for window, view in zip(person_windows(session, build_model("arm", session), poses), session.views, strict=True):
        size = np.array(view.camera.size_px)
        assert (window.size >= size - 1).all()
        np.testing.assert_allclose(window.centres, np.tile(size / 2, (5, 1)), atol=1)


def test_shapes_stay_between_a_standing_and_a_lying_person(textured_session, model, poses):
    for window in person_windows(textured_session, model, poses):
        assert window.tile[1] == TILE_HEIGHT and SHAPES[0] - 0.01 < window.tile[0] / window.tile[1] < SHAPES[1] + 0.01


@pytest.mark.parametrize(("count", "width", "columns"), [(1, 640, 1), (2, 300, 2), (3, 300, 3), (4, 300, 4), (4, 640, 2), (8, 300, 4), (9, 640, 3)])
def test_tiles_fill_a_screen(count, width, columns):
    assert columns_of(count, float(width), TILE_HEIGHT) == columns


def test_tiles_of_any_size_make_an_even_grid():
    tiles = [np.zeros((45, width, 3), np.uint8) for width in (61, 80, 53)]
    height, width, _ = grid(tiles).shape
    assert height % 2 == width % 2 == 0
    assert height >= 45 and width >= 80 and all(a.shape[0] == b.shape[0] for a, b in pairwise(tiles))
