"""Find a person's pose, frame by frame, with the annealed particle filter (Deutscher & Reid 2005).

    python inference/annealed_filter.py --session SESSION --out RUN

This filter is a mode seeker: its particles gather where the likelihood is high. It finds the pose. The spread of its particles does not measure
uncertainty, and it estimates no evidence. For a sample of the posterior see particle_filter.py. SESSION is a folder made by `bayes-body import`. Copy
this file and change it.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Find a person's pose with the annealed particle filter, a mode seeker.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--out", type=Path, required=True, help="folder for posterior.nc and the overlay")
    parser.add_argument("--model", default="deutscher_apf", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=1000, help="particles per run (%(default)s)")
    parser.add_argument("--layers", type=bb.whole_number(1), default=5, help="annealing layers per frame (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(1), default=2, help="independent filters (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two frames, 64 particles, 2 layers: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    session = bb.load_session(arguments.session)
    model = bb.load_model(arguments.model, session)
    particles, layers = (64, 2) if arguments.quick else (arguments.particles, arguments.layers)
    frames = min(2, session.frames) if arguments.quick else session.frames
    arguments.out.mkdir(parents=True, exist_ok=True)

    kernel = model.kernel("annealed", layers=layers)
    draws = bb.track(jax.random.key(arguments.seed), session, model, kernel, particles=particles, runs=arguments.runs, frames=frames)
    posterior = bb.to_datatree(draws)
    bb.save_posterior(posterior, arguments.out / "posterior.nc")
    bb.draw_overlay(session, draws, arguments.out)

    pose, weights = posterior["posterior"]["pose"], np.exp(posterior["sample_stats"]["log_weight"])
    last = pose.weighted(weights).mean("draw").isel(frame=-1)  # (chain, dof): the pose that each run found
    print(f"{'dof':<16}{'mean':>8}{'range':>9}    of {arguments.runs} runs, in frame {frames - 1}")
    for dof in last.dof.values:
        scale, unit = (1000, "mm") if last.sel(dof=dof).unit == "m" else (np.degrees(1), "deg")
        each = last.sel(dof=dof) * scale
        print(f"{dof:<16}{float(each.mean()):8.1f}{float(each.max() - each.min()):9.1f}    {unit}")
    print(f"effective particles: {float(posterior['filter']['ess'].min()):.0f} at least, of {particles}; every layer keeps about half")
    print(f"frames lost: {len(draws.frames_lost)}; seconds: {draws.timing.total:.1f}, {draws.timing.compile:.1f} of them compilation")
    print("This filter is a mode seeker: its particles are not a sample of the posterior, so no interval is printed.")
    print("If runs disagree, the pose is doubtful. Agreement proves nothing.")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
