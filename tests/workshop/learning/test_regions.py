"""What is in the regions of a part: pooled sums, a simulated walker through the command line, and that the likelihood finds the walker's parts."""

import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learn_regions import Sums, fitted_to_truth, region_statistics, region_sums

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.model.definition import load_definition
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.read import load_session

MODEL = """
title  = "Parts in their regions"
source = "Sigal et al. 2011, (8) to (10)"

[body]
name = "person_31"
placement = "parts"

[dynamics]
kind = "rigid_walk"

[[likelihood]]
kind = "regions"

[kernel]
kind = "tempered"
particles = 100
"""


def test_images_are_pooled_by_their_pixels():
    found = region_statistics(
        [Sums(np.array([80.0, 10.0, 30.0, 400.0]), np.array([100.0, 50.0, 20.0, 100.0])), Sums(np.full(4, 15.0), np.full(4, 20.0))]
    )
    assert found.inside == pytest.approx(95 / 120) and found.band == pytest.approx(25 / 70) and found.pixels == 120
    assert found.edge_elsewhere == pytest.approx((45 / 40 + 415 / 120) / 2)


def test_nobody_in_the_images():
    with pytest.raises(InputError, match="no part of the body in any image"):
        region_statistics([])


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "regions.toml"
    path.write_text(MODEL, encoding="utf-8")
    return path


def test_a_recording_without_a_truth_and_a_model_without_regions_are_refused(model, textured_session):
    with pytest.raises(InputError, match="no truth"):
        next(region_sums(textured_session, load_definition(model), 1))
    with pytest.raises(InputError, match="its likelihoods are silhouette_edges; expected one of the kind regions"):
        next(region_sums(textured_session, load_definition("loose_limbed_10"), 1))


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walks") / "walk"
    with pytest.raises(SystemExit) as end:
        main(["simulate", "walk", "--subject", "3", "--seed", "3", "--frames", "6", "--out", str(folder)])
    assert end.value.code in (0, None)
    return folder


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_it_learns_and_finds_the_parts_of_a_simulated_walker(walk, model, program_runner):
    done = program_runner(Path(__file__).parents[3] / "inference" / "learn" / "learn_regions.py", walk, "--model", model, "--frames", 2)
    assert done.status == 0
    said = done.out
    learned = tomllib.loads(said[said.index("[likelihood") :])["likelihood"]["observation"]
    assert 0.75 < learned["inside"] < 1 and 0.1 < learned["band"] < 0.6 and learned["edge_elsewhere"] > 0

    session = load_session(walk)
    found, angles = fitted_to_truth(session, load_definition(model))
    parts = found.body.placement.configuration(found.body.skeleton, jnp.asarray(angles[3], jnp.float32))
    data = jax.tree.map(jnp.asarray, found.observe(read_frame(session, 3))["regions"])
    (plate,) = (factor.log_potential for factor in found.factors if factor.name == "regions")
    each = jax.jit(lambda parts: plate.log_potentials(parts, data))
    true = np.asarray(each(parts))
    shifts = 0.1 * np.concatenate([np.eye(3), -np.eye(3)])
    moved = np.array([each(parts.at[:, :3].add(jnp.asarray(shift, jnp.float32))) for shift in shifts])
    # Along its own axis a part may slide into its neighbour's silhouette; the whole body may not.
    assert (moved.sum(axis=1) < true.sum() - 1).all()
    assert (moved < true).mean() > 0.8
