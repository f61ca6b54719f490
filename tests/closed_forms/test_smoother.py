"""Particle belief propagation over time, with the program inference/particle_bp_smoother.py: the Kalman smoother, and a filter of many particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body import edge_factor, graph, kernels, node_factor

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("optimised")]

PROGRAM = "particle_bp_smoother.py"
FIRST_SD, SEEN_SD, RUNS = np.array([0.8, 4.0]), 0.1, 20


def kalman(program, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Means and standard deviations given all angles seen, and the log-evidence, by the filter forwards and by Rauch, Tung & Striebel backwards."""
    on, root = np.asarray(program.ON, float), np.asarray(program.ROOT, float)
    noise, look = root @ root.T, np.array([1.0, 0.0])
    mean, covariance, evidence = np.zeros(2), np.diag(FIRST_SD**2), 0.0
    predicted, filtered = [], []
    for angle in seen:
        predicted.append((mean, covariance))
        variance = look @ covariance @ look + SEEN_SD**2
        evidence -= 0.5 * ((angle - look @ mean) ** 2 / variance + np.log(2 * np.pi * variance))
        gain = covariance @ look / variance
        filtered.append((mean + gain * (angle - look @ mean), covariance - np.outer(gain, look @ covariance)))
        mean, covariance = on @ filtered[-1][0], on @ filtered[-1][1] @ on.T + noise
    smoothed = [filtered[-1]]
    for (mean, covariance), (ahead, spread) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        gain = covariance @ on.T @ np.linalg.inv(spread)
        smoothed.append((mean + gain @ (smoothed[-1][0] - ahead), covariance + gain @ (smoothed[-1][1] - spread) @ gain.T))
    means, covariances = zip(*smoothed[::-1], strict=True)
    return np.array(means), np.sqrt([np.diagonal(one) for one in covariances]), float(evidence)


def log_angle(seen, state):
    return -0.5 * ((seen - state[0]) / SEEN_SD) ** 2 - jnp.log(SEEN_SD * jnp.sqrt(2 * jnp.pi))


def angles_seen(frames: int) -> np.ndarray:
    rng = np.random.default_rng(2)
    return 0.6 * np.cos(np.arange(frames) / 4) + SEEN_SD * rng.normal(size=frames)


def linear(program, seen: np.ndarray, draw):
    """The swing of the program, seen as angles: all of it is linear and normal."""
    return graph(
        {"frame": (len(seen), 2)},
        node_factor("first", jax.tree_util.Partial(program.dist.Normal(0.0, jnp.asarray(FIRST_SD)).to_event(1).log_prob), [0]),
        node_factor("seen", log_angle, parameters=jnp.asarray(seen)),
        edge_factor("step", program.log_step, [(i, i + 1) for i in range(len(seen) - 1)], draw=draw),
        program.bb.proposal("first", program.dist.Normal(0.0, jnp.asarray(FIRST_SD)).to_event(1), [0]),
    )


def found_by(built, samples: int, runs: int, iterations: int = 3):
    """Beliefs on the points of the joint draws, and the log-evidence, of independent runs."""
    sampler = kernels.particle_bp(samples=samples, iterations=iterations, schedule="tree", particles=100)
    of = jax.jit(lambda keys, built: jax.lax.map(lambda key: (joint := sampler.on(key, built).joint, joint.log_evidence), keys))
    joint, evidence = of(jax.random.split(jax.random.key(0), runs), built)
    weights, points = np.exp(np.asarray(joint.log_beliefs, float))[..., None], np.asarray(joint.points, float)
    means = np.sum(weights * points, axis=2)
    return means, np.sum(weights * (points - means[:, :, None]) ** 2, axis=2), np.asarray(evidence, float)


def scores(program, draw=None):
    """Errors of means and variances, in standard errors over the runs; and the ratios of the evidence to the exact one."""
    seen = angles_seen(8)
    mean, sd, exact = kalman(program, seen)
    means, variances, evidence = found_by(linear(program, seen, draw or program.draw_step), 250, RUNS)
    errors = [each.mean(0) / each.std(0, ddof=1) * RUNS**0.5 for each in (means - mean, variances / sd**2 - 1)]
    return *errors, np.exp(evidence - exact), (means - mean) / sd


@pytest.mark.long
def test_it_is_the_kalman_smoother_where_all_is_normal(program):
    means, variances, ratios, off = scores(program)
    assert np.sqrt(np.mean(means**2)) < 1.6 and np.abs(means).max() < 4.5
    assert np.sqrt(np.mean(variances**2)) < 1.8
    assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / RUNS**0.5
    # A run is precise, too.
    assert np.sqrt(np.mean(off**2)) < 0.14


@pytest.mark.long
def test_a_step_back_in_time_that_keeps_the_angle_is_found_out(program):
    """Draws that are not from the density that the weights divide by."""

    def draw(key, parameters, known, reverse):
        drawn = program.draw_step(key, parameters, known, reverse)
        return known + (drawn - program.BACK @ known) if reverse else drawn

    means, variances, *_ = scores(program, draw)
    assert np.sqrt(np.mean(means**2)) > 2.5 or np.sqrt(np.mean(variances**2)) > 2.5


def filtered_evidence(program, seen: np.ndarray, particles: int, seed: int) -> float:
    """The log-evidence of the pixels by a particle filter that resamples in every frame: the program's model, written once more in NumPy."""
    rng = np.random.default_rng(seed)
    on, root = np.asarray(program.ON, float), np.asarray(program.ROOT, float)
    states, total = FIRST_SD * rng.normal(size=(particles, 2)), 0.0
    for pixel in seen:
        height = program.FOCAL_PX * program.THIGH_M * np.cos(states[:, 0]) / (program.AWAY_M - program.THIGH_M * np.sin(states[:, 0]))
        # Student's t of four degrees of freedom.
        weights = 3 / (8 * program.PIXEL_SD) * (1 + ((pixel - height) / program.PIXEL_SD) ** 2 / 4) ** -2.5
        total += np.log(weights.mean())
        levels = (np.arange(particles) + rng.uniform()) / particles * weights.sum()
        states = states[np.searchsorted(np.cumsum(weights), levels).clip(max=particles - 1)] @ on.T + rng.normal(size=(particles, 2)) @ root.T
    return total


@pytest.mark.long
def test_the_evidence_of_a_swing_with_two_explanations(program):
    """Angles that the camera cannot tell apart: beliefs have two peaks, and the filter of many particles has the same evidence."""
    _, seen = program.recording(0)
    seen = seen[:16]
    by_filter = np.array([filtered_evidence(program, seen, 100_000, seed) for seed in range(10)])
    built = program.swing(seen)
    _, variances, evidence = found_by(built, 1000, 8)
    ratios, exact = np.exp(evidence - by_filter.mean()), np.exp(by_filter - by_filter.mean())
    error = np.hypot(ratios.std(ddof=1) / 8**0.5, exact.std(ddof=1) / 10**0.5)
    assert abs(ratios.mean() - exact.mean()) < 4 * error
    # The masses of the two explanations are what differs between runs.
    assert error < 0.25
    assert np.degrees(np.sqrt(variances[:, 12, 0].mean())) > 20
