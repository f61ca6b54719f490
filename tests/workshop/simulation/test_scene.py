"""The empty scene, the sensor and the segmenter: rays against OpenCV's projection, noise against its formula."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bayes_body.recording.readers.rig import read_rig
from bayes_body.workshop.simulation.scene import Scene
from bayes_body.workshop.simulation.scene_room import Clearance, build_room
from bayes_body.workshop.simulation.scene_texture import SIDE, pink
from bayes_body.workshop.simulation.sensor import DRIFT, READ_NOISE, SHOT_NOISE, Sensor, segment

RIG = read_rig(Path(__file__).parents[3] / "models" / "rigs" / "room_4.toml")
VIEWPOINTS = np.array([-camera.rotation.T @ camera.translation_m for camera in RIG.cameras])
# A person's way: along x through the middle of the room.
WAY = np.stack(np.meshgrid((-1.2, 0.0, 1.2), (-0.3, 0.3), (0.05, 0.9, 1.75)), axis=-1).reshape(-1, 3)


def small(camera, scale=0.5):
    size = tuple(round(scale * side) for side in camera.size_px)
    focal, centre = (tuple(scale * value for value in pair) for pair in (camera.focal_px, camera.centre_px))
    return replace(camera, size_px=size, focal_px=focal, centre_px=centre)


def project(camera, points):
    K = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    turned = cv2.Rodrigues(camera.rotation)[0]
    return cv2.projectPoints(np.asarray(points, float)[:, None], turned, camera.translation_m, K, np.array(camera.distortion))[0][:, 0]


def room(seed=0, clutter=1.0):
    return build_room(np.random.default_rng(seed), Clearance(VIEWPOINTS, WAY), clutter)


def blocked(boxes, start, end):
    """Whether the way from one point to another, taken in small steps, enters a box."""
    steps = start + np.linspace(0, 1, 400)[:, None] * (end - start)
    return any(((steps > low) & (steps < high)).all(axis=1).any() for low, high in boxes)


@pytest.mark.parametrize("seed", range(4))
def test_furniture_stands_in_the_room_and_in_nobodys_way(seed):
    made = room(seed)
    assert len(made.boxes) >= 8
    assert (made.boxes[:, 0] >= made.low).all() and (made.boxes[:, 1] <= made.high + 1e-9).all()
    for start in VIEWPOINTS:
        assert (made.low < start).all() and (start < made.high).all()
        for end in WAY:
            assert not blocked(made.boxes, start, end)
    for number, (low, high) in enumerate(made.boxes):
        assert not any((low < other[1]).all() and (high > other[0]).all() for k, other in enumerate(made.boxes) if k != number)
    # The check above can fail: from wall to wall something is in the way.
    corners = [np.array((x, y, 0.3)) for x in (made.low[0] + 0.1, made.high[0] - 0.1) for y in (made.low[1] + 0.1, made.high[1] - 0.1)]
    assert any(blocked(made.boxes, a, b) for a in corners for b in corners)


def test_the_floor_is_seen_where_its_points_project():
    made = room()
    camera = small(RIG.cameras[0])
    seen = Scene(made).look(camera)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(made.low[:2] + 0.02, made.high[:2] - 0.02, (600, 2)), np.zeros(600)])
    inside = points @ camera.rotation.T + camera.translation_m
    near_axis = np.hypot(*(inside[:, :2] / inside[:, 2:]).T) < 1.0
    pixels = np.rint(project(camera, points)).astype(int)
    shown = (inside[:, 2] > 0.1) & near_axis & (pixels >= 0).all(axis=1) & (pixels < camera.size_px).all(axis=1)
    free = np.array([not blocked(made.boxes, VIEWPOINTS[0], point - (0, 0, -0.01)) for point in points])
    # Within a pixel of an edge it may be one or the other.
    column, row = pixels[shown].T
    assert shown.sum() > 100
    assert (seen.floor[row, column] == free[shown]).mean() > 0.97
    assert not free[shown].all()


def test_textures_lie_where_the_camera_says_through_a_bent_lens():
    """The line where floor and wall meet, found in the picture's floor, is the projected one."""
    bent = replace(small(RIG.cameras[1]), distortion=(-0.25, 0.1, 0.002, -0.001, 0.0), skew=0.0)
    made = room(clutter=0.0)
    floor = Scene(made).look(bent).floor
    along = np.linspace(made.low[1], made.high[1], 400)
    edge = np.column_stack([np.full(400, made.high[0]), along, np.zeros(400)])
    inside = edge @ bent.rotation.T + bent.translation_m
    edge = edge[(inside[:, 2] > 0.5) & (np.abs(inside[:, 0] / inside[:, 2]) < 0.6)]
    pixels = project(bent, edge)
    pixels = pixels[(pixels > 3).all(axis=1) & (pixels < np.array(bent.size_px) - 4).all(axis=1)]
    assert len(pixels) > 50
    first = np.array([np.flatnonzero(floor[:, column])[0] for column in np.rint(pixels[:, 0]).astype(int)])
    assert np.abs(first - 0.5 - pixels[:, 1]).max() < 1.2


