"""The posterior predictive check: figures that have closed forms, and no recording but that from which the run was made."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.model.build import build_model
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.results.metrics.fit import projected_masks
from bayes_body.results.posterior import markers
from bayes_body.results.storage.manifest import input_digests
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.report.figures import style
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.predicted_silhouettes import silhouette_check, silhouette_likelihood
from bayes_body.view.report.prediction import prediction_section
from bayes_body.view.report.predictive import expected_keypoints, keypoint_check, keypoint_likelihood

DOFS = ("shoulder_x", "shoulder_y", "shoulder_z", "elbow")
POSE = np.full(4, -0.3, np.float32)
KEY = jax.random.key(3)
SD = 2.0


@pytest.fixture(scope="module")
def detections(keypoint_session):
    """Gaussian noise of SD pixels in both cameras."""
    found = keypoint_likelihood(build_model("arm_markers", keypoint_session)).markers.detections
    return dataclasses.replace(found, sd_px=np.full(2, SD, np.float32))


@pytest.fixture(scope="module")
def places():
    """400 points in front of both cameras, metres."""
    return np.random.default_rng(0).uniform((-0.5, -0.5, 0.8), (0.5, 0.5, 1.6), (400, 3)).astype(np.float32)


def expected_pixels(detections, draws):
    return np.asarray(jax.vmap(detections.expected)(jnp.asarray(draws)))


def seen_at(pixels, confidence=1.0):
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), confidence)], axis=-1)


def test_a_right_model_has_nine_of_ten_coordinates_inside_and_a_shifted_body_has_not(detections, places):
    """The truth is one more draw of the pose, and is seen with noise of NumPy."""
    rng = np.random.default_rng(1)
    draws = places + 0.02 * rng.normal(size=(60, *places.shape)).astype(np.float32)
    true = expected_pixels(detections, (places + 0.02 * rng.normal(size=places.shape)).astype(np.float32)[None])[0]
    noisy = true + SD * rng.normal(size=true.shape)
    right = keypoint_check(detections, expected_pixels(detections, draws), seen_at(noisy), KEY)
    # Four standard errors of 1600 coordinates.
    assert abs(right.inside.mean() - 0.9) < 4 * np.sqrt(0.09 / right.inside.size / 2)
    np.testing.assert_allclose(right.expected, np.percentile(right.error, (50, 90), axis=1).T, rtol=0.2)
    shifted = keypoint_check(detections, expected_pixels(detections, draws), seen_at(noisy + np.array([50.0, 0.0])), KEY)
    # All rows are where they were, and no column is.
    assert abs(np.median(shifted.error) - 50) < 1 and abs(shifted.inside.mean() - 0.45) < 0.03


@pytest.mark.parametrize("noise", ["gaussian", pytest.param("student", marks=pytest.mark.slow)])
def test_the_errors_of_predicted_keypoints_are_those_of_the_noise(detections, places, noise):
    """P(error > r) is exp(-r² / 2σ²), or for Student's t (1 + r² / νσ²)^(-ν/2)."""
    nu, rest = 4.0, np.array([0.5, 0.1])
    sure = {"gaussian": SD * np.sqrt(-2 * np.log(rest)), "student": SD * np.sqrt(nu * (rest ** (-2 / nu) - 1))}[noise]
    detections = dataclasses.replace(detections, noise=noise, degrees_of_freedom=np.float32(nu))
    still = np.tile(places, (20, 1, 1))
    seen = seen_at(expected_pixels(detections, still)[0] + [3.0, 4.0])
    found = keypoint_check(detections, expected_pixels(detections, still), seen, KEY)
    np.testing.assert_allclose(found.error, 5.0, atol=1e-3)
    np.testing.assert_allclose(found.expected, [sure, sure], rtol=0.05)
    # With a quarter of the confidence, the noise is four times as wide; what is not seen has no figures.
    seen[..., 2], seen[0, 0, 2], seen[1, :, 2] = 0.25, 0.0, 0.0
    unsure = dataclasses.replace(detections, by_confidence=1.0, least_confidence=np.float32(0.1))
    found = keypoint_check(unsure, expected_pixels(unsure, still), seen, KEY)
    np.testing.assert_allclose(found.expected[0], 4 * sure, rtol=0.05)
    assert np.isnan(found.error[0, 0]) and np.isfinite(found.inside[0, 1:]).all() and np.isnan(found.expected[1]).all()


