"""Compare the errors of two samplers' posterior means at equal computation (Poon & Fleet 2002, Fig. 8 and 9).

    python inference/papers/poon_fleet_2002/estimator_variance.py --session SESSION --frame 20 --json figures.json --plot figures.png

The program compares the hybrid Monte Carlo filter with the particle filter on one frame, both with the same fixed prediction mixture. It does so at
equal evaluations of the likelihood (a gradient counts by its cost) and at equal seconds, and then along the frames that follow. SESSION is a folder
made by `bayes-body import`.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import jax
from along_frames import along, along_summary
from equal_computation import at_equal_computation, figures_of, mixture_after, summary
from ratio_plot import draw_ratios
from true_mean import best_truth

import bayes_body as bb
from bayes_body.base.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Estimator variance of hybrid Monte Carlo and of a particle filter at equal computation.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--json", type=Path, required=True, help="file for all figures")
    parser.add_argument("--plot", type=Path, help="a .png with a plot of the ratios")
    parser.add_argument("--model", default="poon_fleet_2002_legs", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--frame", type=bb.whole_number(1), default=10, help="the frame, counted from 0 (%(default)s)")
    parser.add_argument("--components", type=bb.whole_number(1), default=10, help="components of the prediction mixture (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(0), help="number of frames to follow after it (20; none with --quick)")
    parser.add_argument("--runs", type=bb.whole_number(2), help="runs of each sampler (50; 10 with --quick)")
    parser.add_argument("--truth", type=bb.whole_number(1), help="particles of each run that estimates the true mean (4000000; 400000 with --quick)")
    parser.add_argument("--set", type=bb.setting, action="append", default=[], metavar="KEY=VALUE", help="an option of hmc, such as step=0.1")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="fewer runs, on one frame, and a rougher true mean")
    return parser.parse_args()


def main() -> None:
    arguments, bar = parse(), sys.stderr.isatty()
    bb.configure()
    session = bb.load_session(arguments.session)
    model = bb.load_model(arguments.model, session)
    runs, many, long, frames = (10, 400_000, 600, 0) if arguments.quick else (50, 4_000_000, 6000, 20)
    runs, many, frames = arguments.runs or runs, arguments.truth or many, frames if arguments.frames is None else arguments.frames
    usual = model.definition.kernel.options.model_dump() if model.definition.kernel.kind == "hmc" else {}
    options, keys = usual | dict(arguments.set), jax.random.split(jax.random.key(arguments.seed), 6)
    draws = options.get("particles", 400)

    before = bb.track(keys[0], session, model, bb.kernels.sir(), particles=20_000, frames=arguments.frame)
    mixture = mixture_after(keys[1], before, arguments.components)
    shown = range(arguments.frame, max(min(arguments.frame + frames, session.frames), arguments.frame + 1))
    densities = [model.density(model.observe(bb.read_frame(session, frame)), mixture) for frame in shown]

    equal = at_equal_computation(keys[2], densities[0], options, draws, runs, bar)
    truth = best_truth(keys[3], densities[0], many, long, bar)
    figures = figures_of(model.body.dof_names, equal, truth)
    figures["settings"] |= vars(arguments) | {"hmc": options, "runs": runs, "truth": many}
    print(summary(figures))
    save(arguments, figures)
    if frames:
        filters = {f"hmc, {carry}": (bb.kernels.hmc(**options | {"carry": carry}), draws) for carry in ("means", "draws")}
        filters["sir"] = bb.kernels.sir(), equal.particles["evaluations"]
        figures["frames"] = along(keys[4], densities, mixture, filters, runs, 400 if arguments.quick else 1600, bar)
        print(along_summary(figures["frames"]))
        save(arguments, figures)


def save(arguments: argparse.Namespace, figures: dict[str, Any]) -> None:
    arguments.json.write_text(json.dumps(figures, indent=2, default=str) + "\n", encoding="utf-8")
    if arguments.plot:
        draw_ratios(arguments.plot, figures)


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
