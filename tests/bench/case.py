"""What the benchmarks run on: the real recording, a model of it with a chosen look-up, and particles around its first pose."""

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bayes_body.density.density import Density
from bayes_body.density.factor import State
from bayes_body.kernels.batching import everywhere, over_particles
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.parsec import import_parsec
from bayes_body.recording.session.session import Session

RECORDING = "bodytrack_4cam"
# Particles spread this many times the model's own noise around the first pose: as a filter's are, and as the images are looked into.
SPREAD = 5.0
REPETITIONS = 20


class Case(NamedTuple):
    """A model, its density at frame 0, and the particles' states."""

    model: Model
    density: Density
    states: State


def recording() -> Session:
    """The real recording's session; ends the program with a sentence where there is none."""
    root = os.environ.get("BAYES_BODY_DATA")
    if not root or not (Path(root) / RECORDING).is_dir():
        sys.exit(f"BAYES_BODY_DATA is {root!r}; expected the folder that holds {RECORDING}; set it and run again.")
    with tempfile.TemporaryDirectory() as folder:
        return import_parsec(Path(root) / RECORDING, Path(folder))[0]


def load(session: Session, lookup: str, particles: int) -> Case:
    """`deutscher_2005` with that look-up."""
    definition = load_definition("deutscher_2005")
    (term,) = definition.likelihoods
    term = replace(term, options=term.options.model_copy(update={"lookup": lookup}))
    model = build_model(replace(definition, likelihoods=(term,)), session)
    density = model.density(model.observe(read_frame(session, 0)))
    perturb = jax.vmap(lambda key: model.transition.perturb(key, model.initial, model.initial, jnp.asarray(SPREAD)))
    return Case(model, everywhere(density), everywhere(perturb(jax.random.split(jax.random.key(0), particles))))


class Timing(NamedTuple):
    """Seconds: to trace and compile, and of a warm call, in the middle and at best."""

    compile: float
    median: float
    best: float


def measure(function: Callable[..., Any], *arguments: Any) -> Timing:
    """Of `jit(function)(*arguments)`, at least 20 repetitions and a second of them."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    compiled = time.perf_counter() - start
    jax.block_until_ready(program(*arguments))
    seconds: list[float] = []
    while len(seconds) < REPETITIONS or sum(seconds) < 1.0:
        start = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        seconds.append(time.perf_counter() - start)
    return Timing(compiled, statistics.median(seconds), min(seconds))


def spread(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """`(particles, shared)`: the function of one particle over all of them, as the kernels run it."""
    return lambda particles, shared: over_particles(function, particles, shared)
