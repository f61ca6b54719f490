"""Where other people cover an image, and that nothing which reads silhouettes sees anything there."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bayes_body.base.registry import find
from bayes_body.model.likelihood.silhouette_bernoulli import Options as GridOptions
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.evidence.regions import NEUTRAL
from bayes_body.recording.evidence.silhouette_edges import BORDER, EDGES, SILHOUETTE, UNSEEN_SHARE
from bayes_body.recording.observation.covered import ambiguous, beside_body, covered_by
from bayes_body.recording.observation.frames import Frame, near_bodies, read_frame
from bayes_body.recording.readers.keypoints.candidates import Bystanders
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import Segmentation

SIZE = (200, 240)
# Somebody who stands, 200 pixels tall: column and row of keypoints.
STANDING = {
    **{"nose": (100, 32), "l_shoulder": (122, 58), "r_shoulder": (78, 58), "l_elbow": (130, 94), "l_wrist": (132, 122)},
    **{"l_hip": (112, 116), "r_hip": (88, 116), "l_knee": (112, 165), "r_knee": (88, 165), "l_ankle": (112, 212), "r_ankle": (88, 212)},
}


def person(points=STANDING, scale=1.0, confidence=0.9):
    return {name: (scale * column, scale * row, confidence) for name, (column, row) in points.items()}


def test_a_person_covers_limbs_torso_and_head_by_their_size():
    region = covered_by([person()], SIZE)
    assert region.shape == SIZE[::-1] and region.dtype == bool
    for column, row in [*STANDING.values(), (100, 85), (100, 58), (112, 140), (131, 108)]:
        assert region[row, column]
    # Beside the person, between the legs, and where the right arm would be: it is not detected.
    assert not region[:, :55].any() and not region[:, 160:].any() and not region[190, 100] and not region[110, 62]
    twice = covered_by([person(scale=2.0)], (400, 480))
    assert twice.sum() == pytest.approx(4 * region.sum(), rel=0.05)


def test_what_is_no_person_covers_nothing():
    assert covered_by([], SIZE) is None
    assert not covered_by([person(confidence=0.1), {"nose": (50.0, 50.0, 0.9)}], SIZE).any()
    # Damaged coordinates, and a person far outside of the image.
    wild = person({**STANDING, "l_wrist": (np.nan, 3), "l_knee": (1e6, -1e6)})
    assert covered_by([wild], SIZE)[85, 100] and not covered_by([person(scale=50.0)], SIZE).any()


def test_figures_that_a_body_does_not_explain():
    mask, body = np.zeros((2, 120, 200), bool)
    mask[10:40, 10:30] = mask[41:100, 10:30] = True  # One figure with a gap at the waist.
    body[12:98, 12:30] = True
    assert beside_body(mask, body) is None
    # An arm that the body has lost is far from it, and small.
    mask[30:34, 30:90] = True
    assert beside_body(mask, body) is None
    # Somebody larger who stands apart; and one who touches the subject, whose near side may be either's.
    mask[5:110, 120:150] = True
    apart = beside_body(mask, body)
    assert apart[5:110, 120:150].all() and not apart[:, :85].any()
    mask[20:90, 30:60] = True
    touching = beside_body(mask, body)
    assert touching[20:90, 30:60].all() and not touching[:, :25].any()
    # A body that has left the silhouette, or the image, says nothing.
    assert beside_body(mask, np.roll(body, 85, axis=1)) is None and beside_body(mask, np.zeros_like(mask)) is None


def test_keypoints_that_missed_a_part_of_a_person():
    mask = np.zeros((120, 200), bool)
    mask[10:100, 10:30] = mask[10:95, 120:138] = True
    # They missed the head, and cover more than the person does.
    covered = np.zeros_like(mask)
    covered[12:118, 100:158] = True
    hidden = ambiguous(mask, covered)
    assert hidden[10:95, 120:138].all() and not hidden[:, :117].any() and not hidden[:, 141:].any() and not hidden[98:].any()
    # A large figure beside the region is the subject's.
    covered[:] = False
    covered[:, 120:129] = True
    assert np.array_equal(ambiguous(mask, covered)[10:95, 120:138], covered[10:95, 120:138])


def scene(covered):
    """A subject, and somebody whose silhouette touches the subject's: images and masks of two cameras, the second without anybody else."""
    mask = np.zeros((120, 160), bool)
    mask[20:100, 40:60] = True
    both = mask | (covered if covered is not None else False)
    image = cv2.GaussianBlur(np.where(both, 200, 60).astype(np.uint8), (0, 0), 1.0)
    alone = cv2.GaussianBlur(np.where(mask, 200, 60).astype(np.uint8), (0, 0), 1.0)
    return Frame(0, (image, alone), (both, mask), covered=None if covered is None else (covered, None))


def region():
    covered = np.zeros((120, 160), bool)
    covered[30:110, 55:90] = True
    return covered


def observe(kind, frame, likelihood=None, **options):
    term = find("observation", kind)
    return term.build(options=term.options(**options), likelihood=likelihood)(frame)


def image_part(maps, frame):
    rows, columns = frame.images[0].shape
    return np.asarray(maps)[..., BORDER : BORDER + rows, BORDER : BORDER + columns] & 255


