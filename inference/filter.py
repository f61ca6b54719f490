"""Sample the posterior of a person's pose, frame by frame, with any of the kernels.

    python inference/filter.py --session SESSION --out RUN --kernel tempered

`sir` is the particle filter, `tempered` tempered SMC, `hmc` the hybrid Monte Carlo filter: their weighted particles are a sample of
p(pose | images so far). `annealed` is a mode seeker: it finds the pose, and the spread of its particles does not measure uncertainty.
SESSION is a folder made by `bayes-body import`. Copy this file and change it.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.base.errors import InputError

# By kernel: a model whose posterior it samples well, particles, and options that differ from the model's.
KERNELS = {
    "sir": ("deutscher_2005", 4000, {}),
    "annealed": ("deutscher_2005", 1000, {}),
    "tempered": ("silhouettes", 500, {}),
    "hmc": ("poon_fleet_2002_legs", 400, {"chains": 8, "starts": 500, "burn_in": 50, "leapfrog_steps": 30}),
}
QUICK = {"annealed": {"layers": 2}, "hmc": {"burn_in": 10}}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Sample the posterior of a person's pose, frame by frame.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--out", type=Path, required=True, help="folder for posterior.nc and the overlay")
    parser.add_argument("--kernel", choices=KERNELS, default="tempered", help="the sampler (%(default)s)")
    parser.add_argument("--model", help="a definition's name or the path of your own; by default one that suits the kernel")
    parser.add_argument("--particles", type=bb.whole_number(1), help="particles per run; by default a number that suits the kernel")
    parser.add_argument("--set", type=bb.setting, action="append", default=[], metavar="KEY=VALUE", help="an option of the kernel: moves=2")
    parser.add_argument("--runs", type=bb.whole_number(1), default=2, help="independent filters (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two frames, 64 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    usual_model, usual_particles, options = KERNELS[arguments.kernel]
    session = bb.load_session(arguments.session)
    model = bb.load_model(arguments.model or usual_model, session)
    particles, frames = arguments.particles or usual_particles, session.frames
    if arguments.quick:
        particles, frames, options = 64, min(2, frames), options | QUICK.get(arguments.kernel, {})
    arguments.out.mkdir(parents=True, exist_ok=True)

    kernel = model.kernel(arguments.kernel, **options | dict(arguments.set))
    draws = bb.track(jax.random.key(arguments.seed), session, model, kernel, particles=particles, runs=arguments.runs, frames=frames)
    posterior = bb.to_datatree(draws)
    bb.save_posterior(posterior, arguments.out / "posterior.nc")
    bb.draw_overlay(session, draws, arguments.out)

    print_pose(posterior, frames - 1, arguments.kernel)
    filtered = posterior["filter"]
    print(f"effective particles: {float(filtered['ess'].min()):.0f} at least, {float(filtered['ess'].median()):.0f} median, of {particles}")
    if filtered["acceptance_rate"].notnull().any():
        print(f"accepted moves: {float(filtered['acceptance_rate'].min()):.0%} at least, {float(filtered['acceptance_rate'].median()):.0%} median")
    print(f"frames lost: {len(draws.frames_lost)}; seconds: {draws.timing.total:.1f}, {draws.timing.compile:.1f} of them compilation")
    print_evidence(filtered["log_evidence"].sum("frame").values, arguments.kernel)


def print_pose(posterior, frame: int, kernel: str) -> None:
    """Print mean and sd of each dof in the last frame. Of a mode seeker: the mean, and how far the runs' means lie apart."""
    pose = posterior["posterior"]["pose"].isel(frame=-1).weighted(np.exp(posterior["sample_stats"]["log_weight"].isel(frame=-1)))
    mean, by_run = pose.mean(("chain", "draw")), pose.mean("draw")
    sd = pose.std(("chain", "draw"))
    print(f"{'dof':<16}{'mean':>10}{'  range of the runs' if kernel == 'annealed' else ' ± sd'}    in frame {frame}")
    for dof in mean.dof.values:
        scale, unit = (1000, "mm") if mean.sel(dof=dof).unit == "m" else (np.degrees(1), "deg")
        runs = by_run.sel(dof=dof) * scale
        spread = f"{float(runs.max() - runs.min()):9.1f}" if kernel == "annealed" else f" ± {float(sd.sel(dof=dof)) * scale:<7.1f}"
        print(f"{dof:<16}{float(mean.sel(dof=dof)) * scale:10.1f}{spread}    {unit}")


def print_evidence(evidence: np.ndarray, kernel: str) -> None:
    """Print the evidence of the runs, or why there is none."""
    if kernel == "annealed":
        print("This filter is a mode seeker: its particles are not a sample of the posterior, so no interval is printed.")
        print("If runs disagree, the pose is doubtful. Agreement proves nothing.")
        return
    print(f"log-evidence: {np.logaddexp.reduce(evidence) - np.log(len(evidence)):.2f} (by run: {', '.join(f'{value:.2f}' for value in evidence)})")
    print("This is log p(images | model), up to the likelihood's constant. Between two motions or bodies with the same likelihood, the one with the")
    print("larger value predicted this recording better, by a factor of exp(difference). The spread over the runs is its error.")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
