"""The posterior of an activity over the frames: weighted, by run, and only where there are several activities."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from bayes_body.view.report.activities import activity_details, activity_probabilities
from bayes_body.view.report.inspection import Inspection

LABELS = ["walk", "walk", "run"]


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    belief = rng.dirichlet(np.ones(3), size=(2, 7, 5))
    return belief, np.log(rng.dirichlet(np.ones(7), size=(2, 5)).swapaxes(1, 2))


def _inspection(belief, log_weights, labels=LABELS, mode_seeker=False):
    names = [f"{label}_{k + 1}" for k, label in enumerate(labels)]
    posterior = xr.Dataset({"belief": (("chain", "draw", "frame", "state"), belief)}, {"state": names})
    stats = xr.Dataset({"log_weight": (("chain", "draw", "frame"), log_weights)})
    tree = xr.DataTree.from_dict({"posterior": posterior, "sample_stats": stats})
    it = object.__new__(Inspection)
    it.__dict__.update(run=SimpleNamespace(tree=tree, frames=belief.shape[2]), diagnosis=SimpleNamespace(mode_seeker=mode_seeker), fps=60.0)
    return it


def test_probabilities_are_weighted_means_of_the_states_of_an_activity(arrays):
    belief, log_weights = arrays
    found = activity_probabilities(belief, np.exp(log_weights), LABELS)
    expected = sum(np.exp(log_weights[1, k, 3]) * belief[1, k, 3, 2] for k in range(7))
    assert list(found) == ["walk", "run"] and found["run"][1, 3] == pytest.approx(expected)
    assert np.allclose(found["walk"] + found["run"], 1)


def test_the_report_has_a_panel_for_each_of_several_activities(arrays):
    page = activity_details(_inspection(*arrays))
    assert page.count("<img") == 2 and "Probability of the activity run over the frames" in page
    assert activity_details(_inspection(*arrays, labels=["walk"] * 3)) is None
    assert activity_details(_inspection(*arrays, mode_seeker=True)) is None
