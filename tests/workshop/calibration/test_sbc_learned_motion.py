"""Learned motion priors on one leg: ranks of the derived pose and the markers are uniform for every sampler. What is learned is made up."""

import jax
import numpy as np
import pytest

from bayes_body.base.registry import find
from bayes_body.base.toml.read import validate
from bayes_body.model.definition import parse_definition
from bayes_body.model.dynamics.activity import Activity, save_activity
from bayes_body.model.dynamics.angle_cycle import AngleCycle, save_angle_cycle
from bayes_body.workshop.calibration import bands
from bayes_body.workshop.calibration.check import SBC, experiments
from bayes_body.workshop.calibration.problem import problem_of
from bayes_body.workshop.calibration.scene import model_in_a_room

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("optimised")]

REPLICATIONS, BINS, SEED = 200, 10, 5
# One leg in three has its smallest p-value of some thirty quantities below 0.05 / 3 by chance: the limit is shared among the quantities.
LIMIT = 0.05 / 30

MODEL = """
title = "One walking leg, its markers seen with Gaussian noise"
source = "a test"

[body]
title = "one leg"
source = "a test"
height_m = 1.75

[body.lengths_of_height]
pelvis = 0.1
thigh = 0.245
calf = 0.246

[[body.joint]]
name = "root"
parent = "world"
dofs = [
  { name = "root_x", axis = "tx" }, { name = "root_y", axis = "ty" }, { name = "root_z", axis = "tz" }, { name = "root_yaw", axis = "z" },
  { name = "root_roll", axis = "x", low_deg = -120, high_deg = 120 }, { name = "root_pitch", axis = "y", low_deg = -120, high_deg = 120 },
]

[[body.joint]]
name = "hip"
parent = "root"
preset = ["y180"]
dofs = [{ name = "hip", axis = "-y", low_deg = -120, high_deg = 120 }]

[[body.joint]]
name = "knee"
parent = "hip"
offset = { z = "thigh" }
dofs = [{ name = "knee", axis = "-y", low_deg = -155, high_deg = 10 }]

[[body.part]]
name = "pelvis"
joint = "root"
length = "pelvis"
radius_of_height = [0.09, 0.09]

[[body.part]]
name = "thigh"
joint = "hip"
length = "thigh"
radius_of_height = [0.06, 0.04]

[[body.part]]
name = "calf"
joint = "knee"
length = "calf"
radius_of_height = [0.04, 0.02]

[body.markers]
pelvis = { joint = "root", offset = { z = "pelvis" } }
l_hip = { joint = "hip" }
l_knee = { joint = "knee" }
l_ankle = { joint = "knee", offset = { z = "calf" } }

[dynamics]
DYNAMICS
position_sd_m = 0.02
orientation_sd_deg = 3.0
at_fps = 60

[[likelihood]]
kind = "markers_gaussian"
sd_px = 8.0
at_diagonal_px = 800.0

[kernel]
kind = "sir"
"""
DYNAMICS = {
    "walking_cycle": """
kind = "walking_cycle"
cycle = "FILE"
coefficient_sd = 0.5
phase_sd = 0.02
heading_sd_deg = 2.0
upright_s = 0.2
""",
    "activity_hmm": """
kind = "activity_hmm"
activity = "FILE"
residual_s = 0.1
momentum = 0.5
""",
}
KERNELS = {
    "sir": {"particles": 6000},
    "tempered": {"particles": 600, "moves": 3},
    "hmc": {"particles": 600, "chains": 4, "burn_in": 40, "leapfrog_steps": 10, "step": 0.4, "starts": 400, "mass": "curvature_matrix"},
}


@pytest.fixture(scope="module", params=DYNAMICS)
def problem(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("learned") / "leg.npz"
    (_save_cycle if request.param == "walking_cycle" else _save_activity)(path)
    text = MODEL.replace("DYNAMICS", DYNAMICS[request.param]).replace("FILE", str(path))
    return problem_of(model_in_a_room(parse_definition("leg", text, None)))


def _save_cycle(path):
    """Two modes, cut from a made-up gait."""
    rng, terms = np.random.default_rng(3), 7
    mean = np.zeros((terms, 2))
    mean[0], mean[1], mean[4], mean[5] = (-0.1, -0.6), (0.4, 0.1), (0.05, -0.4), (0.0, 0.2)
    cycle = AngleCycle("one leg", ("hip", "knee"), mean, 0.06 * rng.normal(size=(2, terms, 2)), np.array([0.9, 0.6]), 0.05 * rng.normal(size=(2, 2)),
                       np.full(2, 0.04), 0.95)  # fmt: skip
    save_angle_cycle(cycle, path)


def _save_activity(path):
    """One feature, which swings the leg between three states."""
    transition = np.array([[0.5, 0.4, 0.1], [0.1, 0.5, 0.4], [0.4, 0.1, 0.5]])
    swing = Activity(
        body="one leg", names=("hip", "knee"), subjects=("a", "b"), labels=("walk",) * 3, means=np.array([[-0.1, -0.6], [0.1, -0.7]]),
        between=np.full(2, 0.05), centre=np.zeros(2), basis=np.array([[0.8], [0.6]]), residual=np.full(2, 0.04), initial=np.full(3, 1 / 3),
        transition=transition, locations=np.array([[-0.3], [0.0], [0.3]]), covariances=np.array([[[0.01]], [[0.02]], [[0.01]]]),
        change=np.full(8, 0.02), low=-np.ones(2), high=np.ones(2), kept=1.0, fps=60.0,
    )  # fmt: skip
    save_activity(swing, path)


def _least_p(problem, kind):
    options = validate(find("kernel", kind).options, KERNELS[kind], kind)
    one = experiments(problem, kind, options, frames=2, bins=BINS, seed=SEED).by_name[SBC]
    found = jax.tree.map(np.asarray, jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(SEED), REPLICATIONS)))
    assert not found.refused.any()
    return bands.p_values(bands.rank_counts(found.ranks, BINS)).min()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["sir", pytest.param("tempered", marks=pytest.mark.long), pytest.param("hmc", marks=pytest.mark.long)])
def test_ranks_are_uniform(problem, kind):
    assert _least_p(problem, kind) > LIMIT
