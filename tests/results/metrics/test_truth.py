"""A whole run against the truth, held against sums written out, and the offset of two skeletons."""

import dataclasses
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.model.body.placed_body import loosened
from bayes_body.results.metrics import accuracy_figures, against_truth
from bayes_body.results.metrics.accuracy import LEVELS
from bayes_body.results.metrics.figures import ANGLES, NAMES, SCORES, width
from bayes_body.results.metrics.truth import FEWEST
from bayes_body.results.posterior import markers
from bayes_body.results.posterior.moments import weighted_quantiles

NINETY = LEVELS.index(0.9)


def poses_of(model, shape, spread=0.3, seed=0):
    """Poses within the limits of nothing: the metrics do not ask."""
    rng = np.random.default_rng(seed)
    return np.asarray(model.initial["pose"]) + spread * rng.normal(size=(*shape, len(model.body.dof_names)))


def test_every_figure_is_what_it_says(arm, clouds_of, all_markers):
    """All that differs, differs: frames, runs, particles, weights, markers and axes. A figure of the wrong one of them is another figure."""
    frames, runs, particles = 5, 2, 30
    rng = np.random.default_rng(1)
    poses, log_weights = poses_of(arm, (frames, runs, particles)), 2 * rng.normal(size=(frames, runs, particles))
    positions = markers(arm, poses.astype(np.float32)).astype(float)
    names = arm.body.markers.names
    truth = positions[:, 0].mean(axis=1) + rng.normal(0, [0.02, 0.05, 0.1], size=(frames, 3, 3))
    truth[3, 1] = np.nan
    found = against_truth(arm, clouds_of(poses, log_weights), all_markers(names, truth))
    figures = accuracy_figures(found, mode_seeker=False)

    error, best, inside = np.full((frames, runs, 3), np.nan), np.zeros((frames, runs)), {0.5: [], 0.9: []}
    for frame, run in product(range(frames), range(runs)):
        weights = np.exp(log_weights[frame, run]) / np.exp(log_weights[frame, run]).sum()
        mean = sum(weight * position for weight, position in zip(weights, positions[frame, run], strict=True))
        error[frame, run] = np.linalg.norm(mean - truth[frame], axis=-1)
        best[frame, run] = min(np.nanmean(np.linalg.norm(each - truth[frame], axis=-1)) for each in positions[frame, run])
        for level, marker, axis in product(inside, range(3), range(3)):
            ends = weighted_quantiles(positions[frame, run, None, :, marker, axis, None], weights[None], ((1 - level) / 2, (1 + level) / 2))
            inside[level] += [ends[0].item() <= truth[frame, marker, axis] <= ends[1].item()] if marker != 1 or frame != 3 else []
    of_frame = np.nanmean(error, axis=-1)
    assert figures["error_mm_mean"] == pytest.approx(1000 * of_frame.mean(), rel=1e-5)
    assert figures["error_mm_std"] == pytest.approx(1000 * of_frame.std(axis=0, ddof=1).mean(), rel=1e-4)
    assert figures["error_mm_optimistic"] == pytest.approx(1000 * best.mean(), rel=1e-5)
    assert figures["error_mm_by_marker"] == pytest.approx(dict(zip(names, 1000 * np.nanmean(error, axis=(0, 1)), strict=True)), rel=1e-5)
    assert (figures["coverage_50"], figures["coverage_90"]) == pytest.approx((np.mean(inside[0.5]), np.mean(inside[0.9])))
    assert 0.1 < figures["coverage_50"] < figures["coverage_90"] < 1 and len(inside[0.9]) == (5 * 3 - 1) * 3 * 2
    # The arm has no pelvis, and five frames are too few for an offset.
    none = ["error_mm_relative", "error_mm_mean_fitted_offset", "coverage_90_fitted_offset"]
    assert [name for name in NAMES if figures[name] is None] == [*none, *ANGLES]
    coverage, calibration = figures["coverage_90_by_marker"], figures["ece_radial_by_marker"]
    assert set(coverage) == set(calibration) == set(names) and list(coverage.values()) == sorted(coverage.values())
    assert list(calibration.values()) == sorted(calibration.values(), reverse=True)
    assert figures["ece_radial"] == pytest.approx(np.median(list(calibration.values())), abs=1e-4)
    assert figures["error_mm_by_certainty"][-1] == pytest.approx(figures["error_mm_mean"], abs=0.01) and figures["tarp"]["frames"] == 5