@pytest.mark.slow
def test_clutter_is_a_level():
    bare, usual, full = (Scene(room(1, clutter)).look(small(RIG.cameras[2])).picture for clutter in (0.0, 1.0, 2.0))
    # Edges a pixel: none but where walls meet in a bare room.
    edges = [float((np.abs(cv2.Laplacian(picture.mean(axis=2), cv2.CV_32F)) > 12).mean()) for picture in (bare, usual, full)]
    assert edges[0] < 0.02 < 3 * edges[0] + 0.02 < edges[1] < edges[2]
    assert not len(room(1, 0.0).boxes)


def test_a_scene_is_the_same_for_the_same_seed_and_another_for_another():
    first, again, other = (Scene(room(seed)).look(small(RIG.cameras[0], 0.25)).picture for seed in (5, 5, 6))
    assert (first == again).all()
    assert np.abs(first - other).mean() > 5
    assert 40 < first.mean() < 200


def test_pink_noise_falls_as_one_over_frequency_and_tiles():
    field = pink(np.random.default_rng(0), 1.0)
    power = np.abs(np.fft.fft2(field)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE), np.fft.fftfreq(SIDE)))
    low, high = (power[(frequency > f) & (frequency < 1.2 * f)].mean() for f in (0.02, 0.2))
    assert low / high == pytest.approx(100, rel=0.25)
    across = np.abs(field[:, 0] - field[:, -1]).mean()
    assert across < 2 * np.abs(np.diff(field, axis=1)).mean()


@pytest.mark.parametrize("level", [20.0, 90.0, 160.0])
@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_noise_is_what_the_formula_says(level, noise):
    sensor = Sensor((0, 1), 100, 60.0, grey=True, noise=noise)
    picture = np.full((240, 320, 3), level, np.float32)
    read = np.array([sensor.read(picture, frame)[..., 0] for frame in range(8)], float)
    mean = read.mean()
    # Rounding adds a twelfth.
    expected = np.sqrt(noise**2 * (READ_NOISE + SHOT_NOISE * mean) + 1 / 12)
    assert np.mean([each.std() for each in read]) == pytest.approx(expected, rel=0.02)
    # Pixels of one frame, and the same pixel in two frames, know nothing of each other: 4 standard errors.
    residual = (read - read.mean(axis=(1, 2), keepdims=True)) / read.std(axis=(1, 2), keepdims=True)
    pairs = residual[0].size
    assert abs((residual[0, :, 1:] * residual[0, :, :-1]).mean()) < 4 / np.sqrt(pairs)
    assert abs((residual[0] * residual[1]).mean()) < 4 / np.sqrt(pairs)


