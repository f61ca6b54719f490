"""The simulator's own camera and rasteriser: against OpenCV's projection, exact areas, no cracks, the right way round, nothing from behind."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from workshop.simulation.walker import FPS, walker

from bayes_body.recording.readers.mocap import landmarks, read_motion, resample
from bayes_body.recording.session.session import CameraSpec
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.raster import Light, facing, normals, rasterise
from bayes_body.workshop.simulation.raster_shadow import shadow, shadow_mask
from bayes_body.workshop.simulation.raster_spans import project, spans
from bayes_body.workshop.simulation.surface import ANGLES, Mesh

WALK = walker(30)
SIZE = (320, 240)
GREY = np.full((SIZE[1], SIZE[0], 3), 90.0, np.float32)
EMPTY = np.zeros((640, 480, 3), np.float32)
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def camera(place, aim, size=SIZE, focal=300.0, distortion=(0.0, 0.0, 0.0, 0.0, 0.0), skew=0.0):
    """A camera at a place that looks at another, z up."""
    ahead = np.array(aim, float) - place
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return CameraSpec("one", size, (focal, 1.01 * focal), centre, skew, distortion, rotation, -rotation @ np.array(place, float))


IN_FRONT = camera((4.0, 0.3, 1.2), (0.3, 0.0, 0.95))


@pytest.fixture(scope="module")
def mesh():
    return build_person(3, 1.75).mesh(WALK, 12)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.28, 0.11, 0.002, -0.0015, -0.02), (0.12, -0.05, -0.001, 0.003, 0.01)])
def test_projection_is_opencvs(mesh, distortion):
    spec = camera((2.2, 1.1, 1.7), (0.3, 0.0, 0.9), distortion=distortion)
    pixels, depth, visible = project(mesh.vertices, spec)
    matrix = np.array([[spec.focal_px[0], 0, spec.centre_px[0]], [0, spec.focal_px[1], spec.centre_px[1]], [0, 0, 1]])
    wanted = cv2.projectPoints(mesh.vertices, cv2.Rodrigues(spec.rotation)[0], spec.translation_m, matrix, np.array(distortion))[0][:, 0]
    assert visible.all() and (depth > 0.5).all()
    np.testing.assert_allclose(pixels, wanted, atol=1e-3)


def test_skew_shears_the_columns():
    points = np.array([[0.3, 0.2, 1.3], [0.1, -0.3, 0.4]])
    plain, skewed = (project(points, camera((4, 0, 1), (0, 0, 1), skew=skew)) for skew in (0.0, 0.02))
    rows = (plain[0][:, 1] - IN_FRONT.centre_px[1]) / IN_FRONT.focal_px[1]
    np.testing.assert_allclose(skewed[0][:, 0] - plain[0][:, 0], 0.02 * 300.0 * rows, atol=1e-9)


def test_what_lies_behind_or_beyond_the_polynomial_is_unseen():
    """With k1 = -0.3 the radius folds back at a slope of 1.05: a point at 1.5 would land inside the picture."""
    spec = camera((0, 0, 1), (1, 0, 1), distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    points = np.array([[1.0, 0.2, 1.0], [-1.0, 0.2, 1.0], [0.05, 0.0, 1.0], [1.0, 1.5, 1.0]])
    pixels, _, visible = project(points, spec)
    np.testing.assert_array_equal(visible, [True, False, False, False])
    assert np.isfinite(pixels).all()


def _board(low, high, depth):
    """A square that faces a camera at the origin, which looks along x."""
    corners = np.array([[depth, high, low], [depth, low, low], [depth, low, high], [depth, high, high]], float)
    return corners + np.array([0.0, 0.0, 1.0])


def test_a_square_covers_its_area():
    """Sides of 62.5 and 63.1 pixels, in the picture's middle: where samples stand shows in the mean of what they cover."""
    spec = camera((0, 0, 1), (1, 0, 1), focal=250.0)
    board = Mesh(_board(-0.25, 0.25, 2.0), SQUARE, np.full((2, 3), 0.5))
    wanted = (0.5 / 2.0) ** 2 * spec.focal_px[0] * spec.focal_px[1]
    for count, share in ((1, 0.03), (4, 0.01)):
        alpha = rasterise(board, spec, GREY, supersample=count)[1]
        assert abs(alpha.sum() / wanted - 1) < share
    rows, columns = np.indices(alpha.shape)
    middle = [(alpha * place).sum() / alpha.sum() for place in (columns, rows)]
    np.testing.assert_allclose(middle, spec.centre_px, atol=0.13)
    assert rasterise(board._replace(faces=SQUARE[:, ::-1]), spec, GREY)[1].sum() == 0


