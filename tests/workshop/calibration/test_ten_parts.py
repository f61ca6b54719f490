"""Message passing on a body of ten parts with marked joints, arms hanging and hands on the hips, against tempered SMC and long Markov chains."""

from dataclasses import replace
from functools import cache

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from bayes_body.base.registry import find
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.kernels.messages.particle_bp import build_kernel
from bayes_body.kernels.smc.tempered_smc import build_kernel as tempered
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.placement import ByParts
from bayes_body.model.build import Model
from bayes_body.model.definition import load_definition
from bayes_body.workshop.calibration.scene import model_in_a_room

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("optimised")]
CHAINS, WARMUP, DRAWS, RUNS, SAMPLES, ANCESTORS = 4, 500, 2000, 8, 1000, 5
# What is aimed at: distance of a run's means on average, and of the worst marker.
AIM_MM = 5, 10
ARMS = ("shoulder_y", "shoulder_x", "shoulder_z", "elbow")


@cache
def model() -> Model:
    """loose_limbed_10 with the positions of its joints in four views, 8 px apart from the truth."""
    loose = load_definition("loose_limbed_10")
    markers = find("likelihood", "markers_gaussian").options(sd_px=8.0, at_diagonal_px=800.0)
    observation = find("observation", "markers_gaussian").options()
    return model_in_a_room(
        replace(loose, likelihoods=(replace(loose.likelihoods[0], kind="markers_gaussian", options=markers, observation=observation),))
    )


# Standing, arms hanging: the mean of the joints of loose_limbed_10.
STANDING = {"l_knee": -30, "r_knee": -30, "l_shoulder_y": -90, "l_elbow": -30, "r_shoulder_y": 90, "r_shoulder_z": 180, "r_elbow": -30}


def posed(hands_on_hips: bool) -> np.ndarray:
    """The joint angles, standing; with hands on the hips, forearms press on the torso."""
    body = model().body
    names, index = body.by_angles.dof_names, {name: number for number, name in enumerate(body.markers.names)}
    standing = np.zeros(len(names))
    for name, degrees in STANDING.items():
        standing[names.index(name)] = np.radians(degrees)
    free = np.array([names.index(f"{side}_{name}") for side in "lr" for name in ARMS])

    def marked(pose):
        return placed_markers(body, placed(pose))

    at = np.asarray(marked(standing), float)
    middle = (at[index["l_hip"]] + at[index["r_hip"]]) / 2
    wanted = {}
    for side in "lr":
        outwards = (at[index[f"{side}_hip"]] - middle) / np.linalg.norm(at[index[f"{side}_hip"]] - middle)
        wanted[index[f"{side}_wrist"]] = at[index[f"{side}_hip"]] + 0.2 * outwards + [0, 0, 0.16]
        wanted[index[f"{side}_elbow"]] = at[index[f"{side}_shoulder"]] + 0.18 * outwards + [0, 0, -0.27]

    def missed(arms):
        pose = jnp.asarray(standing).at[free].set(arms)
        return jnp.concatenate([(marked(pose)[jnp.array(list(wanted))] - jnp.array(list(wanted.values()))).ravel(), 0.01 * (arms - standing[free])])

    if hands_on_hips:
        found = least_squares(
            lambda arms: np.asarray(missed(arms), float), standing[free], lambda arms: np.asarray(jax.jacfwd(missed)(arms), float), ftol=1e-4
        )
        standing[free] = found.x
    return standing


def placed(pose: np.ndarray | jax.Array) -> jax.Array:
    """The parts of joint angles."""
    body = model().body
    assert isinstance(body.placement, ByParts)
    return body.placement.configuration(body.skeleton, jnp.asarray(pose, body.lengths.dtype))


def frame(hands_on_hips: bool) -> Density:
    """The density of a frame, given five poses of the frame before, with the markers of a sixth."""
    pose, rng = posed(hands_on_hips), np.random.default_rng(7 + hands_on_hips)
    # The first three are metres. The parts of a pose of the frame before hang together.
    poses = pose + rng.normal(size=(ANCESTORS, len(pose))) * np.where(np.arange(len(pose)) < 3, 0.01, np.radians(4))
    steps = jnp.stack([placed(one) for one in poses])
    before = Particles({"parts": steps}, jnp.full(ANCESTORS, -jnp.log(ANCESTORS)))
    density = model().density({}, before)
    return replace(density, data=density.simulate(jax.random.key(7 + hands_on_hips), {"parts": placed(pose)}))


def markers(parts: jax.Array) -> np.ndarray:
    """Positions of the markers, millimetres."""
    body = model().body
    found = jax.jit(lambda parts: jax.lax.map(lambda one: placed_markers(body, one), parts.reshape(-1, *parts.shape[-2:])))(parts)
    return 1000 * np.asarray(found, float).reshape(*parts.shape[:-2], -1, 3)


