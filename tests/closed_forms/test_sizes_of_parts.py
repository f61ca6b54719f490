"""Message passing between parts whose sizes are not known, against the exact answer of a linear Gaussian chain.

Part i has a place x and a size l, both numbers. The next part is attached at x + STEP + l. The place is seen, and so is the end x + 2 l.
"""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, Transition
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.density.sized_nodes import SizedPlate
from bayes_body.density.spaces import Plate as PlateSpace
from bayes_body.density.spaces import euclidean
from bayes_body.kernels.messages.particle_bp import build_kernel
from bayes_body.model.unknowns.apply import factor_with, transition_with
from bayes_body.model.unknowns.unknown import Unknown

# Many runs: for longer than they compile.
pytestmark = [pytest.mark.usefixtures("optimised"), pytest.mark.slow]
NAMES, DRAWS, RUNS = ("a", "b", "c"), 200, 20
STEP, WALK, JOINT, SEEN = 1.0, 0.8, 0.15, 0.3
SIZE_MEAN, SIZE_SD = 0.2, 0.25
PLACES, ENDS = np.array([0.1, 1.6, 2.5]), np.array([1.0, 1.9, 3.4])
partial = jax.tree_util.Partial


class _Walk(dist.Independent):
    def entries(self):
        return jax.vmap(lambda loc, scale: dist.Normal(loc, scale).to_event(1))(self.base_dist.loc, self.base_dist.scale)


def _walk(previous):
    return {"x": _Walk(dist.Normal(previous["x"], jnp.full((len(NAMES), 1), WALK)), 2)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], WALK * scale).to_event(2)}


def _log_normal(x, mean, sd):
    return jnp.sum(-0.5 * ((x - mean) / sd) ** 2 - jnp.log(sd) - 0.5 * jnp.log(2 * jnp.pi))


def _joint(step, first, second):
    return _log_normal(second - first, step, JOINT)


def _pairs(step, first, second):
    return jax.vmap(lambda x: jax.vmap(lambda y: _joint(step, x, y))(second))(first)


def _draw(key, step, known, reverse):
    length = step + JOINT * jax.random.normal(key, known.shape)
    return known - length if reverse else known + length


def _attached(step, log_first, log_second):
    del log_second
    return step + log_first


def _seen(place, entry, data):
    return _log_normal(data[place[0].astype(int)], entry[0] + place[1], SEEN)


def _at_end(place, log_size):
    return place.at[1].add(jnp.where(place[0] < len(NAMES), 0.0, 2 * log_size))


def _frame():
    """The density of a frame after one known state."""
    mean, sd = (jnp.full(len(NAMES), value) for value in (SIZE_MEAN, SIZE_SD))
    # Nothing of the distance to the mean is left in the next frame: the prediction is the prior.
    size = Unknown("lengths", euclidean(NAMES, ("",) * len(NAMES)), Plate, partial(_attached), mean, sd, jnp.full(len(NAMES), 1e-9))
    space = PlateSpace(NAMES, euclidean(("x",), ("",)))
    transition = transition_with(Transition("walk", partial(_walk), partial(_noise), spaces=(("x", space),)), (size,))
    order = np.arange(len(NAMES))
    edges = tuple((int(i), int(i) + 1) for i in order[:-1])
    functions = {"draw": partial(_draw), "pairwise": partial(_pairs), "resize": {"lengths": partial(_attached)}}
    joints = Plate("x", edges, partial(_joint), jnp.full(len(edges), STEP), **functions)
    rows = tuple((int(i),) for i in np.tile(order, 2))
    what = jnp.stack([jnp.arange(2.0 * len(NAMES)), jnp.zeros(2 * len(NAMES))], axis=1)
    seen = Plate("x", rows, partial(_seen), what, resize={"lengths": partial(_at_end)})
    terms = plate_factor("seen", "likelihood", seen), plate_factor("joint", "constraint", joints)
    factors = tuple(factor_with(factor, (size,)) for factor in terms)
    states = {"x": jnp.zeros((DRAWS, len(NAMES), 1)) + jnp.asarray(PLACES)[:, None], "lengths": jnp.full((DRAWS, len(NAMES)), SIZE_MEAN)}
    before = Particles(states, jnp.full(DRAWS, -np.log(DRAWS)))
    return Density(transition, factors, {"seen": jnp.asarray(np.concatenate([PLACES, ENDS]))}, before)


