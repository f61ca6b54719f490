"""The joint posterior of all frames as one Gaussian: the Kalman smoother where all is normal, and quadrature where a walk meets a limit."""

import dataclasses
import re
import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.geometry.camera import project
from bayes_body.cli.main import main
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.density.frames import stacked
from bayes_body.kernels.paths.joint import elimination
from bayes_body.kernels.paths.joint import path as joint
from bayes_body.kernels.paths.joint.path import FirstFrame, log_ratios, solve_path, window_log_weights
from bayes_body.model.build import build_model
from bayes_body.model.dynamics.diffusion import TruncatedWalk
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.session.read import save_session
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs import joint as joint_runs
from bayes_body.runs.joint import check_joint
from bayes_body.runs.run import run as track_run
from bayes_body.runs.settings import Settings
from bayes_body.tracking.joint import solve, without_limits
from bayes_body.view.report.page import page

FRAMES, ENTRIES = 12, 4
LOOK = np.array([[1.0, -0.5, 0.3, 0.0], [0.0, 1.0, 0.0, 0.2]])
LOOK_SD, WALK_SD, SPEED_SD, FIRST_SD, STEP = 0.4, np.array([0.02, 0.3]), np.array([0.5, 0.1]), np.array([1.0, 0.7, 0.5, 0.6]), 0.1
KEPT = 0.9
# Fixed, and not drawn from the model: the smoother's equations hold for any data.
SEEN = np.random.default_rng(0).normal(size=(FRAMES, 2)) * 2


def moving(previous):
    """Two numbers and their velocities, as in constant_velocity, without limits."""
    onward = dist.Normal(KEPT * previous["velocity"] - 0.2 * previous["pose"], jnp.asarray(SPEED_SD)).to_event(1)
    return {"pose": dist.Normal(previous["pose"] + STEP * previous["velocity"], jnp.asarray(WALK_SD)).to_event(1), "velocity": onward}


def looked(values, z):
    state = jnp.concatenate([values[Variable("pose")], values[Variable("velocity")]])
    return jnp.sum(dist.Normal(jnp.asarray(LOOK) @ state, LOOK_SD).log_prob(z))


def one_particle(state):
    return Particles({name: jnp.asarray(value)[None] for name, value in state.items()}, jnp.zeros(1))


def linear():
    transition = Transition("moving", jax.tree_util.Partial(moving), jax.tree_util.Partial(lambda state, scale: {}))
    factor = Factor("seen", "likelihood", (Variable("pose"), Variable("velocity")), jax.tree_util.Partial(looked))
    before = one_particle({"pose": np.zeros(2), "velocity": np.zeros(2)})
    frames = stacked([Density(transition, (factor,), {"seen": jnp.asarray(z)}, before) for z in SEEN])
    start = {"pose": jnp.ones((FRAMES, 2)), "velocity": jnp.zeros((FRAMES, 2))}
    return solve_path(frames, transition, FirstFrame(jnp.zeros(ENTRIES), jnp.diag(jnp.asarray(FIRST_SD**-2.0))), start), frames, start


def kalman():
    """Mean and covariance of all frames together: one large linear regression."""
    identity = np.eye(2)
    on = np.block([[identity, STEP * identity], [-0.2 * identity, KEPT * identity]])
    noise = np.concatenate([WALK_SD, SPEED_SD]) ** -2.0
    size = FRAMES * ENTRIES
    precision, right = np.zeros((size, size)), np.zeros(size)
    precision[:ENTRIES, :ENTRIES] += np.diag(FIRST_SD**-2.0)
    for t in range(FRAMES):
        here = slice(t * ENTRIES, (t + 1) * ENTRIES)
        precision[here, here] += LOOK.T @ LOOK / LOOK_SD**2
        right[here] += LOOK.T @ SEEN[t] / LOOK_SD**2
        if t:
            both = slice((t - 1) * ENTRIES, (t + 1) * ENTRIES)
            row = np.concatenate([-on, np.eye(ENTRIES)], axis=1)
            precision[both, both] += row.T @ (noise[:, None] * row)
    covariance = np.linalg.inv(precision)
    return covariance @ right, covariance


def test_mean_and_marginals_are_those_of_the_kalman_smoother():
    solved, _, _ = linear()
    mean, covariance = kalman()
    sd = np.sqrt(np.diagonal(covariance))
    assert int(solved.steps) <= 2
    # In single precision.
    assert np.abs((np.asarray(solved.mean).ravel() - mean) / sd).max() < 2e-3
    blocks = covariance.reshape(FRAMES, ENTRIES, FRAMES, ENTRIES)[np.arange(FRAMES), :, np.arange(FRAMES)]
    scale = np.sqrt(np.einsum("ti,tj->tij", *(2 * (np.diagonal(blocks, axis1=1, axis2=2),))))
    assert np.abs((np.asarray(solved.covariances()) - blocks) / scale).max() < 2e-3