def test_a_draw_predicts_with_the_cameras_that_it_has(keypoint_session):
    model = build_model("keypoints", keypoint_session)
    states = {name: np.tile(value, (2, 1)) for name, value in model.initial.items()}
    turned = model.unknowns[1].space.labels.index("b_turn_z")
    states["cameras"][1, turned] += 0.01
    still, moved = expected_keypoints(keypoint_likelihood(model), states)
    np.testing.assert_allclose(moved[0], still[0], atol=1e-3)
    centre = np.array(keypoint_session.views[1].camera.centre_px)
    # Turned about the optical axis: each pixel moves by a hundredth of its distance from the centre, but for the lens's distortion.
    np.testing.assert_allclose(np.linalg.norm(moved[1] - still[1], axis=-1), 0.01 * np.linalg.norm(still[1] - centre, axis=-1), atol=0.1)


def test_silhouettes_have_their_overlap_and_area(textured_session):
    model, pose = build_model("darby_2008", textured_session), np.zeros(31, np.float32)
    masks = projected_masks(model, pose, textured_session)
    half = masks[0].copy()
    half[:, : int(np.nonzero(half)[1].mean())] = False
    found = silhouette_check(model, textured_session, frame_of([half, masks[1]]), {"pose": np.tile(pose, (3, 1))}, KEY)
    share = half.sum() / masks[0].sum()
    np.testing.assert_allclose(found.overlap, [[share] * 3, [1.0] * 3])
    np.testing.assert_allclose(found.area, [[1 / share - 1] * 3, [0.0] * 3])
    assert np.isnan(found.expected_overlap).all() and np.isnan(found.expected_area).all()
    assert np.isnan(silhouette_check(model, textured_session, frame_of([None, 0 * half]), {"pose": np.tile(pose, (3, 1))}, KEY).overlap).all()


def frame_of(masks) -> Frame:
    return Frame(0, (np.zeros((2, 2), np.uint8),) * len(masks), masks)


@pytest.mark.slow
def test_silhouettes_that_the_likelihood_draws_are_in_its_band(textured_session):
    model, poses = build_model("arm_silhouette", textured_session), np.tile(POSE, (40, 1))
    likelihood, inside = silhouette_likelihood(model).likelihood, []
    draw = jax.jit(lambda key: likelihood.draw(key, jnp.asarray(POSE)))
    # On its own grid, a silhouette is read as it is.
    whole = [np.array(view.camera.size_px[::-1]) for view in textured_session.views]
    for seed in range(6):
        grids = np.asarray(draw(jax.random.key(seed)))
        masks = [
            cv2.resize(grid.astype(np.uint8), size[::-1].tolist(), interpolation=cv2.INTER_NEAREST) > 0
            for grid, size in zip(grids, whole, strict=True)
        ]
        found = silhouette_check(model, textured_session, frame_of(masks), {"pose": poses}, KEY)
        for values, ends in ((found.overlap, found.expected_overlap), (found.area, found.expected_area)):
            inside += list((ends[:, 0] <= values[:, 0]) & (values[:, 0] <= ends[:, 1]))
    assert np.mean(inside) > 0.7
    # If 0.3 of the pixels inside are missed, the seen area is 0.7 of the body's.
    sharp = dataclasses.replace(likelihood, false_alarm=np.float32(1e-6), soft_px=np.float32(0.01))
    areas = []
    for miss in (1e-6, 0.3):
        drawn = dataclasses.replace(sharp, miss=np.float32(miss))
        factors = tuple(dataclasses.replace(each, log_potential=drawn) if each.log_potential is likelihood else each for each in model.factors)
        areas.append(
            silhouette_check(dataclasses.replace(model, factors=factors), textured_session, frame_of(masks), {"pose": poses}, KEY).expected_area
        )
    np.testing.assert_allclose((1 + areas[1].mean(axis=1)) / (1 + areas[0].mean(axis=1)), 1 / 0.7, rtol=0.1)