def test_parts_made_from_poses_have_the_figures_of_the_poses(whole, clouds_of, all_markers):
    """Error and coverage depend on the markers only. The fitted offsets are in the frames of mean parts, which are not those of mean angles."""
    rng, frames, names = np.random.default_rng(11), FEWEST, whole.body.markers.names
    poses, log_weights = poses_of(whole, (frames, 2, 20), 0.05), rng.normal(size=(frames, 2, 20))
    loose = dataclasses.replace(whole, body=loosened(whole.body))
    # The torso holds the joints without a part of their own, such as the collar-bones, at the angle 0.
    held = set(range(len(loose.body.placement.owners))) - set(loose.body.placement.joints_of_parts)
    poses[..., [motion.dof for joint in held for motion in whole.body.skeleton.topology.motions[joint]]] = 0
    truth = markers(whole, poses[:, 0, 0].astype(np.float32)) + rng.normal(0, 0.02, (frames, 15, 3))
    place = jax.jit(jax.vmap(lambda pose: loose.body.placement.configuration(loose.body.skeleton, pose)))
    parts = np.asarray(place(jnp.asarray(poses.reshape(-1, poses.shape[-1]), jnp.float32))).reshape(frames, 2, 20, -1, 7)
    by_angles = accuracy_figures(against_truth(whole, clouds_of(poses, log_weights), all_markers(names, truth)), mode_seeker=False)
    by_parts = accuracy_figures(against_truth(loose, clouds_of(parts, log_weights), all_markers(names, truth)), mode_seeker=False)
    for name in ("error_mm_mean", "error_mm_std", "error_mm_relative", "error_mm_optimistic"):
        assert by_parts[name] == pytest.approx(by_angles[name], rel=1e-3), name
    assert by_parts["error_mm_by_marker"] == pytest.approx(by_angles["error_mm_by_marker"], rel=1e-3)
    # One of the 900 intervals may end within rounding of the truth.
    for name in ("coverage_50", "coverage_90"):
        assert by_parts[name] == pytest.approx(by_angles[name], abs=2 / 900), name
    assert by_parts["error_mm_mean_fitted_offset"] == pytest.approx(by_angles["error_mm_mean_fitted_offset"], rel=0.02)


def test_markers_are_found_by_name(arm, clouds_of, all_markers):
    body = arm.body.markers
    other = dataclasses.replace(body, names=("l_wrist", "nose", "l_shoulder"), joints=body.joints[::-1], offsets=body.offsets[::-1])
    turned = dataclasses.replace(arm, body=dataclasses.replace(arm.body, markers=other))
    poses = poses_of(arm, (4, 1, 1))
    truth = markers(arm, poses[:, 0, 0].astype(np.float32)) + np.array([[0.0, 0.0, 0.01], [9.0, 9.0, 9.0], [0.0, 0.03, 0.0]])
    figures = accuracy_figures(against_truth(turned, clouds_of(poses), all_markers(body.names, truth)), mode_seeker=False)
    assert figures["error_mm_by_marker"] == pytest.approx({"l_wrist": 30, "l_shoulder": 10}, rel=1e-3)
    assert figures["error_mm_mean"] == pytest.approx(20, rel=1e-3)
    nameless = dataclasses.replace(other, names=("a", "b", "c"))
    stranger = dataclasses.replace(arm, body=dataclasses.replace(arm.body, markers=nameless))
    assert against_truth(stranger, clouds_of(poses), all_markers(body.names, truth)) is None


def test_what_does_not_exist_is_none(arm, clouds_of, all_markers):
    assert accuracy_figures(None, mode_seeker=False) == dict.fromkeys(NAMES)
    poses, names = poses_of(arm, (2, 1, 20)), arm.body.markers.names
    unknown = accuracy_figures(against_truth(arm, clouds_of(poses), all_markers(names, np.full((2, 3, 3), np.nan))), mode_seeker=False)
    assert unknown == dict.fromkeys(NAMES) | {"error_mm_by_marker": dict.fromkeys(names)}
    single = against_truth(arm, clouds_of(poses[:1]), all_markers(names, np.zeros((1, 3, 3))))
    seeker, sampler = (accuracy_figures(single, mode_seeker=each) for each in (True, False))
    assert seeker["error_mm_mean"] > 0 and seeker["error_mm_std"] is None and seeker["coverage_50"] is seeker["coverage_90"] is None
    assert all(seeker[name] is None for name in SCORES)
    assert sampler["coverage_90"] is not None


def offset_truth(model, poses, offset):
    """The markers at each frame's pose, moved by `offset` (marker, 3) in the frame of their joint: by differences, not by the joint's own axes."""

    def at(shift):
        moved = dataclasses.replace(model.body.markers, offsets=model.body.markers.offsets + jnp.asarray(shift, jnp.float32))
        return markers(dataclasses.replace(model, body=dataclasses.replace(model.body, markers=moved)), poses.astype(np.float32)).astype(float)

    still = at(np.zeros(3))
    return still + sum(offset[:, axis, None] * (at(np.eye(3)[axis]) - still) for axis in range(3))


