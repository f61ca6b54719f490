"""What is made of an image and a silhouette before a likelihood looks at them."""

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.recording.evidence.silhouette_edges import BORDER, EDGES, SILHOUETTE, UNSEEN_SHARE
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.observation.silhouette_edges import edge_proximity, edges, smooth_silhouette


def step_image(height: float, shape=(40, 60), column=30) -> np.ndarray:
    image = np.full(shape, 50, np.uint8)
    image[:, column:] = 50 + height
    return image


def observe(frame: Frame, **options):
    term = find("observation", "silhouette_edges")
    return term.build(options=term.options(**options))(frame)


def test_edge_proximity_is_one_at_an_edge_and_falls_off():
    proximity = edge_proximity(step_image(150), 20.0, 3.0)
    assert proximity.min() >= 0
    assert proximity.max() == 1
    # The edge lies between columns 29 and 30, in every row.
    np.testing.assert_allclose(proximity[:, 29:31], 1, atol=1e-6)
    row = proximity[20]
    assert np.all(np.diff(row[:30]) >= 0)
    assert np.all(np.diff(row[30:]) <= 0)
    assert row[30 + 15] == row[5] == 0


def test_edge_proximity_falls_as_the_gaussian():
    # Two columns of edge pixels, smoothed with sd s: proportional to the sum of two Gaussians, up to where OpenCV cuts its kernel off.
    s = 4.0
    row = edge_proximity(step_image(150, (60, 120), 60), 20.0, s)[30]
    x = np.arange(120)
    expected = np.exp(-((x - 59) ** 2) / (2 * s**2)) + np.exp(-((x - 60) ** 2) / (2 * s**2))
    np.testing.assert_allclose(row[48:72], (expected / expected.max())[48:72], atol=5e-3)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_a_constant_image_has_no_edge(value):
    assert not edge_proximity(np.full((30, 40), value, np.uint8), 20.0, 3.0).any()


def test_the_threshold_is_grey_levels_a_pixel():
    # Central differences of a step see half of it at either side.
    assert not edge_proximity(step_image(38), 20.0, 3.0).any()
    assert edge_proximity(step_image(42), 20.0, 3.0).max() == 1
    ramp = np.tile(np.arange(0, 240, 6, dtype=np.uint8), (30, 1))
    assert not edge_proximity(ramp, 6.5, 1.0).any()
    assert edge_proximity(ramp, 5.5, 1.0)[5:-5, 5:-5].min() > 0.9


def test_the_area_is_that_of_all_or_of_the_largest_figure():
    mask = np.zeros((120, 200), bool)
    mask[10:40, 10:30] = mask[41:100, 10:30] = True  # One figure with a gap at the waist.
    mask[10:95, 120:138] = True
    image = np.full(mask.shape, 100, np.uint8)
    frame = Frame(0, (image,), (mask,))
    assert observe(frame).foreground == pytest.approx(mask.mean())
    assert observe(frame, area_of="largest").foreground == pytest.approx(20 * 89 / mask.size)
    empty = Frame(0, (image,), (np.zeros_like(mask),))
    assert observe(empty, area_of="largest").foreground == 0


def test_smoothing_keeps_a_silhouettes_mass():
    mask = np.zeros((80, 100), bool)
    mask[30:50, 40:52] = True
    smooth = smooth_silhouette(mask, 2.0)
    assert smooth.sum() == pytest.approx(mask.sum(), rel=1e-5)
    assert smooth.min() >= 0
    assert smooth.max() <= 1 + 1e-6
    assert smooth[40, 46] == pytest.approx(1, abs=1e-2)
    assert smooth[40, 39] == pytest.approx(0.5, abs=0.15)


def test_maps_are_the_squared_errors_within_their_border():
    rng = np.random.default_rng(2)
    shapes = ((20, 30), (24, 26))
    images = tuple(rng.integers(0, 256, shape).astype(np.uint8) for shape in shapes)
    masks = tuple(rng.random(shape) < 0.3 for shape in shapes)
    maps = observe(Frame(0, images, masks), unseen_error=1.0, silhouette_smooth_px=1.0, edge_threshold=10.0, edge_smooth_px=2.0)
    assert maps.errors.shape == (2, 2, 24 + 2 * BORDER, 30 + 2 * BORDER)
    np.testing.assert_allclose(maps.foreground, [mask.mean() for mask in masks], rtol=1e-6)
    for c, (rows, columns) in enumerate(shapes):
        inner = np.s_[BORDER : BORDER + rows, BORDER : BORDER + columns]
        expected = {SILHOUETTE: smooth_silhouette(masks[c], 1.0), EDGES: edge_proximity(images[c], 10.0, 2.0)}
        for which, value in expected.items():
            found = (np.asarray(maps.errors)[c, which] & 255) / 255
            np.testing.assert_allclose(found[inner], (1 - value) ** 2, atol=0.51 / 255)
            outside = np.ones_like(found, bool)
            outside[inner] = False
            assert np.all(found[outside] == 1)


