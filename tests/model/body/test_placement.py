"""Whole-body likelihoods do not know which placement a body has: their values and their gradients by a movement of the whole body are the same."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry import rigid
from bayes_body.base.registry import find
from bayes_body.model.build import build_model
from bayes_body.model.definition import LikelihoodDefinition, TermDefinition, load_definition
from bayes_body.model.dynamics import rigid_walk
from bayes_body.recording.observation.frames import read_frame

log_likelihood = jax.jit(lambda density, state: density.log_likelihood(state, state))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm", "arm_markers", "arm_silhouette", "arm_edges"])
def test_a_likelihood_is_the_same_for_both(name, keypoint_session):
    definition = load_definition(name)
    walk = TermDefinition("rigid_walk", rigid_walk.Options())
    angles, parts = (build_model(each, keypoint_session) for each in (definition, dataclasses.replace(definition, placement="parts", dynamics=walk)))
    assert (angles.body.variable, parts.body.variable) == ("pose", "parts")
    data = angles.observe(read_frame(keypoint_session, 1))
    pose = jnp.asarray([-0.4, -0.7, 0.2, -0.9], jnp.float32)

    def by_angles(pose, shift):
        moved = dataclasses.replace(angles.body.skeleton, offsets=angles.body.skeleton.offsets.at[0].add(shift))
        factors = jax.tree.map(
            lambda node: moved if isinstance(node, type(moved)) else node, angles.factors, is_leaf=lambda n: isinstance(n, type(moved))
        )
        return dataclasses.replace(angles.density(data), factors=factors).log_likelihood({"pose": pose}, angles.initial)

    def by_parts(pose, shift):
        configuration = parts.body.placement.configuration(parts.body.skeleton, pose)
        X = jnp.concatenate([shift, jnp.asarray([1.0, 0, 0, 0])])
        return parts.density(data).log_likelihood({"parts": rigid.compose(X[None], configuration)}, parts.initial)

    (one, slope), (other, other_slope) = (jax.jit(jax.value_and_grad(each, argnums=1))(pose, jnp.zeros(3)) for each in (by_angles, by_parts))
    assert np.isfinite(one) and float(one) == pytest.approx(float(other), rel=1e-4)
    np.testing.assert_allclose(slope, other_slope, rtol=2e-3, atol=1e-3 * np.abs(slope).max())


@pytest.mark.parametrize("kind", ["markers_gaussian", "regions"])
def test_the_cameras_of_a_plate_move(kind, keypoint_session):
    """`Model.at` reaches the cameras of a plate's rows: seen from elsewhere, the value is that of a model of a session with cameras there."""
    definition = load_definition("arm_markers")
    term = find("likelihood", kind)
    likelihood = LikelihoodDefinition(kind, term.options(), find("observation", kind).options())
    walk = TermDefinition("rigid_walk", rigid_walk.Options())
    loose = dataclasses.replace(definition, placement="parts", dynamics=walk, likelihoods=(likelihood,))
    model = build_model(loose, keypoint_session)
    lower = [
        dataclasses.replace(view, camera=dataclasses.replace(view.camera, translation_m=view.camera.translation_m + np.array([0.1, -0.2, 0.3])))
        for view in keypoint_session.views
    ]
    there = build_model(loose, dataclasses.replace(keypoint_session, views=tuple(lower)))
    data, state = model.observe(read_frame(keypoint_session, 1)), dict(model.initial)
    before, moved, expected = (float(log_likelihood(each.density(data), state)) for each in (model, model.at([view.camera for view in lower]), there))
    assert moved == pytest.approx(expected, rel=1e-6) and abs(moved - before) > 1e-3 * abs(before)
