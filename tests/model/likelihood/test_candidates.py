"""Keypoints of several people as alternatives of one: the formula written out, its slope, and what must not change it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from bayes_body.base.registry import find
from bayes_body.density.expansion import without_negative
from bayes_body.density.factor import Variable
from bayes_body.recording.evidence.markers import MARKERS, CandidateEvidence, MarkerEvidence

POSE, CAMERAS = Variable("pose"), 2


def factor(scene):
    term = find("likelihood", "markers_gaussian")
    return term.build(name="markers", options=term.options(noise="student", degrees_of_freedom=3.0), body=scene.body, rig=scene.rig)


def detection(scene, f, seed, away_px=0.0):
    """A detection near the subject in each camera, or `away_px` to the right of it: pixels and confidence."""
    rng = np.random.default_rng(seed)
    pixels, confidence = np.zeros((CAMERAS, len(MARKERS), 2)), np.zeros((CAMERAS, len(MARKERS)))
    potential = f.log_potential.inner.args[0]
    expected = np.asarray(potential.expected(scene.pose))[..., :2]
    pixels[:, list(potential.places)] = expected + rng.normal(0, 6, expected.shape) + [away_px, 0]
    confidence[:, list(potential.places)] = rng.choice([0.1, 0.9], expected.shape[:2], p=[0.2, 0.8])
    return pixels, confidence


def evidence(detections, shares):
    pixels, confidence = (np.stack(arrays, axis=1) for arrays in zip(*detections, strict=True))
    return CandidateEvidence(jnp.asarray(pixels), jnp.asarray(confidence), jnp.asarray(np.broadcast_to(shares, (CAMERAS, len(detections)))))


def log_areas(scene):
    return np.log(np.prod(np.asarray(scene.rig.size), axis=1))


@jax.jit
def value_and_slope(f, pose, data):
    return jax.value_and_grad(lambda x: f({POSE: x}, {"markers": data}))(pose)


@jax.jit
def written_out(f, pose, detections, shares, log_areas):
    """The formula of the module, from today's density of one person in one camera."""

    def log_density(pose):
        cameras = []
        for c in range(CAMERAS):
            only = jnp.arange(CAMERAS)[:, None] == c
            terms = [jnp.log1p(-jnp.sum(shares))]
            for share, (pixels, confidence) in zip(shares, detections, strict=True):
                in_camera = jnp.where(only, confidence, 0.0)
                present = jnp.sum(in_camera > 0.3)
                terms.append(jnp.log(share) + f({POSE: pose}, {"markers": MarkerEvidence(pixels, in_camera)}) + present * log_areas[c])
            cameras.append(logsumexp(jnp.stack(terms)))
        return sum(cameras)

    return jax.value_and_grad(log_density)(pose)


def test_the_formula_written_out_and_its_slope(x64, scene):
    scene = scene("deutscher_31")
    f, shares = factor(scene), np.array([0.5, 0.3, 0.1])
    # The third is so far away that it decides nothing; the first two compete.
    detections = [detection(scene, f, 1, 4.0), detection(scene, f, 2), detection(scene, f, 3, 200.0)]
    expected, expected_slope = written_out(f, scene.pose, detections, shares, log_areas(scene))
    value, slope = value_and_slope(f, scene.pose, evidence(detections, shares))
    np.testing.assert_allclose(value, expected, rtol=1e-9)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-7, atol=1e-7)


def test_one_candidate_that_is_the_subject_has_todays_slope(x64, scene):
    scene = scene("deutscher_31")
    f = factor(scene)
    pixels, confidence = detection(scene, f, 1)
    today, slope = value_and_slope(f, scene.pose, MarkerEvidence(jnp.asarray(pixels), jnp.asarray(confidence)))
    value, same_slope = value_and_slope(f, scene.pose, evidence([(pixels, confidence)], [1.0]))
    np.testing.assert_allclose(value, today + np.sum((confidence > 0.3) * log_areas(scene)[:, None]), rtol=1e-9)
    np.testing.assert_allclose(same_slope, slope, rtol=1e-9)


def test_a_duplicate_counts_once_and_nobody_is_no_slope(x64, scene):
    scene = scene("deutscher_31")
    f = factor(scene)
    one, far = detection(scene, f, 1), detection(scene, f, 2, 400.0)
    single, double = (value_and_slope(f, scene.pose, evidence(people, shares)) for people, shares in (([one], [0.8]), ([one, one], [0.4, 0.4])))
    np.testing.assert_allclose(double[0], single[0], rtol=1e-9)
    np.testing.assert_allclose(double[1], single[1], rtol=1e-7)
    # A bystander far away, and an empty place: neither pulls.
    nobody = np.zeros_like(one[0]), np.zeros_like(one[1])
    value, slope = value_and_slope(f, scene.pose, evidence([far, nobody], [0.1, 0.0]))
    np.testing.assert_allclose(value, CAMERAS * np.log(0.9), rtol=1e-6)
    assert np.abs(slope).max() < 1e-9


def test_the_curvature_is_that_of_the_candidate_beyond_doubt(x64, scene):
    scene = scene("deutscher_31")
    f = factor(scene)
    one, far = detection(scene, f, 1), detection(scene, f, 2, 400.0)
    expected = f.log_potential.inner({POSE: scene.pose})

    @jax.jit
    def blocks(data):
        def outer(rows):
            return jnp.sum(f.log_potential.outer(rows, data))

        columns = [-jax.jvp(jax.grad(outer), (expected,), (jnp.zeros_like(expected).at[..., entry].set(1.0),))[1] for entry in range(2)]
        return without_negative(jnp.stack(columns, axis=-1).reshape(-1, 2, 2))

    alone = blocks(MarkerEvidence(*map(jnp.asarray, one)))
    np.testing.assert_allclose(blocks(evidence([far, one], [0.5, 0.4])), alone, atol=1e-9 * np.abs(alone).max())