def _exact():
    """Mean and standard deviations of places and sizes, and the log of the integral: the product of normal factors, solved whole."""
    count = len(NAMES)
    x, size = np.eye(2 * count)[:count], np.eye(2 * count)[count:]
    rows = [*zip(x, PLACES, [WALK] * count, strict=True), *zip(size, [SIZE_MEAN] * count, [SIZE_SD] * count, strict=True)]
    rows += [(x[i + 1] - x[i] - size[i], STEP, JOINT) for i in range(count - 1)]
    rows += [*zip(x, PLACES, [SEEN] * count, strict=True), *zip(x + 2 * size, ENDS, [SEEN] * count, strict=True)]
    matrix, values, sds = (np.array(column) for column in zip(*rows, strict=True))
    whitened, target = matrix / sds[:, None], values / sds
    precision = whitened.T @ whitened
    mean = np.linalg.solve(precision, whitened.T @ target)
    evidence = -0.5 * np.sum((target - whitened @ mean) ** 2) - np.log(sds).sum() - 0.5 * np.linalg.slogdet(precision)[1]
    return mean, np.sqrt(np.diagonal(np.linalg.inv(precision))), evidence - 0.5 * (len(rows) - 2 * count) * np.log(2 * np.pi)


def _scores(**options):
    """Errors of means and of variances in their standard errors, and those of the evidence itself, over independent runs."""
    kernel = build_kernel(**{"samples": 200, "iterations": 4, **options})
    density = _frame()

    def run(key, density):
        after, info = kernel(key, density.previous, density)
        values, weights = jnp.concatenate([after.states["x"][..., 0], after.states["lengths"]], axis=1), jnp.exp(after.log_weights)
        mean = weights @ values
        return mean, weights @ (values - mean) ** 2, info.log_evidence

    keys = jax.random.split(jax.random.key(4), RUNS)
    found = jax.jit(lambda keys, density: jax.lax.map(lambda key: run(key, density), keys))(keys, density)
    means, variances, evidence = (np.asarray(values, float) for values in found)
    mean, sd, log_evidence = _exact()
    errors = (means - mean).mean(axis=0) / (means.std(axis=0, ddof=1) / RUNS**0.5)
    # A run's own mean is off, which takes a little from its variance.
    wide = variances + (means - mean) ** 2
    spread = (wide - sd**2).mean(axis=0) / (wide.std(axis=0, ddof=1) / RUNS**0.5)
    ratio = np.exp(evidence - log_evidence)
    return errors, spread, (ratio.mean() - 1) / (ratio.std(ddof=1) / RUNS**0.5), ratio.std(ddof=1)


def test_places_and_sizes_are_exact():
    means, variances, evidence, noise = _scores()
    assert np.abs(means).max() < 4.5 and np.sqrt(np.mean(means**2)) < 1.8
    assert np.abs(variances).max() < 4.5
    assert abs(evidence) < 4 and noise < 0.3


def _whole_prior(self, row, other, reverse):
    """The mutant counts the prior of sizes twice: they are drawn from it, and their weight has it again."""
    return jnp.zeros(())


def _fixed_joint(self, row, *entries):
    """The mutant leaves the joint where it is on a part of usual size."""
    of_one = [entry.at[..., -1].set(0.0) for entry in entries] if len(entries) == 2 else list(entries)
    return RESIZED(self, row, *of_one)


RESIZED = SizedPlate._resized
MUTANTS = {"prior twice": ("log_beside", _whole_prior), "joint not scaled": ("_resized", _fixed_joint)}


@pytest.mark.long
@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_wrong_size_is_found_out(monkeypatch, mutant):
    name, function = MUTANTS[mutant]
    monkeypatch.setattr(SizedPlate, name, function)
    means, _, evidence, _ = _scores()
    assert max(np.abs(means).max(), abs(evidence)) > 6