def test_the_nearer_one_is_seen_where_two_cross():
    """Two boards that pass through each other, as no order of whole triangles shows: the left half is one's, the right half the other's."""
    spec = camera((0, 0, 1), (1, 0, 1))
    flat = _board(-0.4, 0.4, 2.0)
    tilted = [flat + np.stack([slope * flat[:, 1], 0 * flat[:, 1], 0 * flat[:, 1]], axis=1) for slope in (0.5, -0.5)]
    colours = np.repeat(np.array([[0.9, 0.0, 0.0], [0.0, 0.0, 0.9]]), 2, axis=0)
    both = Mesh(np.concatenate(tilted), np.concatenate([SQUARE, SQUARE + 4]), colours)
    picture, alpha = rasterise(both, spec, np.zeros_like(GREY), Light(ambient=1.0, lamp=0.0))
    left, right = (picture[100:140, columns] for columns in (slice(120, 155), slice(165, 200)))
    assert (alpha[100:140, 120:200] == 1).all()
    # The image's left is +y, where the board of negative slope is nearer.
    assert left[..., 2].min() > 200 and left[..., 0].max() == 0 and right[..., 0].min() > 200 and right[..., 2].max() == 0


def test_neighbours_leave_no_crack_and_overlap_nowhere():
    """A fan of random triangles owns each sample of its polygon once."""
    random = np.random.default_rng(1)
    angles = np.sort(random.uniform(0, 2 * np.pi, 40))
    rim = np.stack([np.cos(angles), np.sin(angles)], axis=1) * random.uniform(60, 90, (40, 1)) + 100
    hub = random.uniform(95, 105, 2)
    fan = np.stack([np.broadcast_to(hub, rim.shape), rim, np.roll(rim, -1, axis=0)], axis=1)
    times = np.zeros((200, 200), int)
    covered = spans(fan, (200, 200))
    for row, start, length in zip(covered.row, covered.start, covered.length, strict=True):
        times[row, start : start + length] += 1
    outline = [cv2.pointPolygonTest(rim.astype(np.float32), (float(x), float(y)), True) for y in range(200) for x in range(200)]
    inside = np.array(outline).reshape(200, 200)
    assert (times[inside > 1e-3] == 1).all() and (times[inside < -1e-3] == 0).all()


