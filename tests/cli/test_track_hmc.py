"""bayes-body track with the hybrid Monte Carlo filter: its options, what its chains leave, and a step that moves nothing."""

import json
import tomllib

import pytest
import xarray as xr

HMC = ["--model", "poon_fleet_2002_legs", "--particles", 8, "--leapfrog-steps", 2, "--frames", 2, "--set", "chains=2", "--set", "burn_in=2"]


@pytest.mark.long
def test_the_options_of_hmc_and_what_its_chains_leave(cli, walk, tmp_path):
    outcome = cli("track", walk, "--out", tmp_path / "run", *HMC, "--set", "step=0.1")
    assert outcome.status == 0, outcome.err
    assert "edge_phase: it reads grey levels; colour images are converted" in outcome.out
    kept = tomllib.loads((tmp_path / "run" / "run.toml").read_text(encoding="utf-8"))["kernel"]
    assert kept["chains"] == 2 and kept["burn_in"] == 2 and kept["step"] == 0.1
    with xr.open_datatree(tmp_path / "run" / "posterior.nc") as tree:
        filtered = tree["filter"].load()
    assert filtered["markov_acceptance"].dims == ("chain", "frame", "markov_chain") and filtered["markov_acceptance"].shape == (1, 2, 2)
    assert filtered["markov_ess"].dims == ("chain", "frame", "dof") and (filtered["markov_length"] == 4).all()
    assert "divergences" in json.loads((tmp_path / "run" / "summary.json").read_text())


@pytest.mark.long
def test_a_step_that_diverges_everywhere_stops_with_a_smaller_one(cli, walk, tmp_path):
    found = ["frame 0: no chain moves", "at a step factor of 50 the acceptance is", "trajectories diverged", "try step=0.2"]
    cli("track", walk, "--out", tmp_path / "run", *HMC, "--set", "step=50").refuses(*found)