def test_draws_have_the_covariance_of_the_kalman_smoother_across_frames():
    solved, _, _ = linear()
    mean, covariance = kalman()
    count = 20_000
    draws = np.asarray(solved.draw(jax.random.key(0), count)).reshape(count, -1)
    sd = np.sqrt(np.diagonal(covariance))
    assert np.abs((draws.mean(axis=0) - mean) / sd).max() < 2e-3  # pairs have their mean exactly
    correlation = covariance / np.outer(sd, sd)
    # Half of the draws are independent. The standard error of a correlation is at most 1 / sqrt(n).
    assert np.abs(np.cov(draws.T) / np.outer(sd, sd) - correlation).max() < 5.5 * np.sqrt(2 / (count / 2))


def test_what_hardly_moves_keeps_its_variance_in_single_precision():
    """Unknowns of a body: the noise of a frame is a thousandth of the prior, and differences of precisions would lose what frames add."""
    frames, rng = 100, np.random.default_rng(1)
    noise = np.array([1e-3, 3e-3, 0.3])
    on = np.diag(np.exp(-(noise**2) / 2))
    on[2, 0] = 0.5
    looks = rng.normal(size=(frames, 3)) * 0.3
    precision = looks[:, :, None] * looks[:, None]
    precision[0] += np.eye(3)
    links = np.array([[1.0, -1.0], [-1.0, 1.0]]) * (noise**-2.0)[None, :, None, None] * np.ones((frames - 1, 1, 1, 1))
    gradient = rng.normal(size=(frames, 3))
    whole = np.zeros((frames, 3, frames, 3))
    for t in range(frames):
        whole[t, :, t] += precision[t]
    for t in range(1, frames):
        row = np.concatenate([-on, np.eye(3)], axis=1)
        whole[t - 1 : t + 1, :, t - 1 : t + 1] += (row.T @ (noise[:, None] ** -2.0 * row)).reshape(2, 3, 2, 3)
    covariance = np.linalg.inv(whole.reshape(3 * frames, -1))
    slopes = np.broadcast_to(on, (frames - 1, 3, 3))
    arguments = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), (precision, elimination.Couplings(links, slopes), gradient))
    roots, couplings, y = elimination.eliminated(*arguments)
    sd = np.sqrt(np.diagonal(covariance)).reshape(frames, 3)
    marginals = np.sqrt(np.diagonal(np.asarray(elimination.marginal_covariances(roots, couplings)), axis1=1, axis2=2))
    assert np.abs(marginals / sd - 1).max() < 1e-3
    mean = (covariance @ gradient.ravel()).reshape(frames, 3)
    assert np.abs((np.asarray(elimination.solve_back(roots, couplings, y)) - mean) / sd).max() < 1e-3 * np.abs(mean / sd).max()


def test_all_weights_are_equal_where_all_is_normal():
    solved, frames, start = linear()
    ratios = log_ratios(frames, solved, solved.draw(jax.random.key(1), 50), start)
    for half_width in (0, 2, FRAMES):
        weights = np.asarray(window_log_weights(*ratios, half_width))
        assert np.abs(weights - weights.mean(axis=0)).max() < 0.02


@pytest.mark.slow
def test_a_coupling_of_the_wrong_frame_is_found_out(monkeypatch):
    monkeypatch.setattr(elimination, "_from_next", lambda couplings: couplings)
    jax.clear_caches()
    with pytest.raises(AssertionError):
        test_mean_and_marginals_are_those_of_the_kalman_smoother()
    jax.clear_caches()


# -- a walk between limits --------------------------------------------------------------------------------------------------------------------

SD, LOW, HIGH, SPREAD = np.array([0.3, 0.4]), np.array([0.0, -1.0]), np.array([5.0, 1.5]), np.array([0.5, 0.8])
FIRST = np.array([0.8, 0.6])
TARGETS = np.array([[0.8, 0.7], [0.4, 1.2], [0.9, 0.5]])


def walk(low, high, previous):
    return {"pose": TruncatedWalk(jnp.clip(previous["pose"], low, high), jnp.asarray(SD), low, high)}


def near_target(values, z):
    return jnp.sum(dist.Normal(values[Variable("pose")], jnp.asarray(SPREAD)).log_prob(z))


