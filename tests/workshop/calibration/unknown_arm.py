"""An arm with velocities, two cameras, and unknown lengths, cameras and delays; its priors and its faults are arguments of compiled programs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.density.factor import Factor, Variable
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.model.unknowns.unknown import Unknown
from bayes_body.workshop.calibration.problem import problem_of

RANDOM_WALK = 'kind = "diffusion"\nat_fps = 60\n\n[dynamics.sd_deg]\n"shoulder_*" = 3.0\nelbow = 4.0\n'
WITH_VELOCITY = 'kind = "constant_velocity"\nat_fps = 60\n\n[dynamics.sd_deg]\n"*" = 0.5\n\n[dynamics.velocity_sd_deg]\n"*" = 30.0\n'
UNKNOWNS = """
[[unknown]]
kind = "lengths"

[[unknown]]
kind = "cameras"
turn_sd_deg = 1.0

[[unknown]]
kind = "delays"
"""
# Of what is left of an error in the next frame: it fades within 0.1 s, or in an hour.
DRIFTING, STATIC = np.exp(-1 / 6), np.exp(-1 / (60 * 3600))
# Standard deviations of a delay, seconds: half a frame, and more than a frame.
SHORT, LONG = 0.008, 0.02
FAULTS = {
    "not applied in one camera": {"seen": 0.0},
    "delays of the wrong sign": {"retention": STATIC, "sign": -1.0},
    "noise of the whole prior": {"spread": True},
    "no return to the mean": {"memory": True},
    "prior counted in every frame": {"again": 1.0},
}


def model_of(session):
    """The model of the arm."""
    definition = load_definition("arm_markers")
    assert definition.text.count(RANDOM_WALK) == definition.text.count("sd_px = 8.0") == 1
    # A few pixels would say little about lengths and cameras.
    text = definition.text.replace(RANDOM_WALK, WITH_VELOCITY).replace("sd_px = 8.0", "sd_px = 2.0")
    return build_model(parse_definition("arm", text + UNKNOWNS, definition.body_text), session)


def problem_with_unknowns(session):
    """The problem of the arm. It starts a few steps from the middle of the joints' limits: beside a limit nothing would be normal."""
    return problem_of(model_of(session), wandering=3)


def changed(tree, change):
    """A problem, or a part of it, with `change(term)` in place of each unknown, in the motion prior and in the factors."""
    return jax.tree.map(lambda node: change(node) if isinstance(node, Unknown) else node, tree, is_leaf=lambda node: isinstance(node, Unknown))


def with_priors(tree, retention, delay_sd):
    """A problem, or a part of it, whose unknowns fade so fast, and whose delays are so long."""

    def change(term):
        sd = jnp.full_like(term.sd, delay_sd) if term.name == "delays" else term.sd
        return dataclasses.replace(term, sd=sd, retention=jnp.full_like(term.retention, retention))

    return changed(tree, change)


def _scaled(scale, change, node, value, values):
    return change(node, scale * value, values)


def _log_prior(weight, term, values, data):
    return weight * jnp.sum(term.prior().log_prob(values[Variable(term.name)]))


def told(true, seen=1.0, sign=1.0, spread=False, memory=False, again=0.0):
    """The motion prior and the factors as a sampler with faults is told.

    Args:
        true: the true problem.
        seen: what reaches the first camera of its unknown motion; 1 is right.
        sign: of the delays.
        spread: whether the walk's noise has the whole prior's deviation.
        memory: whether the walk does not return to its mean.
        again: how often the prior counts once more in every frame.
    """

    def change(term):
        at_rest = jnp.ones_like(term.sd)
        scale = {"cameras": at_rest.at[:6].set(seen), "delays": sign * at_rest}.get(term.name, at_rest)
        share = jnp.sqrt(-jnp.expm1(2 * jnp.log(term.retention)))
        retention = jnp.where(memory, 0.9999, term.retention)
        # A walk with this retention has this noise if its stationary deviation is the quotient.
        noise = term.sd * jnp.where(spread, 1.0, share)
        sd = noise / jnp.sqrt(-jnp.expm1(2 * jnp.log(retention)))
        return dataclasses.replace(term, change=jax.tree_util.Partial(_scaled, scale, term.change), retention=retention, sd=sd)

    faulty = changed(true, change)
    twice = tuple(
        Factor(f"prior of {term.name}", "prior", (Variable(term.name),), jax.tree_util.Partial(_log_prior, again, term)) for term in true.unknowns
    )
    return faulty.transition, (*faulty.factors, *twice)
