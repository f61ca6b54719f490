"""Smooth the swing of a leg seen by one camera in front of it, with particle belief propagation on the chain of frames.

    python inference/particle_bp_smoother.py --out RUN

A state is the hip's angle and velocity. The camera sees how high the knee is, and a swing to the front looks almost like one to the back. Messages go
forwards and backwards along the chain: a smoother whose beliefs may have two peaks. Copy this file and put in your own state and camera.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist

import bayes_body as bb

FRAMES, STEP_S, THIGH_M, AWAY_M, FOCAL_PX, PIXEL_SD = 36, 1 / 30, 0.42, 4.0, 1200.0, 1.5
# Both keep volumes, so one density serves both directions of time. The velocity changes by 8 rad/s in a second.
ON, BACK = jnp.array([[1.0, STEP_S], [0.0, 1.0]]), jnp.array([[1.0, -STEP_S], [0.0, 1.0]])
ROOT = 8.0 * jnp.linalg.cholesky(jnp.array([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]]))


def log_step(first, second):
    return dist.MultivariateNormal(ON @ first, scale_tril=ROOT).log_prob(second)


def draw_step(key, parameters, known, reverse):
    noise = ROOT @ jax.random.normal(key, (2,))
    return BACK @ (known - noise) if reverse else ON @ known + noise


def height_px(angle):
    return FOCAL_PX * THIGH_M * jnp.cos(angle) / (AWAY_M - THIGH_M * jnp.sin(angle))


def log_seen(pixel, state):
    return dist.StudentT(4.0, height_px(state[0]), PIXEL_SD).log_prob(pixel)


def swing(pixels):
    return bb.graph(
        {"frame": (len(pixels), 2)},
        bb.node_factor("first", dist.Normal(0.0, jnp.array([0.8, 4.0])).to_event(1), ["frame_0"]),
        bb.node_factor("camera", log_seen, parameters=jnp.asarray(pixels)),
        bb.edge_factor("step", log_step, [(i, i + 1) for i in range(len(pixels) - 1)], draw=draw_step),
    )


def recording(seed: int):
    """A damped pendulum, which is not the model above, and the pixel heights at which the knee was seen."""
    times = np.arange(FRAMES) * STEP_S
    angles = np.radians(6 + 38 * np.exp(-0.4 * times) * np.cos(2.2 * np.pi * times))
    return angles, np.asarray(height_px(angles)) + PIXEL_SD * np.random.default_rng(seed).laplace(size=FRAMES)


def main() -> None:
    parser = argparse.ArgumentParser(description="Smooth the swing of a leg seen by one camera.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the picture")
    parser.add_argument("--samples", type=bb.whole_number(10), default=500, help="particles of each frame (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="one iteration: a trial")
    arguments = parser.parse_args()
    angles, pixels = recording(arguments.seed)
    sampler = bb.kernels.particle_bp(samples=arguments.samples, iterations=1 if arguments.quick else 3, schedule="tree")
    beliefs = jax.jit(sampler.on)(jax.random.key(arguments.seed), swing(pixels))
    paths, true = np.degrees(beliefs.joint.values[..., 0]), np.degrees(angles)
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(
        f"log-evidence of {FRAMES} images: {beliefs.joint.log_evidence:.1f}; draws within 12 degrees: {100 * np.mean(abs(paths - true) < 12):.0f} %"
    )
    figure, axis = plt.subplots(figsize=(9, 5), layout="constrained")
    axis.plot(paths[:200].T, color="#1f77b4", alpha=0.06, lw=1)
    axis.legend(axis.plot(true, "k--"), ["true angle"])
    axis.set(xlabel="frame", ylabel="angle of the hip, degrees", title="200 draws of a swing that was seen from the front")
    figure.savefig(arguments.out / "swing.png", dpi=90)


if __name__ == "__main__":
    main()