def limited(targets=TARGETS):
    low, high = jnp.asarray(LOW), jnp.asarray(HIGH)
    noise = jax.tree_util.Partial(lambda state, scale: {})
    transition = Transition("walk", jax.tree_util.Partial(walk, low, high), noise)
    unlimited = Transition("walk", jax.tree_util.Partial(walk, jnp.full(2, -jnp.inf), jnp.full(2, jnp.inf)), noise)
    factor = Factor("near", "likelihood", (Variable("pose"),), jax.tree_util.Partial(near_target))
    frames = stacked([Density(transition, (factor,), {"near": jnp.asarray(z)}, one_particle({"pose": FIRST})) for z in targets])
    start = {"pose": jnp.broadcast_to(jnp.asarray(FIRST), (len(targets), 2))}
    first = FirstFrame(jnp.asarray(FIRST), jnp.diag(jnp.asarray(SPREAD**-2.0)))
    return solve_path(frames, unlimited, first, start), frames, start


def by_quadrature(entry):
    """Means and standard deviations of one entry in three frames; the entries are independent."""
    edges = np.linspace(LOW[entry], HIGH[entry], 121)
    x = 0.5 * (edges[1:] + edges[:-1])
    normal = lambda value, centre, sd: np.exp(-0.5 * ((value - centre) / sd) ** 2)  # noqa: E731
    step = normal(x[None], x[:, None], SD[entry])
    step /= step.sum(axis=1, keepdims=True)
    weight = normal(x, FIRST[entry], SPREAD[entry])[:, None, None] * step[:, :, None] * step[None]
    for frame in range(3):
        weight = weight * normal(x, TARGETS[frame, entry], SPREAD[entry]).reshape([-1 if axis == frame else 1 for axis in range(3)])
    marginals = [weight.sum(axis=tuple({0, 1, 2} - {frame})) for frame in range(3)]
    means = np.array([marginal @ x / marginal.sum() for marginal in marginals])
    return means, np.sqrt([marginal @ (x - mean) ** 2 / marginal.sum() for marginal, mean in zip(marginals, means, strict=True)])


@pytest.mark.slow
def test_marginals_near_limits_are_close_to_those_of_quadrature():
    solved, _, _ = limited()
    assert int(solved.steps) <= 10 and float(solved.promise) < joint.TOLERANCE
    sd = np.sqrt(np.diagonal(np.asarray(solved.covariances()), axis1=1, axis2=2))
    for entry in range(2):
        means, spreads = by_quadrature(entry)
        # The normalisers of the steps have no site.
        assert np.abs((np.asarray(solved.mean)[:, entry] - means) / spreads).max() < 0.35
        assert np.abs(np.log(sd[:, entry] / spreads)).max() < 0.25


def test_weights_of_whole_paths_make_the_moments_those_of_quadrature():
    solved, frames, start = limited()
    paths = solved.draw(jax.random.key(2), 40_000)
    log_weights = np.asarray(window_log_weights(*log_ratios(frames, solved, paths, start), 3)[:, 1])
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    draws, effective = np.asarray(paths), 1 / np.sum(weights**2)
    assert effective > 2000
    for entry in range(2):
        means, spreads = by_quadrature(entry)
        weighted = weights @ draws[:, :, entry]
        assert np.abs((weighted - means) / spreads).max() < 4 / np.sqrt(effective)
        ratio = np.sqrt(weights @ (draws[:, :, entry] - weighted) ** 2) / spreads
        assert np.abs(ratio - 1).max() < 4 / np.sqrt(effective)


def test_paths_that_are_given_back_lie_inside_the_limits():
    solved, _, _ = limited()
    paths = np.asarray(solved.inside(solved.draw(jax.random.key(3), 500)))
    assert (paths >= LOW).all() and (paths <= HIGH).all()
    np.testing.assert_allclose(solved.low, LOW, atol=1e-6)
    np.testing.assert_allclose(solved.high, HIGH, atol=1e-6)


@pytest.mark.slow
def test_a_walk_that_is_pushed_far_beyond_its_limit_settles():
    targets = np.tile([[-3.0, 4.0]], (30, 1))
    solved, _, _ = limited(targets)
    assert float(solved.promise) < joint.TOLERANCE
    mean = np.asarray(solved.mean)
    assert (mean > LOW).all() and (mean < HIGH).all()


def test_a_transition_without_centres_is_refused():
    _, frames, start = limited()
    beta = Transition("beta", jax.tree_util.Partial(lambda previous: {"pose": dist.Beta(1 + previous["pose"], 2.0).to_event(1)}), lambda *_: {})
    with pytest.raises(InputError, match="no walk of independent numbers"):
        solve_path(frames, beta, FirstFrame(jnp.zeros(2), jnp.eye(2)), start)


