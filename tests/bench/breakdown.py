"""Where the inner loop's time goes: each stage its own program over all particles. `python tests/bench/breakdown.py [--json F]`.

Kinematics, patches, projection and look-up contain one another: what a stage adds is its line less the one above. The others stand alone.
"""

import argparse
import json
from pathlib import Path

import bayes_body

# Before the other imports, which may touch JAX.
bayes_body.configure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from case import Case, Timing, load, measure, recording, spread  # noqa: E402

from bayes_body.base.geometry.camera import to_camera  # noqa: E402
from bayes_body.kernels.batching import everywhere  # noqa: E402
from bayes_body.kernels.weights import resampler  # noqa: E402
from bayes_body.model.body.solids import part_transforms, patches  # noqa: E402
from bayes_body.model.likelihood.patch_pixels import rig_pixels  # noqa: E402
from bayes_body.model.likelihood.silhouette_edges import SilhouetteEdges  # noqa: E402

# Every stage ends in one number a particle, so that nothing is left out and little is written.


def kinematics(state, density) -> jax.Array:
    return sum(leaf.sum() for leaf in part_transforms(_likelihood(density).body, state["pose"]))


def rig_patches(state, density) -> jax.Array:
    term = _likelihood(density)
    T_world_part = jax.lax.optimization_barrier(part_transforms(term.body, state["pose"]))

    def one(camera):
        return sum(to_camera(camera, vector).sum() for vector in patches(term.body, T_world_part, camera.viewpoint))

    return jax.vmap(one)(term.rig).sum()


def projection(state, density) -> jax.Array:
    term = _likelihood(density)
    pixels = rig_pixels(term.body, term.rig, term.samples, state["pose"])
    return jnp.sum(jnp.where(pixels.visible, pixels.u + pixels.v, 0.0))


def whole(state, density) -> jax.Array:
    return density.log_likelihood(state, state)


def constraint(state, density) -> jax.Array:
    return density.log_constraint(state, state)


def noise(particle, density) -> jax.Array:
    key, state = particle
    return sum(leaf.sum() for leaf in density.transition.perturb(key, state, state, 1.0).values())


def with_gradient(stage):
    return lambda state, density: jax.value_and_grad(stage)(state, density)


def _likelihood(density) -> SilhouetteEdges:
    (factor,) = (factor for factor in density.factors if factor.side == "likelihood")
    return factor.log_potential


def stages(nearest: Case, bilinear: Case) -> dict[str, Timing]:
    """Seconds of each stage, all particles."""
    found: dict[str, Timing] = {}
    nested = [("kinematics", kinematics), ("+ patches", rig_patches), ("+ projection", projection)]
    for name, stage in nested:
        found[name] = _measure(name, spread(stage), nearest.states, nearest.density)
    found["+ look-up, nearest"] = _measure("+ look-up, nearest", spread(whole), nearest.states, nearest.density)
    found["+ look-up, bilinear"] = _measure("+ look-up, bilinear", spread(whole), bilinear.states, bilinear.density)
    for name, stage in [*nested, ("+ look-up, bilinear", whole)]:
        label = f"{name}, value and gradient"
        found[label] = _measure(label, spread(with_gradient(stage)), bilinear.states, bilinear.density)
    found["constraint"] = _measure("constraint", spread(constraint), nearest.states, nearest.density)
    count = nearest.states["pose"].shape[0]
    keys = everywhere(jax.random.split(jax.random.key(1), count))
    found["noise"] = _measure("noise", spread(noise), (keys, nearest.states), nearest.density)
    log_weights = everywhere(jax.random.normal(jax.random.key(2), (count,)))
    found["resampling"] = _measure("resampling", resampler("systematic"), everywhere(jax.random.key(3)), log_weights)
    return found


def _measure(name: str, function, *arguments) -> Timing:
    timing = measure(function, *arguments)
    leaves = jax.tree.leaves(arguments[0])
    count = leaves[0].shape[0] if leaves[0].ndim else arguments[1].shape[0]
    print(f"{name:44} {1e6 * timing.median / count:8.3f} {1e6 * timing.best / count:8.3f} {timing.compile:10.2f}", flush=True)
    return timing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    session = recording()
    nearest, bilinear = (load(session, lookup, options.particles) for lookup in ("nearest", "bilinear"))
    print(f"{options.particles} particles, {jax.default_backend()}, {len(jax.devices())} devices, jax {jax.__version__}")
    print(f"{'µs an evaluation':44} {'median':>8} {'best':>8} {'compile s':>10}")
    found = stages(nearest, bilinear)
    if options.json:
        options.json.write_text(json.dumps({name: 1e6 * timing.median / options.particles for name, timing in found.items()}, indent=2))


if __name__ == "__main__":
    main()
