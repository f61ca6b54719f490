"""Every motion prior through every kernel and through the smoother, with particles spread over two devices.

Whether values differ between devices is part of their type, and JAX checks it when a program is traced: nothing is compiled here. Bodies are those of
the definitions; the likelihood is a normal one, so that motion prior and kernel are what is traced.
"""

from functools import cache

import jax
import jax.numpy as jnp
import pytest
from shared_fixtures import loose_limbed

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find, names
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Variable
from bayes_body.kernels import batching
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.model.build import body_of
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.tracking.backward import Backward, Filtered

COUNT, FRAMES = 6, 4


# A definition with each motion prior.
DEFINITIONS = {
    "activity_hmm": "darby_2008",
    "constant_velocity": "sidenbladh_2000_arm",
    "diffusion": "arm",
    "rigid_walk": "arm",
    "second_order": "arm_edges",
    "walking_cycle": "walker",
}


@pytest.fixture(autouse=True)
def spread(monkeypatch):
    """However few the particles are. The numbers of those that were spread."""
    counts = []
    monkeypatch.setattr(batching, "_devices", lambda count, batch: counts.append(count) or jax.devices())
    return counts


@cache
def _density(kind):
    """The density of a frame. Its states are all zeros, since only their form matters."""
    definition = load_definition(DEFINITIONS[kind])
    if kind == "rigid_walk":
        definition = parse_definition("arm", loose_limbed(definition.text), definition.body_text)
    body = body_of(definition)
    transition = find("dynamics", kind).build(options=definition.dynamics.options, body=body, fps=60.0)
    first = jax.eval_shape(transition.begin, {"pose": jnp.zeros(len(body.dof_names))})
    states = jax.tree.map(lambda leaf: jnp.zeros((COUNT, *leaf.shape), leaf.dtype), dict(first))
    variable = Variable(body.variable)
    normal = jax.tree_util.Partial(lambda values, data: -50.0 * jnp.sum(values[variable] ** 2))
    return Density(transition, (Factor("near", "likelihood", (variable,), normal),), {}, Particles(states, jnp.full(COUNT, -jnp.log(COUNT))))


def _walk(key, particles, density, ancestors, **options):
    """The states of all frames of paths, traced as one program."""
    frames = [Filtered(particles, ancestors, frame == 0) for frame in range(FRAMES)]
    backward = Backward(build_smoother(draws=5, **options), density.transition, lambda t: frames[t], lambda t, before: density.with_previous(before))
    return [each.states for each in backward.follow(key, FRAMES)]


def _form(tree):
    return jax.tree.map(lambda leaf: (leaf.shape[1:], leaf.dtype), dict(tree))


def test_every_motion_prior_has_a_definition():
    assert set(DEFINITIONS) == set(names("dynamics")) and len(jax.devices()) == 2


@pytest.mark.slow
@pytest.mark.parametrize("dynamics", DEFINITIONS)
@pytest.mark.parametrize("kernel", sorted(set(names("kernel")) - {"particle_bp"}))
def test_a_kernel(spread, dynamics, kernel):
    term, density = find("kernel", kernel), _density(dynamics)
    if kernel == "laplace" and density.transition.frames_read != 1:
        with pytest.raises(InputError, match=r"the kernel laplace: the dynamics '.*' carry more along"):
            jax.eval_shape(term.build(options=term.options()), jax.random.key(0), density.previous, density)
        return
    after, _ = jax.eval_shape(term.build(options=term.options()), jax.random.key(0), density.previous, density)
    assert _form(after.states) == _form(density.previous.states) and spread


# By default the one that carries nothing and the one whose memory has no bound; the others take longer to trace.
@pytest.mark.parametrize(
    "dynamics", [pytest.param(name, marks=() if name in ("diffusion", "activity_hmm") else pytest.mark.slow) for name in DEFINITIONS]
)
@pytest.mark.parametrize("start", ["ensemble", pytest.param("particles", marks=pytest.mark.slow)])
def test_the_smoother(spread, dynamics, start):
    density = _density(dynamics)
    ancestors = jnp.arange(COUNT, dtype=jnp.int32)
    frames = jax.eval_shape(lambda *given: _walk(*given, start=start), jax.random.key(0), density.previous, density, ancestors)
    assert len(frames) == FRAMES and all(_form(states) == _form(density.previous.states) for states in frames)
    assert spread or density.transition.frames_read is None
