"""Sizes of the parts of a loose-limbed body: every factor, and where markers are, against a body that was built with these sizes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.density.factor import variables
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.placed_body import loosened, placed_markers
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.recording.observation.frames import read_frame
from bayes_body.runs.unknowns.definition import with_unknowns

LIKELIHOODS = '[[likelihood]]\nkind = "regions"\n\n[[likelihood]]\nkind = "markers_gaussian"\nsd_px = 8.0\n'
SIZES = '[[unknown]]\nkind = "lengths"\n\n[[unknown]]\nkind = "widths"\n'


def definition_of(unknowns=SIZES, kernel='kind = "particle_bp"\n', name="loose_limbed_10"):
    definition = load_definition(name)
    begin = definition.text.index("[[likelihood]]")
    return parse_definition(name, f"{definition.text[:begin]}{LIKELIHOODS}\n{unknowns}\n[kernel]\n{kernel}", definition.body_text)


@pytest.fixture(scope="module")
def model(keypoint_session):
    return build_model(definition_of(), keypoint_session)


@pytest.fixture(scope="module")
def data(model, keypoint_session):
    return model.observe(read_frame(keypoint_session, 0))


@pytest.fixture(scope="module")
def state(model):
    """Parts near the first pose, with sizes far from the usual ones."""
    rng = np.random.default_rng(3)
    parts = model.transition.sample(jax.random.key(1), model.initial)["parts"]
    count = len(model.body.placement.names)
    return {"parts": parts, **{name: jnp.asarray(rng.normal(size=count) * 0.2, jnp.float32) for name in ("lengths", "widths")}}


def of_factors(model, data, state):
    evaluate = jax.jit(lambda factors, data, state: {factor.name: factor(variables(state), data) for factor in factors})
    return {name: float(value) for name, value in evaluate(model.factors, data, state).items()}


@pytest.mark.slow
def test_every_factor_has_the_value_of_a_body_with_these_sizes(model, data, state, keypoint_session):
    body, definition = model.body_in(state), definition_of("")
    usual = build_model(definition, keypoint_session)
    terms = [("likelihood", term) for term in definition.likelihoods] + [("potential", term) for term in definition.constraints]
    factors = tuple(
        find(place, term.kind).build(name=factor.name, options=term.options, body=body, rig=model.rig)
        for (place, term), factor in zip(terms, usual.factors, strict=True)
    )
    resized = of_factors(dataclasses.replace(usual, factors=factors), data, {"parts": state["parts"]})
    values = of_factors(model, data, state)
    as_usual = of_factors(usual, data, {"parts": state["parts"]})
    for name, value in values.items():
        assert value == pytest.approx(resized[name], rel=1e-3, abs=2e-2), name
        assert abs(value - as_usual[name]) > 0.5 or value == as_usual[name] == 0, name
    settled = of_factors(model.settled(state), data, {"parts": state["parts"]})
    assert settled == pytest.approx(values, rel=1e-4, abs=1e-2)


def test_a_longer_limb_is_that_of_a_body_with_longer_bones(model):
    """In a pose of angles at 0: a part with one bone, such as a thigh, carries the knee away by the same as the bone."""
    schema, names = load_definition("loose_limbed_10").body, model.body.placement.names
    lengths = {name: float(share) * 1.7 for name, share in schema.lengths_of_height.items()}
    longer = {"l_thigh": 0.1, "r_calf": -0.2, "l_upper_arm": 0.15}
    feet = {"r_heel", "r_foot"}
    changed = {name: value * np.exp(longer.get(name, longer["r_calf"] if name in feet else 0.0)) for name, value in lengths.items()}
    built = loosened(build_body("person_31", schema, Shape(1.7, changed)))
    value = jnp.asarray([longer.get(name, 0.0) for name in names], jnp.float32)
    body = model.body_in({"lengths": value})
    parts = built.placement.configuration(built.skeleton, jnp.zeros(len(built.dof_names)))
    np.testing.assert_allclose(placed_markers(body, parts), placed_markers(built, parts), atol=1e-5)
    np.testing.assert_allclose(body.by_angles.skeleton.offsets, built.skeleton.offsets, atol=1e-5)
    np.testing.assert_allclose(body.lengths, built.lengths, atol=1e-5)


def test_the_prior_is_that_of_the_bone_and_of_all_lengths_together(model, keypoint_session):
    term = next(term for term in model.unknowns if term.name == "lengths")
    assert term.space.labels == model.body.placement.names
    thigh, other = (float(term.sd[model.body.placement.names.index(f"{side}_thigh")]) for side in ("l", "r"))
    # The session gives the height: 1.5 % together, and 5.9 % of the thigh.
    assert thigh == other == pytest.approx(np.hypot(0.015, 0.059), abs=2e-3)
    told = parse_definition(
        "x",
        definition_of().text.replace('kind = "lengths"', 'kind = "lengths"\nbone_mean = { thigh = 0.1 }\nbone_sd = { calf = 0.2 }'),
        definition_of().body_text,
    )
    changed = next(term for term in build_model(told, keypoint_session).unknowns if term.name == "lengths")
    by_part = dict(zip(changed.space.labels, zip(np.asarray(changed.mean), np.asarray(changed.sd), strict=True), strict=True))
    assert by_part["r_thigh"][0] == pytest.approx(0.1) and by_part["l_calf"] == pytest.approx((0.0, np.hypot(0.015, 0.2)), abs=1e-6)


REFUSED = {
    "alike": ('[[unknown]]\nkind = "lengths"\nsides = "alike"\n', r"unknown 'lengths': sides: \"alike\".*each part has a length of its own"),
    "cameras": ('[[unknown]]\nkind = "cameras"\n', r'placed by "parts"; expected kind = "lengths" or "widths"'),
    "no such part": ('[[unknown]]\nkind = "widths"\nsd = { thig = 0.1 }\n', "widths': sd.thig: matches no part of the body; did you mean 'thigh'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_parts_cannot_have_is_refused(case, keypoint_session):
    unknowns, sentence = REFUSED[case]
    with pytest.raises(InputError, match=sentence):
        build_model(definition_of(unknowns), keypoint_session)


def test_a_fit_of_parts_is_refused():
    with pytest.raises(InputError, match='its body is placed by "parts"; expected a body with placement = "angles"'):
        with_unknowns(definition_of())


def test_products_of_messages_are_refused(model, data):
    with pytest.raises(InputError, match="method: 'pampas', and the sizes of the parts are not known"):
        jax.eval_shape(model.kernel(method="pampas", samples=10), jax.random.key(0), model.start(10), model.density(data))
