"""Message passing in a posterior: its worst figures, and the sentences that name frames, parts and remedies."""

import numpy as np
import pytest
import xarray as xr

from bayes_body.results.posterior.diagnostics import diagnose, sentences, worst_figures
from bayes_body.results.posterior.message_passing import DIMS, message_passing_of

RUNS, FRAMES, ITERATIONS, SAMPLES = 2, 4, 5, 200
PARTS = ("torso", "l_calf", "r_calf")
SOUND = {"samples": SAMPLES, "belief_ess": 60, "message_ess": 20, "message_change": 0.2, "belief_sd": 0.01, "oscillation": 0.1, "joint_ess": 100}
SIZES = {"node": len(PARTS), "iteration": ITERATIONS, "tangent": 6, "proposal": 4}


@pytest.fixture
def passed(make_tree):
    """`passed(belief_ess=(where, value))`: a tree of a kernel that passes messages, sound but for one value at (run, frame, ...)."""

    def call(ess=400, **changed):
        log_weight = np.full((RUNS, 400, FRAMES), -np.inf)
        log_weight[:, :ess] = -np.log(ess)
        arrays = {}
        for name, dims in DIMS.items():
            values = np.full((RUNS, FRAMES, *(SIZES[dim] for dim in dims)), SOUND.get(name, 0.25), float)
            if name == "message_change":
                values[:, :, 0] = np.nan
            if name in changed:
                where, value = changed[name]
                values[where] = value
            arrays[name] = (("chain", "frame", *("part" if dim == "node" else dim for dim in dims)), values)
        tree = make_tree("particle_bp", runs=RUNS, draws=400, frames=FRAMES, log_weight=log_weight)
        coordinates = {"part": list(PARTS), "tangent_unit": ("tangent", ["m"] * 3 + ["rad"] * 3)}
        tree["filter"] = xr.DataTree(tree["filter"].to_dataset().assign(arrays).assign_coords(coordinates))
        return tree

    return call


def test_a_kernel_without_messages_has_no_such_figures(make_tree):
    diagnosis = diagnose(make_tree())
    assert diagnosis.messages is None and "joint_ess_min" not in worst_figures(diagnosis)


def test_a_sound_run_says_nothing_and_has_its_worst_figures(passed):
    tree = passed(message_change=((1, 2, 1, 0), 9.0))
    diagnosis = diagnose(tree)
    assert sentences(diagnosis) == []
    expected = {"belief_ess_min": 60, "message_ess_min": 20, "message_change_last": 0.2, "oscillation_max": 0.1, "joint_ess_min": 100}
    assert expected.items() <= worst_figures(diagnosis).items()
    assert message_passing_of(tree).nodes == PARTS and message_passing_of(tree).units[3] == "rad"


CROSSED = {
    "belief": (
        {"belief_ess": ((1, 2, 1), 6.0)},
        "frame 2: the belief of l_calf rests on 6.0 effective particles of 200 (limit 10)",
        "--set samples=400",
    ),
    "message": ({"message_ess": ((0, slice(1, 3)), 3.0)}, "frames 1-2: a message rests on 3.0 effective particles of 200", "--set samples=400"),
    "converging": (
        {"message_change": ((0, 1, -1, 2), 0.8)},
        "frame 1: the belief of r_calf still moved by 0.8 sd in the last iteration (limit 0.5): it has not converged",
        "--set iterations=10",
    ),
    "noise": (
        {"message_change": ((0, 1, -1, 2), 0.8), "belief_ess": ((0, 1, 2), 11.0)},
        "frame 1: the belief of r_calf still moved by 0.8 sd in the last iteration (limit 0.5): so much is the noise",
        "--set samples=400",
    ),
    "oscillation": ({"oscillation": ((1, 3, 0), 1.5)}, "frame 3: the belief of torso jumps back and forth by 1.5 sd (limit 1)", 'schedule="tree"'),
    "joint": ({"joint_ess": ((1, 0), 4.0)}, "frame 0: 4.0 effective joint draws of 400 (limit 10)", "--kernel tempered"),
}


@pytest.mark.parametrize("limit", CROSSED)
def test_a_sentence_names_frames_part_and_remedy(passed, limit):
    changed, words, remedy = CROSSED[limit]
    (sentence,) = sentences(diagnose(passed(**changed)))
    assert sentence.startswith(words) and remedy in sentence


def test_few_effective_joint_draws_are_said_once(passed):
    few = [text for text in sentences(diagnose(passed(ess=4, joint_ess=(..., 4.0)))) if "effective" in text]
    assert len(few) == 1 and "joint draws" in few[0]
    some = [text for text in sentences(diagnose(passed(ess=30, joint_ess=(..., 30.0)))) if "effective" in text]
    assert len(some) == 1 and "frames 0-3: 30 effective particles of 400" in some[0]


def test_a_single_iteration_has_no_change(passed):
    diagnosis = diagnose(passed(message_change=(..., np.nan), oscillation=(..., np.nan)))
    assert worst_figures(diagnosis)["message_change_last"] is None and worst_figures(diagnosis)["oscillation_max"] is None
    assert sentences(diagnosis) == []
