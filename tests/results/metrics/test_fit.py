"""How well a body fits a frame: cover, distance to keypoints, and the warnings that follow."""

import dataclasses

import numpy as np
import pytest

from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.results.metrics.by_frame import stack_frames
from bayes_body.results.metrics.fit import Fit, cover_of, frame_fit, outlines
from bayes_body.results.metrics.plausibility import FEWEST_FRAMES, fit_figures, judge
from bayes_body.results.metrics.plausibility_sentences import fit_sentences


def _fit(cover=np.nan, distance=np.nan, overlap=np.nan, body=0.1, silhouette=0.1, cameras=2):
    values = (np.full((1, cameras), value) for value in (overlap, cover, distance, body))
    return Fit(*values, np.full(cameras, silhouette), bool(np.isfinite(overlap)))


def _figures(first, fits):
    return fit_figures(first, stack_frames(judge(fit) for fit in fits))


def test_the_cover_is_one_of_a_part_and_nothing_beside_it():
    person, body = np.zeros((6, 6), bool), np.zeros((6, 6), bool)
    person[:4] = True
    assert cover_of(body, person) == 0
    body[1:3, 2:4] = True
    assert cover_of(body, person) == 1
    assert cover_of(person, body) == 1
    body[3:6, 2:4] = True
    assert cover_of(body, person) == 6 / 10
    assert np.isnan(cover_of(body, np.zeros((6, 6), bool)))


def test_the_median_camera_and_the_worst_run_count():
    nothing, cover = np.full((2, 3), np.nan), np.array([[0.9, 0.8, 0.1], [0.95, np.nan, 0.85]])
    frames = [Fit(nothing, cover, nothing, np.full((2, 3), 0.1), np.full(3, 0.1))]
    figures = _figures(_fit(0.9), frames)
    assert figures["fit_by"] == "silhouettes" and figures["fit_first"] == 0.9 and figures["frames_off"] == []
    assert (figures["fit_worst"], figures["fit_worst_frame"]) == (0.8, 0)


@pytest.mark.parametrize("by", ["silhouettes", "keypoints"])
def test_a_stretch_of_frames_is_a_warning_and_a_single_one_is_none(by):
    good, bad = ({"cover": 0.9}, {"cover": 0.5}) if by == "silhouettes" else ({"distance": 0.05}, {"distance": 0.4})
    off = np.array([0, 1, 0, 0, 1, 1, 1, 0, 0], bool)
    figures = _figures(_fit(**good), [_fit(**(bad if each else good)) for each in off]) | {"frames": 9}
    assert FEWEST_FRAMES == 3 and figures["fit_by"] == by and figures["frames_off"] == [4, 5, 6]
    (sentence,) = fit_sentences(figures)
    assert sentence.startswith("frames 4-6: the body does not cover the person: at worst, at frame 1")
    to_the_end = _figures(_fit(**good), [_fit(**good)] * 31 + [_fit(**bad)] * 9) | {"frames": 40}
    (sentence,) = fit_sentences(to_the_end)
    assert sentence.startswith("from frame 31 the body no longer covers the person")
    assert fit_sentences(_figures(_fit(**good), [_fit(**good)] * 5) | {"frames": 5}) == []
    (first,) = fit_sentences(_figures(_fit(**bad), [_fit(**good)] * 5) | {"frames": 5})
    assert first.startswith("frame 0: the body in its first pose does not fit the image")


def test_a_short_recording_needs_no_more_frames_than_it_has():
    figures = _figures(_fit(0.2), [_fit(0.2)] * 2) | {"frames": 2}
    assert figures["frames_off"] == [0, 1] and len(fit_sentences(figures)) == 2
    assert fit_sentences(figures)[1].startswith("from the first frame to the last the body does not cover the person")


def test_a_small_body_in_a_large_silhouette_is_off_the_person_if_it_is_a_whole_body():
    figures = _figures(_fit(1.0, overlap=0.05), [_fit(1.0, overlap=0.06), _fit(1.0, overlap=0.04)]) | {"frames": 2}
    assert (figures["overlap_first"], figures["overlap_worst"], figures["overlap_worst_frame"], figures["frames_off"]) == (0.05, 0.04, 1, [0, 1])
    first, later = fit_sentences(figures)
    assert "IoU) is 0.05 (limit 0.4" in first and "at frame 1, its overlap with the silhouettes (IoU) is 0.04 (limit 0.4" in later
    part = _figures(_fit(1.0), [_fit(1.0)] * 2) | {"frames": 2}
    assert part["overlap_worst"] is None and fit_sentences(part) == []


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_empty_silhouettes_and_those_of_the_background_tell_nothing(share):
    blind = _fit(np.nan if share == 0 else 1.0, silhouette=share, overlap=0.1)
    figures = _figures(_fit(0.9), [_fit(0.9)] * 2 + [blind] * 3) | {"frames": 5}
    assert figures["frames_off"] == [] and figures["frames_blind"] == [2, 3, 4]
    (sentence,) = fit_sentences(figures)
    assert sentence.startswith("frames 2-4: no camera's silhouette can be a person's")


