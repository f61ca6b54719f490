"""Seconds of particle belief propagation on loose-limbed bodies, on the real recording or on a session.

    python tests/bench/message_passing.py [--session S] [--json F] [--plot F.png]

First, messages alone: one iteration of flooding over joints of four components learned from captured motion, by the number of joints and of samples,
with the draws of all parts but no images. The cost should grow linearly with the joints and with the square of the samples. One of the numbers of
samples gives as many pairs of particles as Table 5 of Sigal et al. 2011, whose parts have different numbers. Then a whole frame of ten and of fifteen
parts, with the likelihood `regions` in all cameras, 6 iterations and 500 joint draws. Everything is measured warm, and the best of some repetitions
counts.
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
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from case import recording  # noqa: E402

from bayes_body.base.registry import find  # noqa: E402
from bayes_body.density.density import Density  # noqa: E402
from bayes_body.density.graph import Graph, Term  # noqa: E402
from bayes_body.density.parts_graph import parts_graph  # noqa: E402
from bayes_body.kernels.batching import everywhere  # noqa: E402
from bayes_body.kernels.messages.node_proposals import Shares  # noqa: E402
from bayes_body.kernels.messages.particle_bp import Options  # noqa: E402
from bayes_body.kernels.messages.passing import Passing, Settings  # noqa: E402
from bayes_body.kernels.messages.schedules import schedule  # noqa: E402
from bayes_body.model.build import build_model  # noqa: E402
from bayes_body.model.definition import Definition, load_definition  # noqa: E402
from bayes_body.recording.observation.frames import read_frame  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402
from bayes_body.recording.session.session import Session  # noqa: E402

REPETITIONS, FRAMES = 12, 5
JOINTS, SAMPLES = (1, 2, 4, 7, 14), (100, 200, 400, 500, 800)
FIXED = 500


def of_table_5(samples: dict[str, int], rows: np.ndarray, names: tuple[str, ...]) -> int:
    """The number of samples of each part that gives as many pairs along the joints as different numbers by part."""
    counts = np.array([next((count for word, count in samples.items() if word in name), 800) for name in names])
    return round(float(np.mean(counts[rows[:, 0]] * counts[rows[:, 1]])) ** 0.5)


def definition(parts: int) -> Definition:
    """Return the loose-limbed body of 10 or 15 parts with the likelihood `regions`, a plate over parts, and learned joints."""
    loose = load_definition(f"loose_limbed_{parts}")
    likelihood, observation = (find(room, "regions").options() for room in ("likelihood", "observation"))
    regions = replace(loose.likelihoods[0], kind="regions", options=likelihood, observation=observation)
    kinematic = replace(loose.constraints[0], options=find("potential", "kinematic").options(learned=f"kinematic_{parts}"))
    return replace(loose, likelihoods=(regions,), constraints=(kinematic, *loose.constraints[1:]))


def density_of(parts: int, session: Session) -> Density:
    """Return the density of the session's first frame."""
    model = build_model(definition(parts), session)
    return everywhere(model.density(model.observe(read_frame(session, 0)), model.start(100)))