# -- a filtered session -----------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def arm_session(textured_session, tmp_path):
    """Keypoints of an arm that bends slowly, without noise, in a folder of their own."""
    model, count = build_model("arm_markers", textured_session), textured_session.frames
    poses = model.initial["pose"] + 0.02 * jnp.arange(count)[:, None]
    named = {name: index for index, name in enumerate(model.body.markers.names)}
    views, pixels = [], jax.vmap(lambda pose: jax.vmap(lambda camera: project(camera, model.markers(pose))[0])(model.rig))(poses)
    for number, view in enumerate(textured_session.views):
        rows = np.zeros((count, len(MARKERS), 3))
        for place, name in enumerate(MARKERS):
            if name in named:
                rows[:, place, :2], rows[:, place, 2] = pixels[:, number, named[name]], 1.0
        write_series(tmp_path / f"{view.camera.name}.npz", KeypointSeries(rows, MARKERS, 0))
        shutil.copytree(textured_session.folder / view.camera.name, tmp_path / view.camera.name)
        views.append(dataclasses.replace(view, keypoints=f"{view.camera.name}.npz"))
    return dataclasses.replace(textured_session, folder=tmp_path, views=tuple(views))


@pytest.mark.slow
def test_a_run_is_smoothed_at_once_on_the_command_line(arm_session, tmp_path, monkeypatch, capsys):
    save_session(arm_session)
    run, out, frames = tmp_path / "run", tmp_path / "paths", arm_session.frames
    track_run(Settings(tmp_path, run, "arm_markers", "sir", {"particles": 500}, runs=2), lambda line: None, bar=False)
    command = ["smooth", str(run), "--start", "joint", "--draws", "60", "--out", str(out), "--no-pictures"]
    assert stopped(main, command) == 0
    printed = capsys.readouterr()
    assert "joint posterior: run 2 of 2: 0 Newton steps done, the next one promises" in printed.err
    assert re.search(r"joint +converged after \d+ Newton steps; Pareto k at most 0.7 in windows about \d+ % of the frames", printed.out)
    with load_run(out) as paths, load_run(run) as source:
        assert paths.smoothing["start"] == "joint" and "moves" not in paths.smoothing
        pose = paths.tree["posterior"]["pose"]
        assert pose.sizes == {"chain": 2, "draw": 60, "frame": frames, "dof": source.tree["posterior"].sizes["dof"]}
        np.testing.assert_allclose(paths.tree["sample_stats"]["log_weight"], -np.log(60), rtol=1e-6)
        # The posterior has one mode; both runs find it, from different starts.
        means, spreads = pose.mean("draw").values, pose.std("draw").values
        assert (np.abs(means[0] - means[1]) / spreads[0]).max() < 4 * np.sqrt(2 / 30)
        text = page(paths)
        assert "60 paths of each run from one Gaussian of all frames" in text and 'id="joint"' in text
        assert f"bayes-body smooth {run} --out {out}_again --draws 60 --start joint --seed 0" in text
        # A run that started anew, and one whose frames are too many for the memory.
        anew = [replace(frame, restarted=np.array([False, number == 3])) for number, frame in enumerate(FrameFiles(run / "frames"))]
        with pytest.raises(InputError, match=r"the filter started anew in frame 3; .* smooth by paths"):
            solve(source.session, source.model, anew, jax.random.key(1))
        with pytest.raises(InputError, match=r"GB of memory for 1000000000 frames at once"):
            check_joint(source.session, source.model, 10**9, 2, 60, [])
    # All frames exist: nothing is computed again.
    monkeypatch.setattr(joint_runs, "solve", None)
    before = (out / "posterior.nc").read_bytes()
    assert stopped(main, [*command, "--resume"]) == 0
    (out / "summary.json").unlink()
    assert stopped(main, [*command, "--resume"]) == 0
    assert (out / "posterior.nc").read_bytes() == before


def stopped(function, words) -> int:
    """The exit status of a command."""
    with pytest.raises(SystemExit) as status:
        function(words)
    return status.value.code


@pytest.mark.slow
def test_a_motion_prior_without_limits_is_the_same_far_from_them(keypoint_session):
    model = build_model("arm_markers", keypoint_session)
    state, low = dict(model.start(1).states), np.asarray(model.body.skeleton.low)
    state = {name: value[0] for name, value in state.items()}
    given, free = model.transition.conditional(state)["pose"], without_limits(model).conditional(state)["pose"]
    assert np.isfinite(low).any() and not np.isfinite(free.low).any()
    np.testing.assert_array_equal(free.scale, given.scale)
    beyond = jnp.where(jnp.isfinite(model.body.skeleton.low), model.body.skeleton.low - 1, state["pose"])
    assert np.isfinite(free.log_prob(beyond)) and not np.isfinite(given.log_prob(beyond))
