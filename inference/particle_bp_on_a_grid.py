"""Particle belief propagation on a grid of noisy numbers, compared with loopy belief propagation on a fine grid of values.

    python inference/particle_bp_on_a_grid.py --out RUN

The model is that of Lienart, Teh & Doucet 2015: 5 x 5 nodes, each with a number that was seen with noise of two kinds, and neighbours that are alike.
Its graph has loops, so beliefs are not the true marginals. They should be those of belief propagation on a grid of values, which costs a thousand
values a node instead of some dozens of particles. Copy this file and put in your own graph.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist

import bayes_body as bb

SIDE, VALUES = 5, jnp.linspace(-15.0, 15.0, 1001)
EDGES = [(i, i + 1) for i in range(SIDE**2) if (i + 1) % SIDE] + [(i, i + SIDE) for i in range(SIDE * (SIDE - 1))]
ALIKE = dist.Laplace(0.0, 2.0)


def log_seen(number, x):
    noise = number - x[0]
    return jnp.logaddexp(jnp.log(0.6) + dist.Normal(-2.0, 1.0).log_prob(noise), jnp.log(0.4) + dist.Gumbel(2.0, 1.3).log_prob(noise))


def on_values(numbers, iterations=30):
    """Loopy belief propagation with every node on the same values: a matrix for each message."""
    pair = jnp.exp(ALIKE.log_prob(VALUES[:, None] - VALUES))
    first, second = jnp.array(EDGES).T
    source, target = jnp.concatenate([first, second]), jnp.concatenate([second, first])
    unary = jax.vmap(lambda number: jax.vmap(lambda x: log_seen(number, x[None]))(VALUES))(numbers)

    def step(sent, _):
        cavity = unary.at[target].add(sent)[source] - jnp.roll(sent, len(EDGES), axis=0)
        return jnp.log(jax.nn.softmax(cavity, axis=1) @ pair), None

    sent, _ = jax.lax.scan(step, jnp.zeros((2 * len(EDGES), len(VALUES))), None, iterations)
    return jax.nn.softmax(unary.at[target].add(sent), axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Particle belief propagation on a grid of noisy numbers.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the picture")
    parser.add_argument("--samples", type=bb.whole_number(10), default=100, help="particles of each node (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two iterations: a trial")
    arguments = parser.parse_args()
    numbers = 2 * jax.random.normal(jax.random.key(4), (SIDE**2,))
    graph = bb.graph(
        {"x": (SIDE**2, 1)},
        bb.node_factor("seen", log_seen, parameters=numbers),
        bb.edge_factor("alike", ALIKE.expand([1]).to_event(1), EDGES),
        bb.proposal("near", lambda number: dist.Normal(number, 4.0).expand([1]).to_event(1), parameters=numbers),
    )
    sampler = bb.kernels.particle_bp(samples=arguments.samples, iterations=2 if arguments.quick else 10)
    beliefs = jax.jit(sampler.on)(jax.random.key(0), graph)

    exact, weights = on_values(numbers), jnp.exp(beliefs.log_beliefs)
    mean, true = jnp.sum(weights * beliefs.points[..., 0], axis=1), exact @ VALUES
    sd, true_sd = jnp.sqrt(jnp.sum(weights * (beliefs.points[..., 0] - mean[:, None]) ** 2, axis=1)), jnp.sqrt(exact @ VALUES**2 - true**2)
    print(f"means differ from those of the grid by {jnp.sqrt(jnp.mean(((mean - true) / true_sd) ** 2)):.2f} of a standard deviation (rms)")
    print(f"standard deviations are {float(jnp.min(sd / true_sd)):.2f} to {float(jnp.max(sd / true_sd)):.2f} times those of the grid")
    figure, axes = plt.subplots(SIDE, SIDE, figsize=(10, 8), sharex=True, sharey=True, layout="constrained")
    for node, axis in enumerate(axes.ravel()):
        axis.hist(beliefs.points[node, :, 0], bins=np.linspace(-10, 10, 41), weights=weights[node], density=True, color="#9ecae1", label="particles")
        axis.plot(VALUES, exact[node] / (VALUES[1] - VALUES[0]), color="#d95f02", lw=1.2, label="belief propagation on a grid")
        axis.axvline(float(numbers[node]), color="0.4", lw=0.8, ls=":", label="seen")
    axes[0, 0].set_xlim(-10, 10)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    figure.supxlabel("value of the node; density upwards")
    arguments.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out / "beliefs.png", dpi=120)


if __name__ == "__main__":
    main()
