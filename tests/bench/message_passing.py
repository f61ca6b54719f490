"""Seconds of particle belief propagation on a loose-limbed body, on the real recording. `python tests/bench/message_passing.py [--json F]`.

Ten parts with their learned joints of four components, four cameras, the likelihood `regions`. The cost of messages grows with the square of the
particles of a part, and linearly with the joints; that of the images linearly with the particles. Everything is measured warm.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import bayes_body

# Compiled anew each time: what compilation costs is one of the figures. Before the other imports, which may touch JAX.
bayes_body.configure(cache=False)

import jax  # noqa: E402
from case import recording  # noqa: E402

from bayes_body.density.density import Density  # noqa: E402
from bayes_body.density.parts_graph import parts_graph  # noqa: E402
from bayes_body.kernels.parts.batching import everywhere  # noqa: E402
from bayes_body.model.build import build_model  # noqa: E402
from bayes_body.model.definition import load_definition  # noqa: E402
from bayes_body.observation.frames import read_frame  # noqa: E402
from bayes_body.registry import find  # noqa: E402

REPETITIONS = 5


def definition():
    """Return loose_limbed_10 with the likelihood `regions`, a plate over parts, and learned joints."""
    loose = load_definition("loose_limbed_10")
    likelihood, observation = (find(room, "regions").options() for room in ("likelihood", "observation"))
    regions = replace(loose.likelihoods[0], kind="regions", options=likelihood, observation=observation)
    kinematic = replace(loose.constraints[0], options=find("potential", "kinematic").options(learned="kinematic_10"))
    return replace(loose, likelihoods=(regions,), constraints=(kinematic, *loose.constraints[1:]))


def seconds(function, *arguments) -> tuple[float, float]:
    """The time to compile, and that of a warm call at best."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    compiled = time.perf_counter() - begin
    found = []
    for _ in range(REPETITIONS):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        found.append(time.perf_counter() - begin)
    return compiled, min(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=[125, 250, 500, 1000])
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    session = recording()
    model = build_model(definition(), session)
    density = everywhere(model.density(model.observe(read_frame(session, 0)), model.start(100)))
    key = everywhere(jax.random.key(0))
    print(f"{jax.default_backend()}, {len(jax.devices())} devices, jax {jax.__version__}")
    print(f"{'samples':>8} {'messages of an iteration, s':>28} {'6 iterations and 500 draws, s':>30} {'compile, s':>11}")
    rows = []
    for samples in options.samples:

        def passing(iterations: int, draws: int, without_images: bool, samples: int = samples):
            sampler = bayes_body.kernels.particle_bp(samples=samples, iterations=iterations, particles=draws)

            def run(key: jax.Array, density: Density):
                graph = parts_graph(density)
                return sampler.on(key, replace(graph, unaries=(), rest=None) if without_images else graph).joint

            return jax.jit(run)

        short, long = (seconds(passing(n, 10, True), key, density)[1] for n in (2, 12))
        compiled, whole = seconds(passing(6, 500, False), key, density)
        rows.append({"samples": samples, "messages": (long - short) / 10, "frame": whole, "compile": compiled})
        print(f"{samples:8d} {rows[-1]['messages']:28.3f} {whole:30.2f} {compiled:11.1f}", flush=True)
    if options.json:
        options.json.write_text(json.dumps({"devices": len(jax.devices()), "jax": jax.__version__, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