def test_an_offset_of_the_skeletons_is_found_and_taken_away(whole, clouds_of, all_markers):
    rng = np.random.default_rng(7)
    poses, offset, names = poses_of(whole, (FEWEST, 1, 1), 0.5), 0.05 * rng.normal(size=(15, 3)), whole.body.markers.names
    truth = offset_truth(whole, poses[:, 0, 0], offset)
    found = against_truth(whole, clouds_of(poses), all_markers(names, truth))
    figures = accuracy_figures(found, mode_seeker=False)
    np.testing.assert_allclose(found.offsets, offset, atol=1e-5)
    assert figures["error_mm_mean"] == pytest.approx(1000 * np.linalg.norm(offset, axis=-1).mean(), rel=1e-3)
    assert figures["error_mm_mean_fitted_offset"] < 0.01
    relative = truth - truth[:, :1] - (markers(whole, poses[:, 0, 0].astype(np.float32)) - markers(whole, poses[:, 0, 0].astype(np.float32))[:, :1])
    assert figures["error_mm_relative"] == pytest.approx(1000 * np.linalg.norm(relative, axis=-1)[:, 1:].mean(), rel=1e-3)
    too_few = against_truth(whole, clouds_of(poses[1:]), all_markers(names, truth[1:]))
    assert too_few.fitted is None


def test_an_offset_that_is_not_there_does_not_flatter(whole, clouds_of, all_markers):
    """Pure noise: fitted on n frames and measured on others, the error grows by sqrt(1 + 1/n); on the same frames it would shrink."""
    poses, frames = poses_of(whole, (FEWEST, 1, 1)), FEWEST
    noise = 0.02 * np.random.default_rng(8).normal(size=(frames, 15, 3))
    truth = markers(whole, poses[:, 0, 0].astype(np.float32)) + noise
    figures = accuracy_figures(against_truth(whole, clouds_of(poses), all_markers(whole.body.markers.names, truth)), mode_seeker=False)
    ratio = figures["error_mm_mean_fitted_offset"] / figures["error_mm_mean"]
    # 450 numbers; their noise does not cancel, but enters both errors.
    assert ratio == pytest.approx(np.sqrt(1 + 2 / frames), abs=0.04)


@pytest.mark.parametrize("step", [1, 2])
def test_a_truth_that_is_known_in_every_other_frame_has_both_halves(arm, clouds_of, all_markers, step):
    frames = step * FEWEST
    poses, offset = poses_of(arm, (frames, 1, 1)), np.array([[0.03, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.04]])
    truth = offset_truth(arm, poses[:, 0, 0], offset)
    truth[np.arange(frames) % step != 0] = np.nan
    found = against_truth(arm, clouds_of(poses), all_markers(arm.body.markers.names, truth))
    np.testing.assert_array_equal(np.isfinite(found.fitted.error[:, 0, 0]), np.arange(frames) % step == 0)
    assert np.nanmax(found.fitted.error) < 1e-5 and np.nanmean(found.plain.error) == pytest.approx(0.03, rel=1e-3)


def test_the_offset_takes_the_intervals_along(arm, clouds_of, all_markers):
    frames, particles = 120, 200
    centres = poses_of(arm, (frames, 1, 1), 0.5)
    poses = centres + poses_of(arm, (frames, 1, particles + 1), 0.05, seed=2) - np.asarray(arm.initial["pose"])
    offset = np.array([[0.0, 0.0, 0.0], [0.08, -0.08, 0.0], [0.08, 0.08, 0.0]])
    truth, names = offset_truth(arm, poses[:, 0, 0], offset), arm.body.markers.names
    # The shoulder does not move: an interval without width, to which rounding is everything.
    truth[:, 0] = np.nan
    found = against_truth(arm, clouds_of(poses[:, :, 1:]), all_markers(names, truth))
    figures = accuracy_figures(found, mode_seeker=False)
    assert figures["coverage_90"] < 0.5
    # Axes and markers of a frame depend on each other: as many independent trials as frames.
    assert abs(figures["coverage_90_fitted_offset"] - 0.9) < 4 * np.sqrt(0.9 * 0.1 / frames)
    np.testing.assert_array_equal(found.plain.known, [0, 3 * frames, 3 * frames])
    assert found.plain.coverage_by_marker[NINETY, 1:] == pytest.approx(found.plain.inside[NINETY, 1:] / (3 * frames))


def test_widths_in_words():
    assert [width(share) for share in (0.62, 0.79, 0.8, 0.9, 0.98, 0.99)] == [*["too narrow"] * 2, *["about right"] * 3, "too wide"]
