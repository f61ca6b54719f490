"""Sample the posterior of a person's pose, frame by frame, with the particle filter (Gordon, Salmond & Smith 1993).

    python inference/particle_filter.py --session SESSION --out RUN

The weighted particles are a sample of p(pose | images so far). Their spread measures the uncertainty as long as enough of them are effective. With 31
dofs and a sharp likelihood, this takes many particles. SESSION is a folder made by `bayes-body import`. Copy this file and change it.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Sample the posterior of a person's pose with the particle filter.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--out", type=Path, required=True, help="folder for posterior.nc and the overlay")
    parser.add_argument("--model", default="deutscher_apf", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=4000, help="particles per run (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(1), default=2, help="independent filters (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two frames, 64 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    session = bb.load_session(arguments.session)
    model = bb.load_model(arguments.model, session)
    particles = 64 if arguments.quick else arguments.particles
    frames = min(2, session.frames) if arguments.quick else session.frames
    arguments.out.mkdir(parents=True, exist_ok=True)

    key = jax.random.key(arguments.seed)
    draws = bb.track(key, session, model, bb.kernels.sir(), particles=particles, runs=arguments.runs, frames=frames)
    posterior = bb.to_datatree(draws)
    bb.save_posterior(posterior, arguments.out / "posterior.nc")
    bb.draw_overlay(session, draws, arguments.out)

    pose, weights = posterior["posterior"]["pose"], np.exp(posterior["sample_stats"]["log_weight"])
    last = pose.weighted(weights).mean(("chain", "draw")).isel(frame=-1)
    sd = pose.weighted(weights).std(("chain", "draw")).isel(frame=-1)
    print(f"{'dof':<16}{'mean':>10} ± sd        in frame {frames - 1}, all runs together")
    for dof in last.dof.values:
        scale, unit = (1000, "mm") if last.sel(dof=dof).unit == "m" else (np.degrees(1), "deg")
        print(f"{dof:<16}{float(last.sel(dof=dof)) * scale:10.1f} ± {float(sd.sel(dof=dof)) * scale:<7.1f} {unit}")
    ess = posterior["filter"]["ess"]
    print(f"effective particles: {float(ess.min()):.0f} at least, {float(ess.median()):.0f} median, of {particles}")
    print("If only a few tens of particles are effective, do not trust the sd.")
    print(f"frames lost: {len(draws.frames_lost)}; seconds: {draws.timing.total:.1f}, {draws.timing.compile:.1f} of them compilation")

    evidence = posterior["filter"]["log_evidence"].sum("frame").values
    print(f"log-evidence: {np.logaddexp.reduce(evidence) - np.log(len(evidence)):.2f} (by run: {', '.join(f'{value:.2f}' for value in evidence)})")
    print("This is log p(images | model), up to the likelihood's constant. Between two motions or bodies with the same likelihood, the one with the")
    print("larger value predicted this recording better, by a factor of exp(difference). The spread over the runs is its error.")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