def seconds(function, *arguments, repetitions: int = REPETITIONS) -> tuple[float, float]:
    """The time to compile, and that of a warm call at best."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    compiled = time.perf_counter() - begin
    found = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        found.append(time.perf_counter() - begin)
    return compiled, min(found)


def with_joints(graph: Graph, count: int) -> Graph:
    """Return the graph with the first of its joints only, without images and without penetration."""
    (joints,) = (term for term in graph.pairs if term.name == "kinematic")
    plate = joints.plate
    some = replace(plate, rows=plate.rows[:count], parameters=jax.tree.map(lambda leaf: leaf[:count], plate.parameters))
    return replace(graph, unaries=(), pairs=(Term(joints.name, joints.tempered, some),), joint_factors=None)


def messages(graph: Graph, samples: int) -> float:
    """The seconds of one iteration of flooding: draws of all nodes, all messages into them, and the density of the draws."""
    now = jax.tree.map(lambda leaf: leaf[0], schedule(graph, "flooding", 1))
    options = Options()

    def passing(graph: Graph) -> Passing:
        return Passing(graph, Settings(samples, options.loop_samples, Shares(*options.shares), options.fit_inflation, "mixture", 0.0))

    one, key = jax.jit(lambda key, graph, beliefs: passing(graph).round(beliefs, key, now)), jax.random.key(0)
    beliefs, _ = one(key, graph, jax.jit(lambda key, graph: passing(graph).begin(key))(key, graph))
    return seconds(one, key, graph, beliefs)[1]


def frame(density: Density, samples: int) -> tuple[float, float]:
    """The seconds to compile and to sample a frame with 6 iterations and 500 joint draws."""
    sampler = bayes_body.kernels.messages.particle_bp(samples=samples, iterations=6, particles=500)
    return seconds(
        jax.jit(lambda key, density: sampler.on(key, parts_graph(density)).joint), everywhere(jax.random.key(0)), density, repetitions=FRAMES
    )


def plot(path: Path, by_joints: dict[int, float], by_samples: dict[int, float]) -> None:
    """Draw the milliseconds of messages over the joints, with the best line, and over the samples, with the best sum of a line and a square."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    joints, each = np.array(list(by_joints)), 1e3 * np.array(list(by_joints.values()))
    slope, offset = np.polyfit(joints, each, 1)
    left.plot(joints, each, "o", label="measured")
    left.plot([0, joints.max()], [offset, offset + slope * joints.max()], "k--", lw=1, label=f"{offset:.0f} ms + {slope:.1f} ms a joint")
    left.set(xlabel=f"joints; {FIXED} samples a part", ylabel="one iteration of messages, ms", ylim=(0, None), xlim=(0, None))
    samples, each = np.array(list(by_samples)), 1e3 * np.array(list(by_samples.values()))
    powers = np.stack([samples, samples**2.0], axis=1)
    # Relative errors count: the largest would decide alone.
    (line, square), *_ = np.linalg.lstsq(powers / each[:, None], np.ones(len(each)))
    fine = np.geomspace(samples[0], samples[-1], 50)
    right.loglog(samples, each, "o", label="measured")
    label = f"({1e2 * line:.1f} + {1e4 * square:.1f} n) n ms, n = samples / 100"
    right.loglog(fine, line * fine + square * fine**2, "k--", lw=1, label=label)
    right.set(xlabel=f"samples a part; {max(by_joints)} joints", ylabel="one iteration of messages, ms")
    right.set_xticks(samples, samples)
    right.set_yticks([10, 20, 50, 100, 200, 500, 1000], ["10", "20", "50", "100", "200", "500", "1000"])
    right.set_ylim(0.7 * each.min(), 1.4 * each.max())
    right.minorticks_off()
    for axis in (left, right):
        axis.legend(frameon=False)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--session", type=Path, help="folder of a session; the real recording by default")
    parser.add_argument("--samples", type=int, nargs="+", default=[250, 500], help="samples a part, for whole frames")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    parser.add_argument("--plot", type=Path, help="draw the seconds of messages there, a .png")
    options = parser.parse_args()
    session = load_session(options.session) if options.session else recording()
    print(f"{jax.default_backend()}, {len(jax.devices())} devices, jax {jax.__version__}")
    fifteen = density_of(15, session)
    graph = parts_graph(fifteen)
    (joints_of,) = (term.rows for term in graph.pairs if term.name == "kinematic")
    table = of_table_5({"torso": 50, "pelvis": 50, "head": 200, "thigh": 200, "upper_arm": 200}, joints_of, graph.names)
    print(f"Messages of one iteration, 15 parts, joints of 4 components; {table} samples give the pairs of Table 5\n  joints   samples   seconds")
    by_joints, by_samples = {}, {}
    counts = sorted({*SAMPLES, table} - {FIXED})
    for joints, samples in [*((joints, FIXED) for joints in JOINTS), *((max(JOINTS), samples) for samples in counts)]:
        found = messages(with_joints(graph, joints), samples)
        by_joints |= {joints: found} if samples == FIXED else {}
        by_samples |= {samples: found} if joints == max(JOINTS) else {}
        print(f"{joints:8d}  {samples:8d}  {found:8.3f}", flush=True)
    by_samples = dict(sorted(by_samples.items()))
    if options.plot:
        plot(options.plot, by_joints, {samples: by_samples[samples] for samples in SAMPLES})
    print(f"Frames, {len(session.views)} cameras, 6 iterations and 500 joint draws\n   parts   samples   seconds   to compile, s")
    frames = {}
    for parts, density in ((10, density_of(10, session)), (15, fifteen)):
        for samples in options.samples:
            compiled, warm = frame(density, samples)
            frames[f"{parts} parts, {samples} samples"] = {"frame": warm, "compile": compiled}
            print(f"{parts:8d}  {samples:8d}  {warm:8.2f}  {compiled:14.1f}", flush=True)
    if options.json:
        figures = {"messages_by_joints": by_joints, "messages_by_samples": by_samples, "table_5": table, "frames": frames}
        options.json.write_text(json.dumps({"devices": len(jax.devices()), "jax": jax.__version__, **figures}, indent=2))


if __name__ == "__main__":
    main()