def long_chains(density: Density) -> np.ndarray:
    """Markers of the draws of Markov chains (chain, draw, marker, 3)."""

    def chain(key, density):
        target = density.unconstrained()
        warm_key, run_key = jax.random.split(key)
        start = target.unconstrain(density.ancestor(0))
        (state, parameters), _ = blackjax.window_adaptation(blackjax.nuts, target).run(warm_key, start, WARMUP)
        kernel = blackjax.nuts(target, **parameters)

        def step(state, key):
            state, _ = kernel.step(key, state)
            return state, target.constrain(state.position)["parts"]

        return jax.lax.scan(step, state, jax.random.split(run_key, DRAWS))[1]

    run = jax.jit(lambda keys, density: jax.lax.map(lambda key: chain(key, density), keys))
    return markers(run(jax.random.split(jax.random.key(1), CHAINS), density))


def independent_runs(kernel, density: Density, particles: int, runs: int):
    """Particles and figures of independent runs of a kernel, stacked."""
    # In blocks: the kernel keeps evenly spaced particles.
    copies = jnp.arange(particles) * ANCESTORS // particles
    before = Particles({"parts": density.previous.states["parts"][copies]}, jnp.full(particles, -jnp.log(particles)))
    run = jax.jit(lambda keys, density: jax.lax.map(lambda key: kernel(key, before, density), keys))
    return run(jax.random.split(jax.random.key(2), runs), density)


def weighted_moments(after: Particles) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of the markers in each run (run, marker, 3), millimetres."""
    weights, drawn = np.asarray(jax.nn.softmax(after.log_weights, axis=1), float)[..., None, None], markers(after.states["parts"])
    means = np.sum(weights * drawn, axis=1)
    return means, np.sqrt(np.sum(weights * (drawn - means[:, None]) ** 2, axis=1))


@pytest.mark.parametrize("hands_on_hips", [False, True])
def test_message_passing_agrees_with_tempering_and_long_chains(hands_on_hips):
    density = frame(hands_on_hips)
    tempered_after, tempered_info = independent_runs(tempered(move="hmc"), density, 1000, RUNS)
    each, spread = weighted_moments(tempered_after)
    truth, truth_sd = each.mean(0), np.sqrt((spread**2).mean(0) + each.var(0))
    after, info = independent_runs(build_kernel(samples=SAMPLES, ancestors=ANCESTORS), density, 500, RUNS)
    means, sds = weighted_moments(after)
    apart, ratio = np.linalg.norm(means - truth, axis=-1), np.sqrt((sds**2).mean(0)) / truth_sd
    log_evidence, reference = np.asarray(info.log_evidence, float), np.asarray(tempered_info.log_evidence, float)
    node_ess = np.asarray(info.messages["belief_ess"]).min() / SAMPLES
    print(
        f"hands on hips: {hands_on_hips}; means {apart.mean():.1f} mm, worst marker {apart.mean(0).max():.1f} mm, of a run {apart.max():.1f} mm; "
        f"sd of a marker {truth_sd.mean():.0f} mm, ratio {ratio.min():.2f} to {ratio.max():.2f}; log-evidence {log_evidence.mean():.2f} (sd of a run "
        f"{log_evidence.std(ddof=1):.2f}), tempered {reference.mean():.2f} ({reference.std(ddof=1):.2f}); node ESS {node_ess:.2f} S; "
        f"joint ESS {np.asarray(info.ess).min() / 500:.2f} of the draws"
    )
    # In standard deviations of the marker's place, a run is as accurate as 11 independent draws, or better.
    assert (apart.mean(0) / np.linalg.norm(truth_sd, axis=-1)).max() < 0.3
    assert ratio.min() > 0.9 and ratio.max() < 1.1
    error = np.hypot(log_evidence.std(ddof=1), reference.std(ddof=1)) / RUNS**0.5
    assert abs(log_evidence.mean() - reference.mean()) < 4 * error
    assert node_ess > 0.08
    if hands_on_hips:
        # With hanging arms, four such chains do not agree (R-hat 1.7), so they are no reference.
        chains = long_chains(density)
        split = chains.reshape(CHAINS * 2, DRAWS // 2, *chains.shape[2:])
        rhat = np.sqrt(1 + split.mean(1).var(0) / split.var(1).mean(0))
        print(
            f"R-hat of the chains {rhat.max():.3f}; their means {np.linalg.norm(chains.mean((0, 1)) - truth, axis=-1).mean():.1f} mm from tempering's"
        )
        assert rhat.max() < 1.02
        assert np.linalg.norm(chains.mean((0, 1)) - truth, axis=-1).max() < 10
    if apart.mean() >= AIM_MM[0] or apart.mean(0).max() >= AIM_MM[1]:
        pytest.xfail(
            f"everything else holds; means of a run are {apart.mean():.1f} mm away on average, of the worst marker {apart.mean(0).max():.1f}"
        )