def test_a_camera_that_fits_worse_than_the_others_is_named():
    errors = {"a": 8.0, "b": 31.0, "c": 9.0, "d": 10.0}
    figures = {"reprojection_by_camera": {name: {"px": px, "of_diagonal": px / 1000} for name, px in errors.items()}}
    (sentence,) = fit_sentences(figures)
    assert sentence.startswith("camera 'b' fits worse than the others: its keypoints are 31 px (3.1% of the image's diagonal) from the body")
    assert "those of the others 0.9% (median)" in sentence
    figures["reprojection_by_camera"]["b"] = {"px": 17.0, "of_diagonal": 0.017}
    assert fit_sentences(figures) == []


def test_a_body_beside_all_silhouettes_is_off_whatever_its_keypoints_say():
    beside, good = _fit(0.0, distance=0.01, overlap=0.0), _fit(0.9, distance=0.01, overlap=0.6)
    figures = _figures(good, [good] * 2 + [beside] * 3) | {"frames": 5}
    assert (figures["fit_by"], figures["frames_off"], figures["frames_beside"]) == ("keypoints", [2, 3, 4], [2, 3, 4])
    (sentence,) = fit_sentences(figures)
    assert sentence.startswith(
        "frames 2-4: the body lies beside the silhouettes of all cameras (overlap below 0.05), although it is fitted to keypoints"
    )
    # One camera with a silhouette on the body is enough, and silhouettes that cannot be a person's say nothing.
    one = beside._replace(cover=np.array([[0.0, 0.5]]))
    empty = beside._replace(silhouette=np.zeros(2))
    assert fit_sentences(_figures(good, [one, empty] * 3) | {"frames": 6}) == []


def test_keypoints_that_most_cameras_contradict_are_said():
    cameras = {"a": 50.0, "b": 31.0, "c": 9.0, "d": 10.0}
    figures = {"reprojection_by_camera": {name: {"px": px, "of_diagonal": px / 1000} for name, px in cameras.items()}}
    (sentence,) = fit_sentences(figures)
    assert sentence.startswith(
        "the body is far from the keypoints in 2 of 4 cameras: a 50 px (5.0% of the diagonal), b 31 px (3.1% of the diagonal), limit 2%"
    )


def test_a_body_that_no_camera_can_see_is_off_whatever_the_session_has():
    figures = _figures(_fit(silhouette=np.nan), [_fit(body=0.0, silhouette=np.nan)] * 3) | {"frames": 3}
    assert figures["fit_by"] is None and figures["frames_off"] == figures["frames_outside"] == [0, 1, 2]
    (sentence,) = fit_sentences(figures)
    assert sentence.startswith("frames 0-2: the body is outside of the image of every camera")


def test_without_silhouettes_and_keypoints_nothing_is_said():
    figures = _figures(_fit(silhouette=np.nan), [_fit(silhouette=np.nan)] * 4) | {"frames": 4}
    assert figures["fit_by"] is None and figures["fit_first"] is None and figures["fit_worst"] is None and fit_sentences(figures) == []
    # A summary of an older version.
    assert fit_sentences({"frames": 4}) == []


def test_keypoints_on_the_markers_are_at_no_distance_and_moved_ones_at_theirs(whole, textured_session, tmp_path):
    pose = np.asarray(whole.initial["pose"], float)
    names = list(whole.body.dof_names)
    # In front of both cameras, standing.
    pose[names.index("root_z")] = 0.9
    session = _with_keypoints(whole, textured_session, tmp_path, pose)
    assert np.abs(frame_fit(session, whole, pose[None], 0).distance).max() < 1e-3
    moved = pose.copy()
    moved[names.index("root_z")] += 0.9
    assert frame_fit(session, whole, moved[None], 0).distance.min() > 0.2
    assert outlines(whole, pose)


def _with_keypoints(model, session, folder, pose):
    """The session with keypoints at the markers of a pose in every frame."""
    import jax
    import jax.numpy as jnp

    from bayes_body.base.geometry.camera import project

    places = np.asarray(model.markers(jnp.asarray(pose, jnp.float32)))
    views = []
    for c, view in enumerate(session.views):
        pixels, _ = project(jax.tree.map(lambda leaf, c=c: leaf[c], model.rig), jnp.asarray(places))
        points = np.concatenate([np.asarray(pixels), np.ones((len(places), 1))], axis=1)
        order = [model.body.markers.names.index(name) for name in MARKERS]
        write_series(folder / f"{view.camera.name}.npz", KeypointSeries(np.tile(points[order], (session.frames, 1, 1)), MARKERS, 0))
        views.append(dataclasses.replace(view, keypoints=str(folder / f"{view.camera.name}.npz")))
    return dataclasses.replace(session, views=tuple(views))
