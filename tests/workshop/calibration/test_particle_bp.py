"""`particle_bp` on a loose arm with several ancestors, against exact draws: of its prior, and by simulation-based calibration of its posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.calibration.limb import ANCESTORS, MARKERS, SILHOUETTES, draw_prior, limb, replicate

from bayes_body.kernels.messages.particle_bp import build_kernel
from bayes_body.recording.evidence.markers import MARKERS as NAMES
from bayes_body.recording.evidence.markers import MarkerEvidence
from bayes_body.workshop.calibration import bands

pytestmark = pytest.mark.usefixtures("optimised")
RUNS, REPLICATIONS, BINS, DRAWS = 16, 500, 10, 500


@pytest.mark.long
def test_without_data_the_draws_are_those_of_the_prior_and_the_evidence_is_one():
    """The prediction is a mixture over ancestors of products over parts, which no graph is: the weights have to make it one, in both normalisers."""
    arm = limb()
    unseen = MarkerEvidence(jnp.zeros((4, len(NAMES), 2)), jnp.zeros((4, len(NAMES))))
    exact = jax.jit(lambda keys, arm: jax.lax.map(lambda key: draw_prior(key, arm), keys))(jax.random.split(jax.random.key(1), 1500), arm)
    of_draws = jax.jit(lambda parts, arm: jax.lax.map(lambda one: arm.quantities(one, {"markers_gaussian": unseen})[:-1], parts))
    true = np.asarray(of_draws(exact, arm), float)
    kernel = build_kernel(samples=200, iterations=4, ancestors=ANCESTORS)
    # As many particles go in as come out: copies of the states before, by weight.
    copies = np.repeat(np.arange(3), np.round(np.exp(np.asarray(arm.before.log_weights)) * DRAWS).astype(int))
    before = arm.before._replace(states=jax.tree.map(lambda leaf: leaf[copies], arm.before.states), log_weights=jnp.full(DRAWS, -jnp.log(DRAWS)))

    def one(key, arm):
        after, info = kernel(key, before, arm.density({"markers_gaussian": unseen}, before))
        values = jax.lax.map(lambda parts: arm.quantities(parts, {"markers_gaussian": unseen})[:-1], after.states["parts"])
        weights = jnp.exp(after.log_weights)
        return info.log_evidence, weights @ values, weights @ values**2

    found = jax.jit(lambda keys, arm: jax.lax.map(lambda key: one(key, arm), keys))(jax.random.split(jax.random.key(2), RUNS), arm)
    log_evidence, means, squares = (np.asarray(each, float) for each in found)
    assert abs(log_evidence.mean()) < 4 * log_evidence.std(ddof=1) / RUNS**0.5
    for runs, draws in ((means, true), (squares, true**2)):
        error = np.hypot(runs.std(axis=0, ddof=1) / RUNS**0.5, draws.std(axis=0) / len(draws) ** 0.5)
        assert np.all(np.abs(runs.mean(axis=0) - draws.mean(axis=0)) < 4 * error)


@pytest.mark.long
@pytest.mark.parametrize(("likelihood", "draws", "iterations"), [(MARKERS, DRAWS, 5), (SILHOUETTES, 2 * DRAWS, 3)], ids=["markers", "silhouettes"])
def test_ranks_are_uniform(likelihood, draws, iterations):
    """Markers are factors of each part. Silhouettes read the whole limb, so that only the weights of the joint draws know them."""
    arm = limb(likelihood)
    one = replicate(build_kernel(samples=500, iterations=iterations, ancestors=ANCESTORS), draws, BINS)
    found = jax.jit(lambda keys, arm: jax.lax.map(lambda key: one(key, arm), keys))(jax.random.split(jax.random.key(3), REPLICATIONS), arm)
    assert not np.asarray(found.lost).any()
    p_values = bands.p_values(bands.rank_counts(np.asarray(found.ranks), BINS))
    print(f"smallest p {p_values.min():.4f} of {len(arm.names)}; effective draws {np.quantile(np.asarray(found.ess), [0, 0.05, 0.5])} of {draws}")
    assert p_values.min() > 0.05 / len(arm.names), dict(zip(arm.names, p_values, strict=True))
