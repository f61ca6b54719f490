"""A user's own terms for tests: a plugin, a model that names them, and a way to leave the registry as it was."""

from collections.abc import Iterator
from contextlib import contextmanager

from bayes_body.base import registry
from bayes_body.model.plugins import load as plugins

GOOD = """
import bayes_body as bb
import jax.numpy as jnp

POSE = bb.Variable("pose")

class Options(bb.Schema):
    stiffness: float = 4.0

@bb.register("observation", "brightness")
def observe(**_):
    return lambda frame: frame.images[0].mean() / 255

@bb.register("likelihood", "brightness", Options, note="a toy")
def build(name, options, body, **_):
    def log_potential(values, level):
        return -options.stiffness * level * jnp.sum(values[POSE] ** 2)
    return bb.Factor(name, "likelihood", (POSE,), log_potential)
"""
MODEL = """
title  = "Mine"
source = "nobody"
body.name = "arm_4"
dynamics = { kind = "diffusion", sd_deg = { "*" = 3.0 } }
kernel = { kind = "sir", particles = 20 }

[[likelihood]]
kind = "brightness"
stiffness = 2.0
"""


@contextmanager
def plugins_of_this_test() -> Iterator[None]:
    """Afterwards no term is registered that was not before, built-in ones left out: these are registered once, when they are imported."""
    try:
        with registry.additions() as places:
            yield
    finally:
        for plugin in plugins.loaded():
            plugins.unload(plugin)
    registry.forget(places)
