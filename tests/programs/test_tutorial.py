"""docs/tutorial/one_frame.ipynb: its code runs as it is, with fewer draws, and two samplers of one density find the same posterior."""

import json
import os
import sys
import tempfile
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

NOTEBOOK = json.loads((Path(__file__).parents[2] / "docs" / "tutorial" / "one_frame.ipynb").read_text(encoding="utf-8"))
CODE = [(cell["metadata"].get("tags", []), "".join(cell["source"])) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
FEW = "DRAWS, WARM_UP, CHAINS = 200, 300, 2\nPARTICLES, RUNS = 500, 2"


def test_the_outputs_are_committed_and_none_is_an_error():
    cells = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = {output["output_type"] for cell in cells for output in cell["outputs"]}
    assert "error" not in kinds and "display_data" in kinds


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the notebook's cells define, one after another, with the numbers of its first cell replaced."""
    assert [tags for tags, _ in CODE].count(["parameters"]) == 1
    defined = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("tutorial")))
        patch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
        matplotlib.use("Agg")
        for number, (tags, source) in enumerate(CODE):
            exec(compile(FEW if tags == ["parameters"] else source, f"one_frame.ipynb #{number}", "exec"), defined)
    matplotlib.pyplot.close("all")
    return defined


@pytest.mark.long
def test_both_samplers_find_the_same_posterior(names):
    nuts, smc, prior = (names[name].reshape(-1, len(names["dofs"])) for name in ("poses", "particle_poses", "prior_draws"))
    sd = nuts.std(axis=0)
    # Two chains of 200 draws: a mean is known to about a tenth of a standard deviation, a standard deviation to as much.
    assert (abs(nuts.mean(axis=0) - smc.mean(axis=0)) < 0.6 * sd).all()
    assert (abs(np.log(smc.std(axis=0) / sd)) < 0.5).all()
    assert (sd / prior.std(axis=0)).min() < 0.7


@pytest.mark.long
def test_the_pictures_bring_the_pose_nearer_to_the_truth(names):
    def error(poses):
        joints = np.stack([names["model"].markers(jnp.asarray(pose)) for pose in poses.reshape(-1, len(names["dofs"]))[::20]])
        return np.linalg.norm(joints.mean(axis=0) - names["true_joints"], axis=-1).mean()

    assert error(names["poses"]) < 0.05
    assert error(names["particle_poses"]) < 0.05
