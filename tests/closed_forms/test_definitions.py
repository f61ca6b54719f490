"""What holds for every shipped definition: it loads, its factors keep to their scopes, its transition is a distribution, its density finite."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from bayes_body.density.density import Density
from bayes_body.density.factor import variables
from bayes_body.model.build import build_model
from bayes_body.model.definition import definition_names, load_definition
from bayes_body.recording.observation.frames import read_frame


def _terms(definition):
    return [(term.kind, getattr(term.options, "lookup", "")) for term in (*definition.likelihoods, *definition.constraints)]


def _dofs(definition):
    return sum(len(joint.dofs) for joint in definition.body.joints)


def _made_of(name):
    """What a definition consists of, its numbers apart."""
    definition = load_definition(name)
    return _dofs(definition) < 10, definition.dynamics.kind, _terms(definition)


def _small_first():
    """One arm by default; the other arms and one whole body slow; the others, and what consists of the same terms, long."""
    found = []
    for name in definition_names():
        parts = _made_of(name)
        alike = parts in found
        found.append(parts)
        slow = pytest.mark.slow if name.startswith("arm") or name == "deutscher_2005" else pytest.mark.long
        yield pytest.param(name, marks=() if name == "arm" else pytest.mark.long if alike else slow)


def _new_first(parts_of):
    """By default what has a part that no smaller body and none before it has; the others slow."""
    seen = set()
    for definition in sorted(map(load_definition, definition_names()), key=_dofs):
        parts = set(parts_of(definition))
        yield pytest.param(definition.name, marks=pytest.mark.slow if parts <= seen else ())
        seen |= parts


WITH_NEW_MOTION = list(_new_first(lambda definition: [definition.dynamics.kind]))
WITH_NEW_TERMS = list(_new_first(lambda definition: [definition.dynamics.kind, *_terms(definition)]))


@pytest.fixture(scope="module")
def build(keypoint_session):
    """A model by its name, built once."""
    return functools.cache(lambda name: build_model(name, keypoint_session))


@pytest.fixture
def model(request, build):
    return build(request.param)


@pytest.fixture
def density(model, keypoint_session) -> Density:
    return model.density(model.observe(read_frame(keypoint_session, 0)))


@pytest.mark.parametrize("name", definition_names())
def test_it_says_what_it_is(name):
    definition = load_definition(name)
    assert definition.name == name
    assert len(definition.title) > 20 and len(definition.source) > 20


@pytest.mark.parametrize("model", list(_small_first()), indirect=True)
def test_its_density_is_the_sum_of_its_parts_finite_at_first_with_finite_gradients_everywhere_a_particle_may_go(model, density):
    """One program: to compile the gradient takes most of the time."""
    view = density.unconstrained()
    at, unravel = ravel_pytree(view.unconstrain(model.initial))

    def value_and_parts(flat):
        position = unravel(flat)
        return view(position), density.parts(view.constrain(position))

    positions = jnp.concatenate([at[None], at + jax.random.normal(jax.random.key(0), (200, at.size))])
    (values, parts), gradients = jax.jit(jax.vmap(jax.value_and_grad(value_and_parts, has_aux=True)))(positions)
    assert np.isfinite([values[0], *(each[0] for each in parts.values())]).all(), parts
    volume = view.coordinates.log_determinant(unravel(at))
    assert np.isclose(values[0], sum(each[0] for each in parts.values()) + volume, rtol=1e-5, atol=1e-3)
    # A hard constraint makes a value minus infinity, never a NaN.
    assert not np.isnan(values).any()
    assert np.isfinite(gradients).all()


@pytest.mark.parametrize("model", WITH_NEW_TERMS, indirect=True)
def test_a_factor_reads_its_scope_and_its_own_data(model, density):
    """No more, or it could not be traced from them; and all of its scope: one that only says it reads the frame before costs every ancestor."""
    assert model.definition == load_definition(model.definition.name)
    values = variables(model.initial, model.initial)
    for factor in density.factors:
        own = {name: data for name, data in density.data.items() if name == factor.name}
        traced = jax.make_jaxpr(lambda scoped, f=factor, own=own: f(scoped, own))({variable: values[variable] for variable in factor.scope})
        read = {id(variable) for equation in traced.jaxpr.eqns for variable in equation.invars}
        assert [variable.aval.shape for variable in traced.jaxpr.outvars] == [()]
        assert all(id(variable) in read for variable in traced.jaxpr.invars), factor.name


POINTS = 20_000


@jax.jit
def _masses(transition, state):
    """The integral over each dof of the pose, the others where they are. They are independent: a dof's factor is what is left of the whole."""
    others = dict(transition.conditional(state))
    distribution, pose = others.pop("pose"), state["pose"]
    whole = transition.log_density(state, state) - sum(each.log_prob(state[name]) for name, each in others.items())

    def mass(k):
        reach = 12 * distribution.scale[k]
        low, high = (jnp.clip(side[k], pose[k] - reach, pose[k] + reach) for side in (distribution.low, distribution.high))
        points = low + (high - low) * (jnp.arange(POINTS) + 0.5) / POINTS
        alone = jax.vmap(lambda x: distribution.log_prob(pose.at[k].set(x)))(points)
        return jnp.sum(jnp.exp(alone - (whole - _own(distribution, pose, k)))) * (high - low) / POINTS

    return jax.lax.map(mass, jnp.arange(pose.size))


@pytest.mark.slow
@pytest.mark.parametrize("model", WITH_NEW_MOTION, indirect=True)
def test_each_dof_of_the_transition_integrates_to_one(model):
    """The dofs are independent: varying one alone leaves the others' log-density constant, which is divided out."""
    if "pose" not in model.transition.conditional(model.initial):
        pytest.skip("samples other variables; the tests of its dynamics do this")
    with jax.enable_x64(True):
        masses = np.asarray(_masses(*jax.tree.map(_in_double, (model.transition, dict(model.initial)))))
    assert dict(zip(model.body.dof_names, masses, strict=True)) == pytest.approx(dict.fromkeys(model.body.dof_names, 1.0), abs=1e-6)


def _in_double(leaf):
    return jnp.asarray(leaf, jnp.float64) if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating) else leaf


def _own(distribution, pose, k):
    names = ("loc", "scale", "low", "high") if hasattr(distribution, "loc") else ("centre", "scale", "low", "high", "angular")
    part = type(distribution)(*(getattr(distribution, name)[k][None] for name in names))
    return part.log_prob(pose[k][None])


@jax.jit
def _draws(transition, previous):
    """States of the next frame, and their log-densities."""

    def draw(key):
        state = transition.sample(key, previous)
        return state, transition.log_density(state, previous)

    return jax.vmap(draw)(jax.random.split(jax.random.key(1), 500))


@pytest.mark.parametrize("model", WITH_NEW_MOTION, indirect=True)
def test_particles_of_the_transition_stay_inside_the_limits(model):
    states, log_densities = jax.device_get(_draws(model.transition, dict(model.initial)))
    low, high = jax.device_get((model.body.skeleton.low, model.body.skeleton.high))
    # Parts have no limits.
    if "pose" in states:
        assert (states["pose"] >= low).all() and (states["pose"] <= high).all()
    assert np.isfinite(log_densities).all()
