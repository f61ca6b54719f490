"""Draws as a DataTree: dimensions, units, weights kept; and diagnostics that respect the weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from bayes_body.kernels.particle_filter import build_kernel
from bayes_body.model import load_model
from bayes_body.posterior import equal_weight_draws, markers, mean_poses, rhat, save_posterior, to_datatree
from bayes_body.tracking import track

RUNS, FRAMES, PARTICLES = 3, 5, 400


@pytest.fixture(scope="module")
def draws(textured_session):
    return track(textured_session, load_model("arm", textured_session), build_kernel(), jax.random.key(2), particles=PARTICLES, runs=RUNS)


def test_the_tree_holds_draws_weights_and_ancestors(draws, tmp_path):
    save_posterior(to_datatree(draws, {"seed": 2}), tmp_path / "posterior.nc")
    tree = xr.open_datatree(tmp_path / "posterior.nc")
    pose = tree["posterior"]["pose"]
    assert pose.dims == ("chain", "draw", "frame", "dof") and pose.shape == (RUNS, PARTICLES, FRAMES, 4)
    assert list(pose.dof.values) == ["shoulder_x", "shoulder_y", "shoulder_z", "elbow"] and set(pose.unit.values) == {"rad"}
    assert (pose.sel(chain=1, frame=2).values == draws.states["pose"][1, 2]).all()
    for name, values in (("log_weight", draws.log_weights), ("ancestor", draws.info.ancestors)):
        stored = tree["sample_stats"][name]
        assert stored.dims == ("chain", "draw", "frame")
        assert (stored.sel(chain=2, frame=3).values == values[2, 3]).all()
    assert tree["filter"]["ess"].dims == ("chain", "frame")
    assert tree.attrs["model"] == "arm" and tree.attrs["seed"] == 2


def test_arviz_takes_it(draws):
    import arviz as az

    assert "pose" in az.summary(to_datatree(draws).sel(frame=1), var_names=["pose"]).index[0]


def test_equal_weight_draws_have_the_weighted_mean(draws):
    sample = equal_weight_draws(draws, 20_000)
    mcse = sample.std(axis=2) / np.sqrt(20_000)
    assert (np.abs(sample.mean(axis=2) - mean_poses(draws)) < 4 * mcse + 1e-6).all()


def test_weights_are_not_forgotten(draws):
    plain = draws.states["pose"].mean(axis=2)
    assert np.abs(plain - mean_poses(draws)).max() > 1e-3


def _fake(draws, states, log_weights):
    return dataclasses.replace(draws, states={"pose": states}, log_weights=log_weights)


def test_rhat_sees_runs_that_disagree_and_counts_weights(draws):
    rng = np.random.default_rng(0)
    states = rng.normal(size=(4, 1, 2000, 2))
    equal = np.full((4, 1, 2000), -np.log(2000))
    assert rhat(_fake(draws, states, equal)).max() < 1.01
    moved = states.copy()
    moved[0, 0, :, 1] += 2.0
    apart = rhat(_fake(draws, moved, equal))
    assert apart[0, 0] < 1.01 and apart[0, 1] > 1.1
    # The same particles, weighted so that one run stands elsewhere: only the weights tell.
    tilted = equal.copy()
    tilted[0, 0] += 2.0 * states[0, 0, :, 0]
    assert rhat(_fake(draws, states, tilted))[0, 0] > 1.1


def test_rhat_of_one_run_is_nan(draws):
    assert np.isnan(rhat(_fake(draws, draws.states["pose"][:1], draws.log_weights[:1]))).all()


def test_markers_are_computed_on_demand(draws):
    poses = mean_poses(draws)
    positions = markers(draws.model, poses)
    assert positions.shape == (RUNS, FRAMES, 3, 3)
    assert np.allclose(positions[1, 2], draws.model.markers(jnp.asarray(poses[1, 2])), atol=1e-5)
