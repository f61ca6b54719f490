"""Sample the joint posterior of some consecutive frames with the No-U-Turn sampler (Hoffman & Gelman 2014).

    python inference/window.py --run RUN --first 10 --frames 10 --out OUT

RUN is the folder of a run made by `bayes-body track`, or of its smoothed run. The filter's particles in the frame before the window are its prior.
The chains start from smoothed paths. Images up to the end of the window count. The error bars can be checked: R-hat, effective draws and divergences
say whether the chains found one distribution. Copy this file and change it.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

import bayes_body as bb
from bayes_body.base.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Sample the joint posterior of some consecutive frames by NUTS.")
    parser.add_argument("--run", type=Path, required=True, help="folder of a run made by `bayes-body track`")
    parser.add_argument("--out", type=Path, required=True, help="folder for posterior.nc")
    parser.add_argument("--first", type=bb.whole_number(1), help="number of the window's first frame; by default the window ends with the run")
    parser.add_argument("--frames", type=bb.whole_number(1), default=10, help="frames of the window (%(default)s)")
    parser.add_argument("--chains", type=bb.whole_number(2), default=4, help="independent chains (%(default)s)")
    parser.add_argument("--warm-up", type=bb.whole_number(20), default=500, help="transitions in which a chain tunes itself (%(default)s)")
    parser.add_argument("--draws", type=bb.whole_number(1), default=1000, help="transitions of each chain after warm-up (%(default)s)")
    parser.add_argument("--paths", type=bb.whole_number(2), default=250, help="the smoother's paths for each run of the filter (%(default)s)")
    parser.add_argument("--prior", choices=["gaussian", "particles"], default="gaussian", help="form of the first frame's prior (%(default)s)")
    parser.add_argument("--target-acceptance", type=float, default=0.9, help="with divergences, closer to 1: smaller steps (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two frames, two chains of 100 draws: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    chosen_options = {name: getattr(arguments, name) for name in ("chains", "warm_up", "draws", "paths", "target_acceptance")}
    options = {"chains": 2, "warm_up": 100, "draws": 100, "paths": 40} if arguments.quick else chosen_options
    frames = 2 if arguments.quick else arguments.frames
    arguments.out.mkdir(parents=True, exist_ok=True)

    window = bb.window_of_run(arguments.run, frames, arguments.first, arguments.seed, arguments.prior, **options)
    posterior = bb.window_to_datatree(window)
    bb.save_posterior(posterior, arguments.out / "posterior.nc")

    middle = frames // 2
    pose, smoothed = (posterior[group]["pose"].isel(frame=middle) for group in ("posterior", "smoothed"))
    print(f"{'dof':<16}{'mean':>10} ± sd           smoother's      in frame {window.frames[middle]}")
    for dof in pose.dof.values:
        scale, unit = (1000, "mm") if pose.sel(dof=dof).unit == "m" else (np.degrees(1), "deg")
        columns = [
            f"{float(draws.mean()) * scale:10.1f} ± {float(draws.std()) * scale:<7.1f}" for draws in (pose.sel(dof=dof), smoothed.sel(dof=dof))
        ]
        print(f"{dof:<16}{''.join(columns)} {unit}")
    for sentence in bb.window_sentences(window):
        print(sentence)
    print(f"{arguments.out / 'posterior.nc'}: `arviz.from_netcdf` reads it")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
