"""What the likelihoods that are distributions over a frame's data read of a frame."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.model.likelihood.silhouette_bernoulli import Options, _centres
from bayes_body.recording.evidence.markers import FEET, KEYPOINTS, MARKERS
from bayes_body.recording.observation.frames import Frame, read_frame
from bayes_body.recording.observation.silhouette_bernoulli import sample_mask
from bayes_body.recording.readers import truth
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series


def observe(kind, frame, **given):
    return find("observation", kind).build(options=None, **given)(frame)


def test_the_markers_are_those_of_the_truth():
    assert MARKERS == truth.MARKERS


def test_markers_of_a_frame():
    keypoints = ({"l_knee": (10.0, 20.5, 0.7), "nose": (1.0, 1.0, 1.0)}, None, {})
    seen = observe("markers_gaussian", Frame(0, (None,) * 3, None, keypoints=keypoints))
    assert seen.pixels.shape == (3, 15, 2) and seen.confidence.shape == (3, 15)
    np.testing.assert_array_equal(np.argwhere(seen.confidence > 0), [[0, MARKERS.index("l_knee")]])
    np.testing.assert_allclose(seen.pixels[0, MARKERS.index("l_knee")], [10, 20.5])
    with pytest.raises(InputError, match="its cameras have no keypoints; expected keypoints from at least one camera; import them"):
        observe("markers_gaussian", Frame(0, (None,), None))


@pytest.mark.parametrize("layout", ["BODY_25", "BODY_25B", "HALPE_26"])
def test_heels_and_toes_are_evidence_for_a_body_that_has_them(layout):
    points = np.random.default_rng(0).uniform(1, 99, (1, len(LAYOUTS[layout]), 3)) * [1, 1, 0.01]
    keypoints = KeypointSeries(points, LAYOUTS[layout], 0).frame(0)
    frame = Frame(0, (None,), None, keypoints=(keypoints,))
    whole, without = observe("markers_gaussian", frame, markers=("l_hip", *FEET)), observe("markers_gaussian", frame, markers=("l_hip", "l_toe"))
    assert whole.confidence.shape == (1, 21) and without.confidence.shape == (1, 15)
    for place, name in enumerate(FEET, 15):
        assert KEYPOINTS[place] == name
        np.testing.assert_allclose([*whole.pixels[0, place], whole.confidence[0, place]], points[0, LAYOUTS[layout].index(name)], rtol=1e-6)
    # For a body without feet nothing changes.
    assert np.array_equal(whole.pixels[:, :15], without.pixels) and np.array_equal(whole.confidence[:, :15], without.confidence)


def test_silhouettes_of_a_frame():
    mask = np.zeros((30, 40), bool)
    mask[10:20, 30:] = True
    seen = observe("silhouette_bernoulli", Frame(0, (mask.astype(np.uint8), None), (mask, None)), likelihood=Options(grid=(4, 3)))
    np.testing.assert_array_equal(seen.foreground[0], [[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
    np.testing.assert_array_equal(seen.has_image, [True, False])
    assert observe("silhouette_bernoulli", Frame(0, (mask.astype(np.uint8),), (mask,))).foreground.shape == (1, 48, 64)
    with pytest.raises(InputError, match="no masks"):
        observe("silhouette_bernoulli", Frame(0, (None,), None))


@pytest.mark.parametrize("extent", [480, 641, 1088, 50, 47])
def test_the_likelihood_looks_where_the_masks_are_sampled(extent):
    """Also where an image has fewer pixels than the grid has points."""
    for count in (48, 64):
        pixels = np.arange(extent)
        bits = [sample_mask((pixels >> bit & 1).astype(bool)[None], count, 1)[0] << bit for bit in range(11)]
        np.testing.assert_allclose(_centres(count, jnp.asarray(extent, jnp.float32)) + extent / 2, np.sum(bits, axis=0))


@pytest.fixture
def keyed(textured_session, tmp_path):
    """A session whose first camera has keypoints, from its frame 1 on."""
    points = np.stack([np.full((2, 3), (20.0 + k, 30.0, 0.5)) for k in range(4)])
    points[2, 1] = np.nan
    write_series(tmp_path / "a.npz", KeypointSeries(points, ("mid_hip", "l_heel"), 1))
    first, second = textured_session.views
    return replace(textured_session, views=(replace(first, keypoints=str(tmp_path / "a.npz")), replace(second, keypoints=None)))


def test_keypoints_of_a_session(keyed):
    assert read_frame(replace(keyed, views=(keyed.views[1],)), 0).keypoints is None
    assert read_frame(keyed, 0).keypoints == ({}, None)
    assert read_frame(keyed, 1).keypoints == ({"pelvis": (20.0, 30.0, 0.5), "l_heel": (20.0, 30.0, 0.5)}, None)
    assert read_frame(keyed, 3).keypoints == ({"pelvis": (22.0, 30.0, 0.5)}, None)
    # The camera's own numbering counts.
    shifted = replace(keyed, frames=3, first_frame=1)
    assert read_frame(shifted, 0).keypoints == read_frame(keyed, 1).keypoints


def test_keypoints_of_a_frame_that_the_camera_did_not_see(keyed):
    lost = replace(keyed, views=(replace(keyed.views[0], images="nowhere/%d.png"), keyed.views[1]))
    assert read_frame(lost, 1).keypoints == (None, None)


def test_keypoints_that_are_gone(keyed):
    keyed.keypoints_path(keyed.views[0]).unlink()
    with pytest.raises(InputError, match=r"a.npz: no such file"):
        read_frame(keyed, 1)
