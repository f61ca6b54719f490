"""docs/guide/plugins.md: its fifteen lines and its program run on the real recording that they name, its likelihood and its kernel in a room."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_terms import plugins_of_this_test

import bayes_body as bb
from bayes_body.base.registry import find
from bayes_body.cli.main import main
from bayes_body.initial import apply_first_pose, first_pose
from bayes_body.model.definition import load_definition
from bayes_body.model.plugins.load import check_own_factors, load_plugin
from bayes_body.recording.observation.frames import read_frame
from bayes_body.workshop.calibration.scene import model_in_a_room

GUIDE = (Path(__file__).parents[2] / "docs" / "guide" / "plugins.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)
PLUGIN, PROGRAM, LIKELIHOOD, KERNEL = (text for language, text in BLOCKS if language == "python")
DEFINITION, ARM = (text for language, text in BLOCKS if language == "toml")
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


@pytest.fixture
def arm(tmp_path):
    """The folder with the complete likelihood and kernel, and the definition that names them."""
    for name, text in (("laplace_keypoints.py", LIKELIHOOD), ("resample_move.py", KERNEL), ("arm_laplace.toml", ARM)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("text", [PLUGIN, LIKELIHOOD, KERNEL], ids=["robust", "likelihood", "kernel"])
def test_its_plugins_need_public_names_only(text):
    imported = set(re.findall(r"^(?:import|from) (\S+)", text, re.MULTILINE))
    assert imported <= {"jax", "jax.numpy", "numpy", "bayes_body"}
    public = set(re.findall(r"`bb\.(\w+)`", GUIDE.split("## Public names")[1].split("##")[0]))
    assert set(re.findall(r"\bbb\.(\w+)", text)) <= public <= set(bb.__all__)


def test_its_complete_terms_pass_the_first_look(arm):
    check, _ = [command for command in COMMANDS if "arm_laplace" in command]
    _give(arm, check)


@pytest.mark.slow
def test_its_kernel_samples_the_posterior_that_sir_samples(arm):
    """One frame of the arm in a room, simulated by the likelihood: means and evidence agree within their Monte Carlo errors."""
    for name in ("laplace_keypoints.py", "resample_move.py"):
        load_plugin(arm / name)
    model = model_in_a_room(load_definition(arm / "arm_laplace.toml"))
    particles, density = model.start(2000), model.density({})
    truth = model.transition.sample(jax.random.key(1), model.initial)
    density = replace(density, data=density.simulate(jax.random.key(2), truth))
    check_own_factors(density, model.initial)
    assert set(density.parts(truth)) == {"transition", "laplace_keypoints"}
    means, errors, evidence = [], [], []
    for kind in ("resample_move", "sir"):
        options = find("kernel", kind).options()
        kernel = jax.jit(find("kernel", kind).build(options=options))
        found, info = jax.device_get(kernel(jax.random.key(3), particles, density.with_previous(particles)))
        weights = np.exp(found.log_weights)
        mean = weights @ found.states["pose"]
        means.append(mean)
        # After moves fewer particles have equal states than the weights before them say: this error is on the safe side.
        errors.append(np.sqrt(weights @ (found.states["pose"] - mean) ** 2 / info.ess))
        evidence.append(info.log_evidence)
        assert not info.lost and info.ess > 100
    np.testing.assert_array_less(np.abs(means[0] - means[1]), 5 * np.hypot(*errors))
    assert abs(evidence[0] - evidence[1]) < 5 * np.sqrt(2 / 100)


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_its_kernel_passes_the_check(arm):
    _, calibrate = [command for command in COMMANDS if "arm_laplace" in command]
    _give(arm, calibrate, "--replications", "40", "--bins", "5", "--frames", "1", "--particles", "500", "--jobs", "1")


@pytest.mark.slow
def test_its_terms_are_the_definition_s(folder):
    check, _ = [command for command in COMMANDS if "models check" in command]
    _give(folder, check)


@pytest.mark.long
def test_its_program_runs_and_a_wrong_keypoint_moves_the_pose_little(folder, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    # The smaller program of the two: compiling is what takes time here.
    exec(compile(PROGRAM.replace("session, model,", 'session, model, model.kernel("sir"),'), "plugins.md", "exec"), names)
    assert len(names["draws"].frames) == 3 and names["draws"].frames_lost == []
    session = names["session"]
    model = apply_first_pose(names["model"], session, first_pose(names["model"], session))
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

    from bayes_body.results.storage.saved_moments import marker_moments
    from bayes_body.results.storage.saved_run import load_run

    (track,) = [command for command in COMMANDS if "bayes-body track" in command]
    (report,) = [command for command in COMMANDS if "bayes-body report" in command]
    _give(folder, track, "--frames", "30")
    _give(folder, report)
    load_plugin(folder / "robust_keypoints.py")
    with load_run(folder / "beam_run") as saved:
        names = saved.model.body.markers.names
        far = np.linalg.norm(marker_moments(saved).mean - triangulated(pose2sim_beam, saved.session, names)[:30], axis=-1)
    assert np.nanmedian(far) < 0.06 and np.nanmax(np.nanmedian(far, axis=1)) < 0.1
