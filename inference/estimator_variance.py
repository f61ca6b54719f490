"""How far two samplers' posterior means lie from the truth at equal computation (Poon & Fleet 2002, Fig. 8).

    python inference/estimator_variance.py --session SESSION --frame 20 --json figures.json --plot figures.png

The hybrid Monte Carlo filter against the particle filter, on one frame after one fixed prediction mixture: at equal evaluations of the likelihood (a
gradient counts what it costs) and at equal seconds. SESSION is what `bayes-body import` makes. Copy this file and change it.
"""

import argparse
import json
import sys
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Estimator variance of hybrid Monte Carlo and of a particle filter at equal computation.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--json", type=Path, required=True, help="file for all figures")
    parser.add_argument("--plot", type=Path, help="a .png of them")
    parser.add_argument("--model", default="poon_fleet_2002_legs", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--frame", type=bb.whole_number(1), default=10, help="which, counted from 0 (%(default)s)")
    parser.add_argument("--components", type=bb.whole_number(1), default=10, help="of the prediction mixture (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(2), default=50, help="of each sampler (%(default)s)")
    parser.add_argument(
        "--truth", type=bb.whole_number(1), default=4_000_000, help="particles of each of the two runs that find the true mean (%(default)s)"
    )
    parser.add_argument(
        "--set", type=bb.setting, action="append", default=[], metavar="KEY=VALUE", help="an option of hmc other than the model's, such as step=0.1"
    )
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="of everything random (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="10 runs, a truth of 400 000 particles")
    return parser.parse_args()


def main() -> None:
    arguments, ev = parse(), bb.compare.estimator_variance
    bb.configure()
    session = bb.load_session(arguments.session)
    model = bb.with_first_pose(bb.load_model(arguments.model, session), session)
    runs, many, long = (10, 400_000, 1000) if arguments.quick else (arguments.runs, arguments.truth, 4000)
    own = model.definition.kernel.options.model_dump() if model.definition.kernel.kind == "hmc" else {}
    options = own | dict(arguments.set)
    draws, keys = options.get("particles", 400), jax.random.split(jax.random.key(arguments.seed), 6)

    before = bb.track(session, model, bb.kernels.sir(), keys[0], particles=20_000, frames=arguments.frame)
    mixture = ev.mixture_after(keys[1], before, arguments.components)
    density = model.density(model.observe(bb.read_frame(session, arguments.frame)), mixture)

    sampler, cost, bar = ev.hmc_sampler(**options), ev.gradient_cost(density), sys.stderr.isatty()
    truth = ev.best_truth(keys[2], density, many, long, bar)
    hmc = ev.run_many(keys[3], density, lambda key, density: sampler(key, density, draws), runs, ev.watched("runs of hmc", bar))
    sizes = {"evaluations": round(hmc.evaluations * cost)}
    equal = {"evaluations": ev.run_many(keys[4], density, ev.sir_sampler(sizes["evaluations"]), runs, ev.watched("runs of sir", bar))}
    sizes["seconds"] = max(round(sizes["evaluations"] * hmc.seconds / equal["evaluations"].seconds), 1)
    equal["seconds"] = ev.run_many(keys[5], density, ev.sir_sampler(sizes["seconds"]), runs, ev.watched("runs of sir", bar))
    found = {at: ev.figures_of(model.body.dof_names, sir, hmc, truth) for at, sir in equal.items()}
    for at, row in found.items():
        low, high = row["ratio_interval"]
        print(f"at equal {at}: error² of sir ({sizes[at]} particles) over hmc {row['ratio_median']:.2f}, 95 % from {low:.2f} to {high:.2f}")
    doubt = float(np.max(truth.error / np.mean((hmc.means - truth.mean) ** 2, axis=0)))
    print(f"the truth is by {truth.by}, of {truth.effective:.0f} effective draws; its two runs differ by {doubt:.1%} of hmc's error² at worst")
    settings = vars(arguments) | {"hmc": options, "gradient_cost": cost, "runs": runs, "truth": many}
    settings |= {"truth_by": truth.by, "truth_rhat": truth.rhat, "truth_effective": truth.effective, "truth_difference": doubt}
    figures = {**found["evaluations"], "equal_seconds": found["seconds"], "settings": settings}
    arguments.json.write_text(json.dumps(figures, indent=2, default=str) + "\n", encoding="utf-8")
    if arguments.plot:
        ev.draw_ratios(arguments.plot, {at: row["per_dof"] for at, row in found.items()})


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
