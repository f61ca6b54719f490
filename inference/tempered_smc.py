"""Sample the posterior of a person's pose, frame by frame, with tempered SMC (Del Moral, Doucet & Jasra 2006), and report the evidence.

    python inference/tempered_smc.py --session SESSION --out RUN

In each frame, the particles move from the prediction to the posterior in stages, by Hamiltonian Monte Carlo. This works even if few draws from the
prediction have a high likelihood. SESSION is a folder made by `bayes-body import`. Copy this file and change it.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Sample the posterior of a person's pose with tempered SMC.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--out", type=Path, required=True, help="folder for posterior.nc and the overlay")
    parser.add_argument("--model", default="tempered_smc", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=500, help="particles per run (%(default)s)")
    parser.add_argument("--moves", type=bb.whole_number(1), default=1, help="Markov moves per stage (%(default)s)")
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

    kernel, key = model.kernel("tempered", moves=arguments.moves), jax.random.key(arguments.seed)
    draws = bb.track(key, session, model, kernel, particles=particles, runs=arguments.runs, frames=frames)
    posterior = bb.to_datatree(draws)
    bb.save_posterior(posterior, arguments.out / "posterior.nc")
    bb.draw_overlay(session, draws, arguments.out)

    pose = posterior["posterior"]["pose"].weighted(np.exp(posterior["sample_stats"]["log_weight"]))
    last, sd = (moment(("chain", "draw")).isel(frame=-1) for moment in (pose.mean, pose.std))
    print(f"{'dof':<16}{'mean':>10} ± sd        in frame {frames - 1}, all runs together")
    for dof in last.dof.values:
        scale, unit = (1000, "mm") if last.sel(dof=dof).unit == "m" else (np.degrees(1), "deg")
        print(f"{dof:<16}{float(last.sel(dof=dof)) * scale:10.1f} ± {float(sd.sel(dof=dof)) * scale:<7.1f} {unit}")
    filtered = posterior["filter"]
    print(f"effective particles: {float(filtered['ess'].min()):.0f} at least, of {particles}; frames lost: {len(draws.frames_lost)}")
    stages, accepted = float(filtered["inverse_temperature"].count("layer").mean()), float(filtered["acceptance_rate"].mean())
    print(f"stages per frame: {stages:.1f}; fraction of moves accepted: {accepted:.2f}")
    print(f"seconds: {draws.timing.total:.1f}, {draws.timing.compile:.1f} of them compilation")
    evidence = filtered["log_evidence"].sum("frame").values
    print(f"log-evidence: {np.logaddexp.reduce(evidence) - np.log(len(evidence)):.2f} (by run: {', '.join(f'{value:.2f}' for value in evidence)})")
    print("This is log p(images | model), up to the likelihood's constant.")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