@pytest.fixture
def looked_at(inspect, parse, keypoint_session):
    """`looked_at(model, write)`: the section on a run whose draws are all at POSE, before and after its files were changed by `write(session)`."""

    def call(model, change, **arrays):
        it = inspect(dofs=DOFS, units=("rad",) * 4, pose=np.tile(POSE, (2, 60, 5, 1)), recording=keypoint_session, model=model, **arrays)
        change(it.run.session, it.run.model)
        with style(), load_run(it.run.folder) as run:
            strange = parse(prediction_section(it))
            run.inputs.update(input_digests(it.run.session))
            seen = []
            known = Inspection(run, watch=lambda frames: seen.extend(frames) or frames)
            return strange, parse(prediction_section(known)), known.prediction, seen

    return call


def test_keypoints_50_px_beside_the_body_are_shown_as_such(looked_at):
    def beside(session, model):
        points = markers(model, POSE[None])[0]
        for view, off in zip(session.views, (0.0, 50.0), strict=True):
            lens, turned = np.array(view.camera.distortion), cv2.Rodrigues(view.camera.rotation)[0]
            inner = np.array(
                [[view.camera.focal_px[0], 0, view.camera.centre_px[0]], [0, view.camera.focal_px[1], view.camera.centre_px[1]], [0, 0, 1]]
            )
            pixels = cv2.projectPoints(points.astype(float), turned, view.camera.translation_m, inner, lens)[0][:, 0] + [off, 0.0]
            values = np.tile(np.concatenate([pixels, np.full((len(points), 1), 0.9)], axis=-1), (5, 1, 1))
            write_series(session.keypoints_path(view), KeypointSeries(values, model.body.markers.names, 0))

    strange, known, found, watched = looked_at("arm_markers", beside)
    assert "keypoints of a and 1 more: changed or gone since the run was made" in strange.text and not strange.of("img") and not strange.of("table")
    assert watched == list(range(5)) and found.silhouettes is None
    np.testing.assert_allclose(found.keypoints.error, np.broadcast_to([[0.0], [50.0]], found.keypoints.error.shape), atol=0.02)
    assert (found.keypoints.inside[:, 0] == 1).all() and (found.keypoints.inside[:, 1] == 0.5).all()
    assert "Gaussian with a standard deviation of 1.93 to 2 px by camera in each coordinate" in known.text
    assert "b1550.050.0" in known.text and len(known.of("img")) == 4


def same(session, model):
    """Write the body's silhouettes as those of the recording."""
    for view, mask in zip(session.views, projected_masks(model, POSE, session), strict=True):
        for frame in range(session.frames):
            cv2.imwrite(str(session.mask_path(view, frame)), 255 * mask.astype(np.uint8))


@pytest.mark.slow
def test_silhouettes_of_the_body_are_shown_as_such(looked_at):
    strange, known, found, _ = looked_at("arm_silhouette", same)
    assert "masks of a and 1 more: changed" in strange.text and not strange.of("img")
    assert found.keypoints is None and (found.silhouettes.overlap == 1).all() and (found.silhouettes.area == 0).all()
    # Overlap and area of two cameras, and two pictures.
    assert "a51.001.000 %" in known.text and len(known.of("img")) == 6


@pytest.mark.slow
def test_a_mode_seeker_has_no_intervals(looked_at):
    _, known, found, _ = looked_at("arm_silhouette", same, log_evidence=np.full((2, 5), np.nan))
    assert found.draws == 1 and np.isnan(found.silhouettes.expected_area).all()
    assert "so there are no intervals" in known.text and "predicted overlap" not in known.text and "a51.001.000 %" in known.text


def test_a_model_that_reads_neither_says_so(inspect, keypoint_session, parse):
    it = inspect(dofs=DOFS, units=("rad",) * 4, pose=np.tile(POSE, (2, 60, 5, 1)), recording=keypoint_session, model="arm_edges")
    found = parse(prediction_section(it))
    assert "reads neither keypoints nor silhouettes" in found.text and not found.of("img")
