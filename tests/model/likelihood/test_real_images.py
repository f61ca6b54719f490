"""On real images the likelihood knows its cameras and its man: swapped cameras and random poses are far worse than the true pose."""

from dataclasses import replace
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.density.factor import Variable
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.observation.frames import read_frame

POSE = Variable("pose")
NAME = "silhouette_edges"


@pytest.fixture(scope="module", params=[pytest.param("nearest", marks=pytest.mark.slow), "bilinear"])
def case(request, session):
    """(factor, its maps of frame 0, the first pose)."""
    definition = load_definition("deutscher_2005")
    (term,) = definition.likelihoods
    term = replace(term, options=term.options.model_copy(update={"lookup": request.param}))
    model = build_model(replace(definition, likelihoods=(term,)), session)
    (factor,) = (factor for factor in model.factors if factor.name == NAME)
    return factor, jax.tree.map(jnp.asarray, model.observe(read_frame(session, 0))[NAME]), model.initial["pose"]


@jax.jit
def log_density(factor, maps, pose) -> jax.Array:
    return factor({POSE: pose}, {NAME: maps})


def value(factor, maps, pose) -> float:
    return float(log_density(factor, maps, pose))


def permuted(tree, order):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[order]), tree)


def swaps():
    for a, b in combinations(range(4), 2):
        order = list(range(4))
        order[a], order[b] = b, a
        yield order


@pytest.mark.slow
def test_two_cameras_swapped_are_worse(case):
    factor, maps, pose = case
    true = value(factor, maps, pose)
    potential = factor.log_potential
    for order in swaps():
        swapped_rig = replace(factor, log_potential=replace(potential, rig=permuted(potential.rig, order)))
        # A swap moves the body off two silhouettes of four; 1e-3 would be ten times the rounding of a map.
        assert value(factor, permuted(maps, order), pose) < true - 0.3
        assert value(swapped_rig, maps, pose) < true - 0.3
        # Both at once is only another order of the cameras.
        assert value(swapped_rig, permuted(maps, order), pose) == pytest.approx(true, rel=1e-5)


def test_silhouettes_and_edges_swapped_are_another_density(case):
    factor, maps, pose = case
    swapped = maps._replace(errors=maps.errors[:, ::-1])
    assert abs(value(factor, swapped, pose) - value(factor, maps, pose)) > 0.1


def test_random_poses_are_worse(case):
    factor, maps, pose = case
    angular = np.array(factor.log_potential.body.skeleton.topology.angular)
    noise = np.random.default_rng(0).normal(size=(100, pose.size)) * angular * 0.3
    values = np.array([value(factor, maps, one) for one in np.asarray(pose) + noise.astype(pose.dtype)])
    assert np.mean(values < value(factor, maps, pose)) >= 0.97


def test_a_body_moved_aside_is_worse(case):
    factor, maps, pose = case
    for axis in range(3):
        for shift in (-0.15, 0.15):
            assert value(factor, maps, pose.at[axis].add(shift)) < value(factor, maps, pose) - 0.05
