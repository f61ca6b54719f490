"""Locate sensors from noisy distances to their neighbours, with particle belief propagation (Ihler, Fisher, Moses & Willsky 2005).

    python inference/sensor_localisation.py --out RUN

Some sensors know where they are. The others only measure distances to those near them. A distance says "on a ring", so beliefs are rings, arcs, and
pairs of places that mirror each other. Copy this file and put in your own graph.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist

import bayes_body as bb

SENSORS, ANCHORS, REACH, SD = 20, 4, 0.35, 0.02


def log_range(distance, first, second):
    return dist.Normal(distance, SD).log_prob(jnp.sqrt(jnp.sum((second - first) ** 2) + 1e-12))


def draw_on_ring(key, distance, known, reverse):
    noise, angle = jax.random.normal(key), jax.random.uniform(jax.random.fold_in(key, 1), maxval=2 * jnp.pi)
    return known + jnp.abs(distance + SD * noise) * jnp.array([jnp.cos(angle), jnp.sin(angle)])


def log_on_ring(distance, known, place, reverse):
    radius = jnp.sqrt(jnp.sum((place - known) ** 2) + 1e-12)
    return dist.Normal(distance, SD).log_prob(radius) - jnp.log(2 * jnp.pi * radius)


def scene(seed: int):
    rng = np.random.default_rng(seed)
    places = rng.uniform(size=(SENSORS, 2))
    places[:ANCHORS] = [[0.1, 0.1], [0.9, 0.15], [0.15, 0.9], [0.85, 0.85]]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    edges = [(i, j) for i in range(SENSORS) for j in range(i + 1, SENSORS) if apart[i, j] < REACH and j >= ANCHORS]
    return places, edges, np.abs(np.array([apart[i, j] for i, j in edges]) + SD * rng.normal(size=len(edges)))


def main() -> None:
    parser = argparse.ArgumentParser(description="Locate sensors from noisy distances.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the picture")
    parser.add_argument("--samples", type=bb.whole_number(10), default=400, help="particles of each sensor (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two iterations: a trial")
    arguments = parser.parse_args()
    places, edges, distances = scene(arguments.seed)
    graph = bb.graph(
        {"sensor": (SENSORS, 2)},
        bb.node_factor("known", lambda place: dist.Normal(place, 0.002).to_event(1), range(ANCHORS), jnp.asarray(places[:ANCHORS])),
        bb.node_factor("field", dist.Uniform(-0.1, 1.1).expand([2]).to_event(1), range(ANCHORS, SENSORS)),
        bb.edge_factor("distance", log_range, edges, jnp.asarray(distances), draw_on_ring, log_on_ring),
    )
    sampler = bb.kernels.particle_bp(samples=arguments.samples, iterations=2 if arguments.quick else 10, shares=(0.7, 0.1, 0.1, 0.2))
    beliefs = jax.jit(sampler.on)(jax.random.key(arguments.seed), graph)
    weights = jnp.exp(beliefs.log_beliefs)[..., None]
    mean = jnp.sum(weights * beliefs.points, axis=1)
    sd = jnp.sqrt(jnp.sum(weights * (beliefs.points - mean[:, None]) ** 2, axis=(1, 2)))
    figure, axis = plt.subplots(figsize=(7, 7), layout="constrained")
    print("sensor     error      sd  (of a field of side 1)")
    for node in range(ANCHORS, SENSORS):
        print(f"{node:6}{float(np.linalg.norm(mean[node] - places[node])):10.3f}{float(sd[node]):8.3f}")
        shown = jax.random.categorical(jax.random.key(node), beliefs.log_beliefs[node], shape=(200,))
        axis.scatter(*beliefs.points[node, shown].T, s=4, alpha=0.3, color=f"C{node % 10}", lw=0)
    axis.scatter(*places[ANCHORS:].T, marker="x", color="black", label="true place")
    axis.scatter(*places[:ANCHORS].T, marker="s", color="black", label="known place")
    axis.set(aspect="equal", xlim=(-0.1, 1.1), ylim=(-0.1, 1.1), title="200 draws of each sensor's belief, in its colour")
    axis.legend()
    arguments.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out / "sensors.png", dpi=120)


if __name__ == "__main__":
    main()
