"""The families of samplers on one frame of a session, with one density: `python tests/bench/families.py SESSION [--model M] [--kernel K ...]`.

Each kernel samples the first frame from the same uncertain first pose, some times with different keys. Two kernels that have converged agree: the
means of the markers differ by little, in standard deviations of the posterior, no more than the runs of each kernel differ among themselves.
"""

import argparse
import json
import time
from pathlib import Path

import bayes_body

bayes_body.configure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from bayes_body.base.registry import find  # noqa: E402
from bayes_body.initial import load_model  # noqa: E402
from bayes_body.kernels.batching import everywhere  # noqa: E402
from bayes_body.model.kernel_options import kernel_options  # noqa: E402
from bayes_body.recording.observation.frames import read_frame  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402


def moments(model, particles):
    """Means and standard deviations of the markers, metres."""
    weights = jnp.exp(particles.log_weights)
    markers = jax.lax.map(model.markers, particles.states[model.body.variable])
    mean = jnp.einsum("n,nmk->mk", weights, markers)
    return mean, jnp.sqrt(jnp.einsum("n,nmk->mk", weights, (markers - mean) ** 2))


def sampled(model, density, kernel, particles: int, runs: int):
    """Means and standard deviations (run, marker, 3), log-evidence and effective particles of each run, and seconds of a warm run."""
    before = model.start(particles)

    def run(key, density):
        after, info = kernel(key, density.previous, density)
        return moments(model, after), info.log_evidence, info.ess

    compiled, density, found, seconds = jax.jit(run), everywhere(density.with_previous(before)), [], []
    for number in range(runs + 1):
        begin = time.perf_counter()
        found.append(jax.device_get(compiled(everywhere(jax.random.key(number)), density)))
        seconds.append(time.perf_counter() - begin)
    (mean, sd), evidence, ess = jax.tree.map(lambda *each: np.stack(each), *found[1:])
    return mean, sd, evidence, ess, min(seconds[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path, help="folder of the session")
    parser.add_argument("--model", default="loose_limbed_15", help="a definition's name or path")
    parser.add_argument("--kernel", nargs="+", default=["particle_bp", "tempered", "hmc", "sir"], help="kernels; the first is the reference")
    parser.add_argument("--particles", type=int, default=500, help="particles or joint draws of a run")
    parser.add_argument("--runs", type=int, default=4, help="runs of each kernel, with different keys")
    parser.add_argument("--set", nargs="*", default=[], help="options of kernels, such as tempered.moves=4")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    arguments = parser.parse_args()
    session = load_session(arguments.session)
    model = load_model(arguments.model, session)
    density = model.density(model.observe(read_frame(session, 0)))
    rows, first = {}, None
    for name in arguments.kernel:
        own = [each.split(".", 1)[1].split("=", 1) for each in arguments.set if each.startswith(f"{name}.")]
        overrides = {key: json.loads(value) for key, value in own} | {"particles": arguments.particles}
        kind, options = kernel_options(model.definition, name, overrides)
        try:
            kernel = find("kernel", kind).build(options=options)
            mean, sd, evidence, ess, seconds = sampled(model, density, kernel, arguments.particles, arguments.runs)
        except bayes_body.InputError as error:
            print(f"{name}: {error}", flush=True)
            continue
        pooled = np.sqrt((sd**2).mean(0) + mean.var(0))
        first = (mean.mean(0), pooled) if first is None else first
        between, apart = mean.std(0, ddof=1) / first[1], (mean.mean(0) - first[0]) / first[1]
        rows[name] = {
            "apart_sd": float(np.sqrt(np.mean(apart**2))),
            "apart_sd_worst": float(np.abs(apart).max()),
            "between_runs_sd": float(np.sqrt(np.mean(between**2))),
            "sd_ratio": [float(each) for each in np.quantile(pooled / first[1], [0.05, 0.5, 0.95])],
            "log_evidence": [float(evidence.mean()), float(evidence.std(ddof=1))],
            "ess": float(ess.mean()),
            "seconds": seconds,
        }
        figures = ", ".join(f"{key} {np.array2string(np.asarray(value), precision=2)}" for key, value in rows[name].items())
        print(f"{name}: {figures}; sd {1e3 * pooled.mean():.1f} mm", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
