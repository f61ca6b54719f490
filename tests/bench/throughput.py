"""Evaluations a second of the likelihood: 4 cameras, 31 dofs, float32, thousands of particles. `python tests/bench/throughput.py [--json F]`.

An evaluation is the likelihood of a whole pose over all cameras. The references: the PARSEC suite's bodytrack in C++ on two threads, its own sample
count, values only; and what a gradient-based kernel needs here. Both belong to a machine of two cores.
"""

import argparse
import json
import os
from pathlib import Path

import bayes_body

# Compiled anew each time: what compilation costs is one of the figures. Before the other imports, which may touch JAX.
bayes_body.configure(cache=False)

import jax  # noqa: E402
from case import load, measure, recording, spread  # noqa: E402

from bayes_body.density.density import Density  # noqa: E402
from bayes_body.density.factor import State  # noqa: E402
from bayes_body.results.metrics import peak_memory_mb  # noqa: E402

PEER_VALUES, REQUIRED_GRADIENTS = 237_000, 60_000


def likelihood(state: State, density: Density) -> jax.Array:
    return density.log_likelihood(state, state)


def gradient(state: State, density: Density) -> tuple[jax.Array, State]:
    return jax.value_and_grad(likelihood)(state, density)


def weight(state: State, density: Density) -> jax.Array:
    return density.log_weight(state, state)


# (what, look-up, function of one particle, reference)
PROGRAMS = (
    ("nearest value", "nearest", likelihood, PEER_VALUES),
    ("bilinear value", "bilinear", likelihood, PEER_VALUES),
    ("bilinear value + gradient", "bilinear", gradient, REQUIRED_GRADIENTS),
    ("nearest likelihood + constraint", "nearest", weight, PEER_VALUES),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    session = recording()
    cases = {lookup: load(session, lookup, options.particles) for lookup in ("nearest", "bilinear")}
    print(f"{options.particles} particles, {jax.default_backend()}, {len(jax.devices())} devices, {os.cpu_count()} cores, jax {jax.__version__}")
    print(f"{'':32} {'median/s':>10} {'best/s':>10} {'ratio':>6}  {'reference':>10} {'compile s':>10}")
    rows = []
    for what, lookup, function, reference in PROGRAMS:
        timing = measure(spread(function), cases[lookup].states, cases[lookup].density)
        median, best = (options.particles / seconds for seconds in (timing.median, timing.best))
        print(f"{what:32} {median:10.0f} {best:10.0f} {median / reference:6.2f}  {reference:10d} {timing.compile:10.2f}", flush=True)
        rows.append({"what": what, "median": median, "best": best, "reference": reference, "ratio": median / reference, "compile": timing.compile})
    memory = peak_memory_mb()
    print(f"peak memory {memory:.0f} MB")
    if options.json:
        figures = {"particles": options.particles, "devices": len(jax.devices()), "jax": jax.__version__, "peak_memory_mb": memory, "programs": rows}
        options.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