def _holes(alpha):
    """Pixels that filling the outline would add, and how many outlines there are."""
    contours, _ = cv2.findContours((alpha > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(alpha.shape, np.uint8), contours, -1, 1, cv2.FILLED)
    return int((filled - (alpha > 0)).sum()), len(contours)


def _by_tube(person, mesh):
    """Each tube's own triangles: a single limb has no gaps to see through, as two have between them."""
    first = 0
    for tube in person.tubes:
        last = first + len(tube.stations) * ANGLES
        yield tube.name, mesh._replace(faces=mesh.faces[((mesh.faces >= first) & (mesh.faces < last)).sum(axis=1) >= 2])
        first = last


@pytest.mark.parametrize("azimuth", [0, 80, 170, 260])
def test_the_outline_has_no_holes(azimuth):
    """Seen at one sample a pixel, where a crack would show."""
    angle = np.radians(azimuth)
    for seed, frame in ((1, 3), (2, 18)):
        person = build_person(seed, 1.75)
        body = person.mesh(WALK, frame)
        middle = np.array([WALK["pelvis"][frame, 0], 0.0, 0.9])
        spec = camera(middle + 2.6 * np.array([np.cos(angle), np.sin(angle), 0.2]), middle, (480, 640), 700.0)
        for name, tube in _by_tube(person, body):
            assert _holes(rasterise(tube, spec, EMPTY, supersample=1)[1]) == (0, 1), name
        whole = rasterise(body, spec, EMPTY, supersample=1)[1]
        holes, outlines = _holes(whole)
        assert outlines == 1 and holes < 0.03 * whole.sum()


def test_a_captured_walk_has_no_holes(data_dir):
    motion = landmarks(resample(read_motion(data_dir("cmu_mocap") / "06" / "06_01.amc"), FPS))
    person = build_person(1, 1.75)
    performance = person.perform(motion)
    for frame in range(0, 240, 60):
        middle = motion["pelvis"][frame] * [1, 1, 0] + [0, 0, 0.9]
        spec = camera(middle + np.array([2.0, 2.0, 0.8]), middle, (480, 640), 700.0)
        for name, tube in _by_tube(person, performance.mesh(frame)):
            assert _holes(rasterise(tube, spec, EMPTY, supersample=1)[1]) == (0, 1), (frame, name)


def test_left_is_left(mesh):
    """The person walks along x and faces the camera: the left arm is on the image's right, higher up means a smaller row."""
    columns, rows = (project(np.stack([WALK[name][12] for name in ("l_wrist", "r_wrist", "head")]), IN_FRONT)[0][:, axis] for axis in (0, 1))
    assert columns[0] > columns[1] + 10 and rows[2] < rows[:2].min()
    tubes = dict(_by_tube(build_person(3, 1.75), mesh))
    left, right = (np.nonzero(rasterise(tubes[name], IN_FRONT, GREY)[1])[1].mean() for name in ("l_arm", "r_arm"))
    assert left > right + 15


def test_the_picture_is_laid_over_what_is_behind(mesh):
    picture, alpha = rasterise(mesh, IN_FRONT, GREY)
    assert picture.dtype == alpha.dtype == np.float32 and picture.shape == GREY.shape and (GREY == 90).all()
    np.testing.assert_array_equal(picture[alpha == 0], 90.0)
    assert picture.min() > 0 and picture.max() <= 255 and np.abs(picture[alpha == 1] - 90).mean() > 15
    edge = (alpha > 0) & (alpha < 1)
    assert 0.02 < edge.sum() / alpha.sum() < 0.4 and set(np.unique(alpha)) == {0.0, 0.25, 0.5, 0.75, 1.0}


def test_more_samples_change_the_coverage_only_at_the_edge(mesh):
    coarse, fine = (rasterise(mesh, IN_FRONT, GREY, supersample=count)[1] for count in (2, 6))
    assert abs(coarse.sum() / fine.sum() - 1) < 0.005 and np.abs(coarse - fine).max() < 0.55


def test_light_comes_from_the_lamp(mesh):
    """Lit from the image's left, the person's right side is brighter; the normals point outwards."""
    plain = mesh._replace(colours=np.full_like(mesh.colours, 0.5))
    left, right = (rasterise(plain, IN_FRONT, GREY, Light((0.0, side, 0.2), 0.3, 0.7)) for side in (-1.0, 1.0))
    columns = np.nonzero(left[1] == 1)[1]
    difference = (left[0] - right[0])[..., 0][left[1] == 1]
    assert np.corrcoef(columns, difference)[0, 1] < -0.4
    middle = np.array([WALK["head"][12, 0], 0.0, WALK["head"][12, 2] - 0.1])
    head = np.linalg.norm(mesh.vertices - middle, axis=1) < 0.12
    outwards = np.sum(normals(mesh)[head] * (mesh.vertices[head] - middle), axis=1)
    assert (outwards > 0).mean() > 0.95


def test_nothing_comes_from_behind_the_camera(mesh):
    behind = camera((-3.0, 0.0, 1.2), (-6.0, 0.0, 1.0))
    picture, alpha = rasterise(mesh, behind, GREY)
    assert alpha.sum() == 0 and (picture == GREY).all()
    beside = camera((0.3, 3.0, 1.2), (5.0, 3.0, 1.0))
    assert rasterise(mesh, beside, GREY)[1].sum() == 0


def test_what_touches_the_picture_but_no_sample_is_not_drawn(mesh):
    spec = camera((0, 0, 1), (1, 0, 1))
    between = Mesh(_board(-0.001, 0.001, 2.0), SQUARE, np.full((2, 3), 0.5))
    # The column farthest to the left is beyond the last sample, at the picture's right edge: inside the window's margin.
    columns = facing(mesh, IN_FRONT).corners[..., 0]
    left, top = IN_FRONT.centre_px
    aside = replace(IN_FRONT, centre_px=(left + IN_FRONT.size_px[0] - 0.4 - columns.min(), top))
    for body, seen_by in ((between, spec), (mesh, aside)):
        assert facing(body, seen_by).number.size
        picture, alpha = rasterise(body, seen_by, GREY)
        assert alpha.sum() == 0 and (picture == GREY).all()


@pytest.mark.parametrize("place", [(0.25, 0.05, 1.2), (0.6, 0.1, 1.3), (0.25, 0.3, 0.3)])
def test_a_camera_amid_the_person_sees_no_garbage(mesh, place):
    """Partly behind the camera and far out of the picture: finite, and no triangle that reaches behind is drawn."""
    spec = camera(place, (0.3, -2.0, 1.0), distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))
    picture, alpha = rasterise(mesh, spec, GREY)
    assert np.isfinite(picture).all() and alpha.min() >= 0 and alpha.max() <= 1 and picture.max() <= 255
    seen = facing(mesh, spec)
    assert (seen.depth > 0.1).all() and np.isfinite(seen.corners).all()


