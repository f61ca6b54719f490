"""Detections of a body whose pose is known become proposals around the true frames of its parts."""

import jax
import numpy as np
import pytest

from bayes_body.base.geometry import rigid
from bayes_body.density.spaces import SE3
from bayes_body.initial.detection.detect import Detected
from bayes_body.initial.detection.detections import UNKNOWN_RAD, axis_frames, landmark, part
from bayes_body.initial.search.proposals import MOST, proposals_of
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.placed_body import loosened, placed_markers
from bayes_body.model.body.solids import part_transforms
from bayes_body.model.definition import load_body

YAW, PLACE = 0.7, np.array([1.0, -0.5, 0.9])


configured = jax.jit(lambda body, pose: body.placement.configuration(body.skeleton, pose))
solids_of, markers_of = jax.jit(part_transforms), jax.jit(placed_markers)


@pytest.fixture(scope="module")
def standing():
    """A loose body that stands with hanging arms, turned about the vertical and moved: the body, its parts, and where it faces."""
    body = loosened(build_body("person_40", load_body("person_40"), Shape(1.75)))
    pose = np.zeros(len(body.dof_names))
    pose[[body.dof_names.index(f"root_{axis}") for axis in "xyz"]] = PLACE
    pose[body.dof_names.index("root_yaw")] = YAW
    for name, degrees in {"l_shoulder_y": -90, "r_shoulder_y": 90, "r_shoulder_z": 180}.items():
        pose[body.dof_names.index(name)] = np.radians(degrees)
    parts = np.asarray(configured(body, pose.astype(np.float32)), float)
    return body, parts, np.array([np.cos(YAW), np.sin(YAW), 0.0])


def detected(body, parts, forward, sd_rad, weights=(1.0,)):
    """What perfect detectors say of the parts and the markers."""
    solids = solids_of(body, parts.astype(np.float32))
    bases, axes, lengths = (np.asarray(array, float) for array in (solids.origin, np.asarray(solids.rotation)[..., 2], body.lengths))
    found = {}
    for name in body.placement.names:
        own = body.topology.names.index(name)
        axis = axes[own]
        middle = bases[own] + 0.5 * lengths[own] * axis
        # The solid of the torso hangs from the shoulders.
        axis = axis if "_" in name or axis[2] > 0 else -axis
        rotation = axis_frames(axis[None], forward[None])
        count = len(weights)
        found[name] = part(np.tile(middle, (count, 1)), np.tile(rotation, (count, 1, 1)), 0.02, sd_rad, np.array(weights), "test")
    markers = np.asarray(markers_of(body, parts.astype(np.float32)), float)
    landmarks = {name: landmark(place[None], 0.03, np.ones(1), "test") for name, place in zip(body.markers.names, markers, strict=True)}
    return Detected(landmarks, found, None, (), {})


def test_the_mean_of_a_detected_part_is_its_own_frame(standing):
    body, parts, forward = standing
    of_parts, _ = proposals_of(detected(body, parts, forward, 0.2), body)
    away = np.asarray(jax.jit(SE3().local)(parts.astype(np.float32), np.asarray(of_parts.components.mean)[:, 0]))
    # How arms and feet are turned about their axes is not told.
    told = np.array([not any(word in name for word in ("arm", "hand", "foot")) for name in body.placement.names])
    assert np.abs(away[told]).max() < 1e-3
    arms = np.array([any(word in name for word in ("arm", "hand")) for name in body.placement.names])
    assert np.abs(away[arms][:, :5]).max() < 1e-3
    assert np.allclose(np.exp(np.asarray(of_parts.log_weights)).sum(1), 1) and of_parts.log_weights.shape == (15, MOST)


def test_a_turn_about_the_axis_leaves_the_axis_where_it_is(standing):
    """The middle of a part's axis is known to 2 cm, and its direction to 6 degrees, although the turn about it is unknown."""
    body, parts, forward = standing
    of_parts, _ = proposals_of(detected(body, parts, forward, np.array([0.1, 0.1, UNKNOWN_RAD])), body)
    drawn = np.asarray(jax.jit(lambda key: of_parts.sample(key, 2000))(jax.random.key(0)), float)
    for name in ("l_forearm", "r_calf", "torso"):
        node, own = body.placement.names.index(name), body.topology.names.index(name)
        solids = solids_of(body, parts.astype(np.float32))
        base, axis = np.asarray(solids.origin)[own], np.asarray(solids.rotation)[own][:, 2]
        ends = np.stack([base, base + np.asarray(body.lengths)[own] * axis]).astype(float)
        local = rigid.apply(rigid.inverse(parts[node]), ends)
        moved = np.stack([rigid.apply(drawn[node], end) for end in local])
        middle = moved.mean(0) - ends.mean(0)
        assert np.all(np.abs(middle.mean(0)) < 0.005) and np.all(np.abs(middle.std(0) / 0.02 - 1) < 0.25)
        axis = (moved[1] - moved[0]) / np.linalg.norm(ends[1] - ends[0])
        tilt = np.arccos(np.clip(axis @ (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]), -1, 1))
        assert np.sqrt((tilt**2).mean() / 2) == pytest.approx(0.1, rel=0.1)


def test_a_landmark_is_where_it_was_seen(standing):
    body, parts, forward = standing
    _, of_landmarks = proposals_of(detected(body, parts, forward, 0.2), body)
    drawn = jax.jit(lambda key: of_landmarks.sample(key, 500))(jax.random.key(0))
    markers = np.asarray(jax.jit(jax.vmap(placed_markers, (None, 1)))(body, drawn), float)
    seen = np.asarray(markers_of(body, parts.astype(np.float32)), float)
    # Each draw of a part has one of the part's markers in its place.
    owners = np.array(body.placement.owners)[np.array(body.markers.joints)]
    for part_of in set(owners.tolist()):
        own = np.flatnonzero(owners == part_of)
        near = np.linalg.norm(markers[:, own] - seen[own], axis=2).min(axis=1) < 4 * 0.03
        assert near.mean() > 0.98


def test_a_part_that_was_not_detected_has_no_proposal(standing):
    body, parts, forward = standing
    everything = detected(body, parts, forward, 0.2, weights=np.arange(1.0, 21.0))
    only = {"torso": everything.parts["torso"]}
    of_parts, of_landmarks = proposals_of(everything._replace(parts=only, landmarks={}), body)
    assert [name for name, there in zip(body.placement.names, np.asarray(of_parts.exists), strict=True) if there] == ["torso"]
    assert not np.asarray(of_landmarks.exists).any()
    # The strongest are taken.
    weights = np.exp(np.asarray(of_parts.log_weights[body.placement.names.index("torso")]))
    assert np.allclose(np.sort(weights), np.arange(9, 21) / np.arange(9, 21).sum(), atol=1e-6)