@pytest.mark.parametrize("proximity", ["distance", "density"])
def test_maps_of_silhouettes_and_edges_do_not_see_who_covers_the_subject(proximity):
    frame, covered = scene(region()), region()
    term = find("likelihood", "silhouette_edges")
    likelihood = term.options(terms=["silhouette", "edges", "cover"], gamma=1.0, cover_points=40, area_grid=(16, 12))
    maps = observe("silhouette_edges", frame, likelihood, proximity=proximity, covered_error=0.4)
    levels, alone = image_part(maps.errors, frame), image_part(observe("silhouette_edges", scene(None), proximity=proximity).errors, frame)
    assert (levels[0][:, covered] == round(0.4 * 255)).all()
    # Where nothing is covered the subject is as near as before, and the other one, at columns up to 90, is not near at all.
    assert np.array_equal(levels[1], alone[1])
    assert (levels[0][SILHOUETTE][40:90, 44:53] <= 2).all()
    assert (levels[0][SILHOUETTE][30:105, 91:] == 255).all()
    assert levels[0][EDGES][60, 40] < 20
    # Points and area are those of what is seen.
    columns, rows = (maps.points[0] + [80, 60]).T.astype(int)
    assert frame.masks[1][rows, columns].all() and not covered[rows, columns].any()
    assert maps.foreground[0] == pytest.approx((frame.masks[1] & ~covered).sum() / (~covered).sum(), rel=1e-6)
    assert maps.foreground[1] == pytest.approx(frame.masks[1].mean(), rel=1e-6)
    assert maps.uncovered.shape == (2, 12, 16) and maps.uncovered[0].mean() == pytest.approx((~covered).mean(), abs=1e-6)
    assert (maps.uncovered[1] == 1).all()


def test_with_nobody_else_maps_are_as_ever():
    frame = scene(None)
    without = observe("silhouette_edges", frame)
    assert without.uncovered is None
    for kind in ("silhouette_edges", "regions"):
        for one, other in zip(observe(kind, frame), observe(kind, frame._replace(covered=(None, None))), strict=True):
            assert np.array_equal(one, other)
    everything = frame._replace(covered=(np.ones((120, 160), bool), None))
    maps = observe("silhouette_edges", everything, unseen_error=0.4)
    assert maps.foreground[0] == UNSEEN_SHARE and (image_part(maps.errors, frame)[0] == round(0.4 * 255)).all()


def test_regions_and_pixels_do_not_see_who_covers_the_subject():
    frame, covered = scene(region()), region()
    levels = image_part(observe("regions", frame).log_ratios, frame)
    assert (levels[0][:, covered] == round(NEUTRAL * 255)).all()
    assert (levels[0][0][40:90, 45:53] > 150).all() and (levels[0][0][30:105, 95:] < 100).all()
    pixels = observe("silhouette_bernoulli", frame, GridOptions(grid=(32, 24)))
    assert pixels.uncovered[1].all() and pixels.uncovered.shape == pixels.foreground.shape
    assert np.array_equal(pixels.uncovered[0], ~covered[2::5, 2::5])
    assert observe("silhouette_bernoulli", scene(None)).uncovered is None


@pytest.fixture(scope="module")
def recording(tmp_path_factory, textured_session):
    """A session of masks and keypoint files in which the first camera sees another person in its second frame."""
    folder = tmp_path_factory.mktemp("crowd")
    view = textured_session.views[0]
    width, height = view.camera.size_px
    mask = np.zeros((height, width), bool)
    mask[: height // 2, : width // 8] = mask[: height // 4, -width // 8 :] = True
    mask[height // 3 : height // 2, width // 2 - 10 : width // 2 + 10] = True  # The other person's torso.
    image = np.random.default_rng(0).integers(60, 120, (height, width), np.uint8)
    for frame in range(2):
        cv2.imwrite(str(folder / f"{frame}.png"), image)
        cv2.imwrite(str(folder / f"m{frame}.png"), np.uint8(255) * mask)
    points = np.full((1, len(MARKERS), 3), np.nan, np.float32)
    for name, (column, row) in STANDING.items():
        if name in MARKERS:
            points[0, MARKERS.index(name)] = column * width / 200, row * height / 240, 0.9
    others = Bystanders(points, np.array([0, 1]))
    write_series(folder / "crowd.npz", KeypointSeries(np.full((2, len(MARKERS), 3), np.nan, np.float32), MARKERS, 0, None, others))
    views = (replace(view, images="%d.png", masks="m%d.png", keypoints="crowd.npz"),)
    return replace(textured_session, folder=folder, views=views, frames=2), mask


def test_frames_of_a_recording_with_other_people(recording):
    session, mask = recording
    height, width = mask.shape
    first, second = (read_frame(session, index) for index in range(2))
    assert first.covered is not None and first.covered[0] is None
    assert second.covered[0].shape == mask.shape and second.covered[0][height // 3 : height // 2, width // 2 - 10 : width // 2 + 10].all()
    assert not second.covered[0][: height // 4].any()
    assert second.covered[0] is second.covered[0]
    alone = replace(session, views=(replace(session.views[0], keypoints=None),))
    assert read_frame(alone, 0).covered is None
    near_body = replace(alone, segmentation=Segmentation(figures="near_body"))
    frame, body = read_frame(near_body, 0), np.zeros_like(mask)
    assert list(frame.covered) == [None]
    body[: height // 2, : width // 8] = True
    (hidden,) = near_bodies(frame, [body]).covered
    assert hidden[: height // 4, -width // 8 :].all() and not hidden[:, : width // 8].any()
    # What keypoints show is hidden too.
    assert not (second.covered[0] & ~near_bodies(second, [body]).covered[0]).any()
    assert load_session(save_session(near_body)).segmentation.figures == "near_body"