def test_half_out_of_the_picture_is_the_picture_cut(mesh):
    whole = camera((4.0, 0.3, 1.2), (0.3, 0.0, 0.95), size=(320, 240))
    cut = CameraSpec("cut", (150, 130), whole.focal_px, whole.centre_px, 0.0, whole.distortion, whole.rotation, whole.translation_m)
    small, full = rasterise(mesh, cut, GREY[:130, :150]), rasterise(mesh, whole, GREY)
    np.testing.assert_array_equal(small[1], full[1][:130, :150])
    np.testing.assert_allclose(small[0], full[0][:130, :150], atol=0.1)


def test_the_shadow_lies_on_the_floor_away_from_the_lamp(mesh):
    flat = shadow(mesh, (-1.0, 0.0, 1.0))
    assert np.ptp(flat.vertices[:, 2]) == 0
    crown = np.argmax(mesh.vertices[:, 2])
    assert flat.vertices[crown, 0] == pytest.approx(mesh.vertices[crown, 0] + mesh.vertices[crown, 2])
    mask = shadow_mask(mesh, IN_FRONT, (-1.0, 0.0, 1.0), 4.0)
    assert mask.shape == GREY.shape[:2] and mask.dtype == np.float32 and mask.min() >= 0 and 0.9 < mask.max() <= 1
    wanted = rasterise(flat._replace(faces=flat.faces), IN_FRONT, GREY, supersample=4)[1]
    overlap = np.minimum(mask > 0.5, wanted > 0.5).sum() / np.maximum(mask > 0.5, wanted > 0.5).sum()
    assert overlap > 0.8


def test_a_lamp_at_the_horizon_throws_no_endless_shadow(mesh):
    assert np.abs(shadow(mesh, (1.0, 0.0, 0.0)).vertices).max() < 15
