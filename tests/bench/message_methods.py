"""The methods of message passing on ten parts with markers, against Hamiltonian Monte Carlo. `python tests/bench/message_methods.py [METHOD ...]`.

One frame of loose_limbed_10 without penetration, with one state before: means of the markers, evidence, effective particles and seconds.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.density.density import Density
from bayes_body.kernels import hmc, particle_bp
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.workshop.calibration.problem import point_mass
from bayes_body.workshop.calibration.scene import model_in_a_room

RUNS, DRAWS, REFERENCE = 8, 500, 2000
LIKELIHOOD = '[[likelihood]]\nkind = "markers_gaussian"\nsd_px = 12.0\nat_diagonal_px = 800.0\n\n[kernel]\nkind = "sir"\n'


def problem():
    """The body, the state before, and the density given simulated markers as a function of the number of particles before."""
    text = load_definition("loose_limbed_10").text.replace("at_fps = 60", "at_fps = 25")
    text = text[: text.index('[[potential]]\nkind = "penetration"')] + LIKELIHOOD
    model, key = model_in_a_room(parse_definition("ten_parts", text, None)), jax.random.key(3)
    before = {"parts": model.initial["parts"]}
    truth = model.transition.sample(key, before)
    data = Density(model.transition, model.factors, {}, point_mass(before, 4)).simulate(jax.random.fold_in(key, 1), truth)
    return model.body, before, lambda count: Density(model.transition, model.factors, data, point_mass(before, count))


def moments(body, particles):
    """Means and standard deviations of the markers, metres."""
    weights = jnp.exp(particles.log_weights)
    markers = jax.lax.map(lambda parts: placed_markers(body, parts), particles.states["parts"])
    mean = jnp.einsum("n,nmk->mk", weights, markers)
    return mean, jnp.sqrt(jnp.einsum("n,nmk->mk", weights, (markers - mean) ** 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("methods", nargs="*", default=["mixture", "pbp", "epbp", "pampas"])
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--iterations", type=int, default=6)
    arguments = parser.parse_args()
    body, before, density = problem()

    def sampled(kernel, count):
        def run(key, density):
            particles, info = kernel(key, point_mass(before, count), density)
            return moments(body, particles), info

        return jax.jit(run)

    chains = {"chains": 4, "burn_in": 200, "thinning": 2, "leapfrog_steps": 10, "mass": "adapted", "target_acceptance": 0.8}
    reference = hmc(particles=REFERENCE, starts_by="annealing", starts=200, **chains)
    (mean, sd), _ = jax.block_until_ready(sampled(reference, REFERENCE)(jax.random.key(0), density(REFERENCE)))
    print(f"posterior standard deviation of a marker's coordinate: {1e3 * float(jnp.mean(sd)):.1f} mm")
    for method in arguments.methods:
        run = sampled(particle_bp(method=method, samples=arguments.samples, iterations=arguments.iterations), DRAWS)
        found, seconds = [], []
        for number in range(RUNS + 1):
            begin = time.perf_counter()
            found.append(jax.block_until_ready(run(jax.random.key(number), density(DRAWS))))
            seconds.append(time.perf_counter() - begin)
        means, sds = (np.stack([each[0][k] for each in found[1:]]) for k in (0, 1))
        evidence = np.array([info.log_evidence for _, info in found[1:]])
        ess = np.array([info.messages["belief_ess"] for _, info in found[1:]])
        error = 1e3 * np.linalg.norm(means - mean, axis=-1)
        bias = 1e3 * np.linalg.norm(means.mean(0) - mean, axis=-1)
        print(f"{method}: markers {error.mean():.1f} mm from the reference, worst {error.mean(0).max():.1f}, mean of the runs {bias.mean():.1f}")
        print(f"  standard deviations {np.mean(sds / sd):.3f} times; log-evidence {evidence.mean():.2f} with sd {evidence.std():.2f}")
        print(f"  effective particles of a belief {ess.mean():.0f}, least {ess.min(1).mean():.0f}; {min(seconds[1:]):.2f} s", flush=True)


if __name__ == "__main__":
    main()
