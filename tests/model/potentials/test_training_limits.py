"""Angles beyond those of the training motions have no weight."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.density.factor import Variable
from bayes_body.model.body.build import build_body
from bayes_body.model.definition import load_body

POSE = Variable("pose")


def _factor(path, **options):
    term, body = find("potential", "training_limits"), build_body("deutscher_31", load_body("deutscher_31"))
    return term.build(name="limits", options=term.options(activity=str(path), **options), body=body), body


def test_only_learned_angles_are_limited_and_a_margin_widens_them(tmp_path):
    path = tmp_path / "ranges.npz"
    np.savez(path, names=np.array(["r_knee", "l_hip_y"]), low=np.array([-1.0, -0.5]), high=np.array([-0.1, 0.5]))
    factor, body = _factor(path)
    wide, _ = _factor(path, margin_deg=10.0)
    inside = np.zeros(len(body.dof_names))
    inside[body.dof_names.index("r_knee")] = -0.5
    inside[body.dof_names.index("l_knee")] = -2.0
    assert factor.side == "constraint" and float(factor({POSE: jnp.asarray(inside)}, {})) == 0
    for name, angle in (("r_knee", 0.0), ("r_knee", -1.1), ("l_hip_y", 0.6), ("l_hip_y", -0.6)):
        beyond = inside.copy()
        beyond[body.dof_names.index(name)] = angle
        assert float(factor({POSE: jnp.asarray(beyond)}, {})) == -np.inf
        assert float(wide({POSE: jnp.asarray(beyond)}, {})) == 0


@pytest.mark.parametrize(
    "arrays", [{"names": np.array(["tail"]), "low": [0.0], "high": [1.0]}, {"names": np.array(["l_knee"]), "low": [0.0]}, {"x": [0.0]}]
)
def test_other_ranges_are_a_sentence(tmp_path, arrays):
    path = tmp_path / "ranges.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="ranges of dofs of the body 'deutscher_31'; make one with `bayes-body learn activity-hmm`"):
        _factor(path)
    with pytest.raises(InputError, match="no such file"):
        _factor(tmp_path / "none.npz")