def test_exposure_drifts_slowly_within_twelve_grey_levels():
    ranges = []
    for key in range(8):
        sensor = Sensor((0, key), 600, 60.0, grey=False, noise=1.0)
        drift = np.array([sensor.drift(frame) for frame in range(600)])
        assert np.abs(drift).max() <= DRIFT
        assert np.abs(np.diff(drift)).max() < 0.25
        ranges.append(np.ptp(drift))
    assert 15 < np.mean(ranges) <= 24
    # A second of a recording hardly drifts.
    short = Sensor((0, 0), 60, 60.0, grey=False, noise=1.0)
    assert np.abs(np.diff([short.drift(frame) for frame in range(60)])).max() < 0.4


def test_without_noise_the_picture_is_only_blurred_and_rounded():
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(20, 230, (60, 80, 3)).astype(np.float32), (0, 0), 3)
    read = Sensor((0, 0), 10, 60.0, grey=False, noise=0.0).read(picture, 3)
    assert read.dtype == np.uint8
    assert np.abs(read - picture).max() < 4
    assert (read == Sensor((9, 9), 10, 60.0, grey=False, noise=0.0).read(picture, 7)).all()
    grey = Sensor((0, 0), 10, 60.0, grey=True, noise=0.0).read(picture, 3)
    assert (grey == grey[..., :1]).all()
    assert np.abs(grey[..., 0] - picture @ (0.114, 0.587, 0.299)).max() < 4


def test_a_sensor_is_the_same_for_the_same_key_in_any_order():
    picture = np.full((40, 50, 3), 128, np.float32)
    forth, back = ([Sensor((3, 1), 20, 60.0, grey=False, noise=1.0).read(picture, frame) for frame in frames] for frames in ((4, -2), (-2, 4)))
    assert (forth[0] == back[1]).all() and (forth[1] == back[0]).all()
    assert (forth[0] != forth[1]).mean() > 0.5
    assert (forth[0] != Sensor((3, 2), 20, 60.0, grey=False, noise=1.0).read(picture, 4)).mean() > 0.5


def figure():
    """A coverage and a shadow: an upright ellipse and one that lies beside it."""
    coverage, shadow = np.zeros((480, 640), np.float32), np.zeros((480, 640), np.float32)
    cv2.ellipse(coverage, (320, 240), (40, 150), 0, 0, 360, 1.0, -1, cv2.LINE_AA)
    cv2.ellipse(shadow, (440, 395), (110, 22), 0, 0, 360, 1.0, -1)
    return coverage, cv2.GaussianBlur(shadow, (0, 0), 5)


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_a_good_segmenter_errs_by_a_pixel_or_two_along_the_outline():
    coverage, shadow = figure()
    true = coverage > 0.5
    outside = cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, 5)
    inside = cv2.distanceTransform(true.astype(np.uint8), cv2.DIST_L2, 5)
    off = []
    for seed in range(4):
        found = segment(np.random.default_rng(seed), "good", coverage, shadow)
        edge = found ^ cv2.erode(found.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        off.append(np.maximum(outside, inside - 1)[edge])
        assert 0.93 < overlap(found, true) < 0.995
    off = np.concatenate(off)
    assert 0.5 < off.mean() < 2
    assert np.percentile(off, 99) < 5


def test_a_poor_segmenter_tears_holes_and_takes_shadow_and_blobs_along():
    coverage, shadow = figure()
    true, dark = coverage > 0.9, (shadow > 0.8) & (coverage == 0)
    found = np.array([segment(np.random.default_rng(seed), "poor", coverage, shadow) for seed in range(12)])
    overlaps = [overlap(each, coverage > 0.5) for each in found]
    assert 0.35 < np.mean(overlaps) < 0.85
    core = cv2.erode(true.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert 0.02 < (~found[:, core]).mean() < 0.3
    assert found[:, dark].mean() > 0.4
    elsewhere = cv2.dilate(((coverage > 0) | (shadow > 0.02)).astype(np.uint8), np.ones((41, 41), np.uint8)) == 0
    assert 0.0005 < found[:, elsewhere].mean() < 0.03
