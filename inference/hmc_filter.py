"""Sample the posterior of a person's pose, frame by frame, with the hybrid Monte Carlo filter (Poon & Fleet 2002).

    python inference/hmc_filter.py --session SESSION --out RUN

The filter runs a few chains of Hamiltonian Monte Carlo per frame, on the likelihood times the mixture of predictions from the previous frame. If the
posterior has several modes, a chain may stay in one: compare chains and runs. SESSION is a folder made by `bayes-body import`. Copy this file and
change it.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Sample the posterior of a person's pose with the hybrid Monte Carlo filter.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--out", type=Path, required=True, help="folder for posterior.nc and the overlay")
    parser.add_argument("--model", default="poon_fleet_2002_legs", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=400, help="draws kept per frame, all chains together (%(default)s)")
    parser.add_argument("--chains", type=bb.whole_number(1), default=8, help="chains per frame (%(default)s)")
    parser.add_argument("--starts", type=bb.whole_number(1), default=500, help="predictions from which the chains' starts are drawn (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(1), default=2, help="independent filters (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two frames, 64 draws: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    session = bb.load_session(arguments.session)
    model = bb.load_model(arguments.model, session)
    particles, burn_in = (64, 10) if arguments.quick else (arguments.particles, 50)
    frames = min(2, session.frames) if arguments.quick else session.frames
    arguments.out.mkdir(parents=True, exist_ok=True)

    kernel = model.kernel("hmc", chains=arguments.chains, starts=arguments.starts, burn_in=burn_in, leapfrog_steps=30)
    draws = bb.track(jax.random.key(arguments.seed), session, model, kernel, particles=particles, runs=arguments.runs, frames=frames)
    posterior = bb.to_datatree(draws)
    bb.save_posterior(posterior, arguments.out / "posterior.nc")
    bb.draw_overlay(session, draws, arguments.out)

    last = posterior["posterior"]["pose"].isel(frame=-1)  # draws of equal weight
    print(f"{'dof':<16}{'mean':>10} ± sd        in frame {frames - 1}, all runs together")
    for dof in last.dof.values:
        scale, unit = (1000, "mm") if last.sel(dof=dof).unit == "m" else (np.degrees(1), "deg")
        print(f"{dof:<16}{float(last.sel(dof=dof).mean()) * scale:10.1f} ± {float(last.sel(dof=dof).std()) * scale:<7.1f} {unit}")
    ess, accepted = posterior["filter"]["ess"], posterior["filter"]["acceptance_rate"]
    print(f"effective particles for the worst dof: {float(ess.min()):.0f} at least, {float(ess.median()):.0f} median, of {particles}")
    print(f"accepted: at least {float(accepted.min()):.0%} of a frame's trajectories; if it is below 20% or above 90%, change the step")
    print(f"frames lost: {len(draws.frames_lost)}; seconds: {draws.timing.total:.1f}, {draws.timing.compile:.1f} of them compilation")
    evidence = posterior["filter"]["log_evidence"].sum("frame").values
    print(f"log-evidence: {np.logaddexp.reduce(evidence) - np.log(len(evidence)):.2f} (by run: {', '.join(f'{value:.2f}' for value in evidence)})")
    print("This is log p(images | model), up to the likelihood's constant, estimated from the starts of the chains.")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
