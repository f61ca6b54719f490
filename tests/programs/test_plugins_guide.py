"""docs/guide/plugins.md: its fifteen lines, its definition and its program run on the real recording that they name."""

import re
import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_terms import plugins_of_this_test

from bayes_body.cli.main import main
from bayes_body.initial import with_first_pose
from bayes_body.observation.frames import read_frame
from bayes_body.plugins.load import check_own_factors, load_plugin

GUIDE = (Path(__file__).parents[2] / "docs" / "guide" / "plugins.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)
PLUGIN, PROGRAM = (text for language, text in BLOCKS if language == "python")
(DEFINITION,) = (text for language, text in BLOCKS if language == "toml")
COMMANDS = "".join(text for language, text in BLOCKS if language == "sh").splitlines()
# The most that a keypoint with full confidence can cost in the guide's code.
FARTHEST = 5.0


@pytest.fixture(autouse=True)
def _as_it_was():
    with plugins_of_this_test():
        yield


@pytest.fixture(scope="module")
def folder(pose2sim_beam, tmp_path_factory):
    """Where the guide's commands are given: the recording, the session that the first command makes, the two files."""
    folder = tmp_path_factory.mktemp("plugins")
    (folder / "pose2sim_beam").symlink_to(pose2sim_beam)
    (folder / "robust_keypoints.py").write_text(PLUGIN, encoding="utf-8")
    (folder / "robust.toml").write_text(DEFINITION, encoding="utf-8")
    _give(folder, COMMANDS[0])
    return folder


def _give(folder, command, *more):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        with pytest.raises(SystemExit) as stopped:
            main([*shlex.split(command)[1:], *more])
        assert stopped.value.code == 0, command


def test_it_has_fifteen_lines():
    # Of code: the formatter's empty lines are its own.
    assert len([line for line in PLUGIN.splitlines() if line]) <= 15


@pytest.mark.slow
def test_its_terms_are_the_definition_s(folder):
    (check,) = [command for command in COMMANDS if "models check" in command]
    _give(folder, check)


@pytest.mark.long
def test_its_program_runs_and_a_wrong_keypoint_moves_the_pose_little(folder, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    # The smaller program of the two: compiling is what takes time here.
    exec(compile(PROGRAM.replace("session, model,", 'session, model, model.kernel("sir"),'), "plugins.md", "exec"), names)
    assert len(names["draws"].frames) == 3 and names["draws"].frames_lost == []
    session = names["session"]
    model = with_first_pose(names["model"], session)
    found, skeleton = model.initial, model.body.skeleton
    density = model.density(model.observe(read_frame(session, 0)))
    check_own_factors(density, found)
    value, gradient = jax.value_and_grad(lambda pose: density.parts({"pose": pose})["robust_keypoints"])(found["pose"])
    # Better than at the origin of the world, where the body is nowhere near its keypoints.
    origin = {"pose": jnp.clip(jnp.zeros_like(found["pose"]), skeleton.low, skeleton.high)}
    assert value > density.parts(origin)["robust_keypoints"] and np.isfinite(gradient).all() and np.abs(gradient).max() > 1
    here = density.data["robust_keypoints"]
    wrong = here._replace(pixels=here.pixels + np.array([3000.0, 0.0]) * (np.arange(15) == 4)[:, None])
    off = value - model.density({"robust_keypoints": wrong}).parts(found)["robust_keypoints"]
    assert 0 < off <= FARTHEST * here.confidence[:, 4].sum() + 1e-3


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_the_man_on_the_beam_is_tracked_with_it(folder, pose2sim_beam):
    from programs.test_beam import triangulated

    from bayes_body.storage.saved_moments import marker_moments
    from bayes_body.storage.saved_run import load_run

    (track,) = [command for command in COMMANDS if "bayes-body track" in command]
    (report,) = [command for command in COMMANDS if "bayes-body report" in command]
    _give(folder, track, "--frames", "30")
    _give(folder, report)
    load_plugin(folder / "robust_keypoints.py")
    with load_run(folder / "beam_run") as saved:
        names = saved.model.body.markers.names
        far = np.linalg.norm(marker_moments(saved).mean - triangulated(pose2sim_beam, saved.session, names)[:30], axis=-1)
    assert np.nanmedian(far) < 0.06 and np.nanmax(np.nanmedian(far, axis=1)) < 0.1