def test_maps_by_distance_are_a_gaussian_of_it():
    rng = np.random.default_rng(5)
    image = rng.integers(100, 120, (40, 50)).astype(np.uint8)
    image[10:30, 18] = 250
    image[5, 2:9] = 250
    mask = np.zeros((40, 50), bool)
    mask[8:32, 14:24] = True
    maps = observe(Frame(0, (image,), (mask,)), proximity="distance", silhouette_smooth_px=3.0, edge_smooth_px=2.0, edges_within_px=4.0)
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    silhouette, edge = ((np.asarray(maps.errors)[0, which][inner] & 255) / 255 for which in (SILHOUETTE, EDGES))
    # OpenCV's distance is exact to a twentieth.
    outside = nearest(mask)
    np.testing.assert_allclose(silhouette, (1 - np.exp(-0.5 * (outside / 3) ** 2)) ** 2, atol=0.03)
    assert (silhouette[mask] == 0).all()
    # The line at the top left is the room's.
    own = edges(image, 20.0) & (outside <= 4)
    assert own.sum() < edges(image, 20.0).sum()
    np.testing.assert_allclose(edge, (1 - np.exp(-0.5 * (nearest(own) / 2) ** 2)) ** 2, atol=0.03)


def nearest(marked: np.ndarray) -> np.ndarray:
    """Distance of each pixel to the nearest that is marked."""
    here, there = np.argwhere(np.ones_like(marked)), np.argwhere(marked)
    return np.sqrt(((here[:, None] - there) ** 2).sum(axis=-1).min(axis=1)).reshape(marked.shape)


def test_by_distance_nothing_is_near_where_there_is_nothing():
    image, mask = np.full((20, 30), 90, np.uint8), np.zeros((20, 30), bool)
    maps = observe(Frame(0, (image,), (mask,)), proximity="distance")
    assert ((np.asarray(maps.errors)[0, :, BORDER:-BORDER, BORDER:-BORDER] & 255) == 255).all()


def test_the_real_silhouette_is_a_small_part_of_each_image(bodytrack, tmp_path):
    from bayes_body.recording.observation.frames import read_frame
    from bayes_body.recording.readers.parsec import import_parsec

    session, _ = import_parsec(bodytrack, tmp_path)
    maps = observe(read_frame(session, 0))
    assert np.all((maps.foreground > 0.01) & (maps.foreground < 0.3))
    silhouettes = (np.asarray(maps.errors)[:, SILHOUETTE] & 255) / 255
    assert np.all(silhouettes.mean(axis=(1, 2)) > 0.6)


def test_a_camera_that_did_not_see_says_the_same_everywhere():
    rng = np.random.default_rng(6)
    image, mask = rng.integers(0, 256, (20, 30)).astype(np.uint8), rng.random((20, 30)) < 0.3
    sizes = ((30, 20), (26, 24), (30, 20))
    maps = observe(Frame(0, (image, None, image), (mask, None, None), sizes_px=sizes), unseen_error=0.4)
    whole = observe(Frame(0, (image,) * 3, (mask,) * 3, sizes_px=sizes), unseen_error=0.4)
    assert maps.errors.shape == whole.errors.shape == (3, 2, 24 + 2 * BORDER, 30 + 2 * BORDER)
    np.testing.assert_array_equal(maps.errors[0], whole.errors[0])
    assert maps.foreground[0] == whole.foreground[0]
    for camera in (1, 2):
        assert (np.asarray(maps.errors[camera]).view(np.uint8) == round(0.4 * 255)).all()
        assert maps.foreground[camera] == UNSEEN_SHARE


def test_a_session_without_masks():
    with pytest.raises(InputError) as error:
        observe(Frame(0, (np.zeros((4, 5), np.uint8),), None))
    assert str(error.value) == (
        "session.toml: its cameras have no masks, and there are too few frames to learn the background; expected a silhouette for every image; "
        "give each [[camera]] its `masks`, or an image of the empty scene as `background`."
    )
