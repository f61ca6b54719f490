"""Track a walk with few cameras: an annealed filter with an activity, one without, and the activity's posterior (Darby, Li & Costen 2008, Fig. 2).

    python inference/few_cameras.py --cameras 2 --runs 10 --json figures.json --plot errors.png --out WALK

Without --session, a walk is filmed with four cameras. The first --cameras of them are used. Copy this file and change it.
"""

import argparse
import json
import sys
from pathlib import Path

import bayes_body as bb
from bayes_body.errors import InputError

PANELS = {"absolute": "absolute_m", "optimistic": "optimistic_m", "relative": "relative_m"}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track a walk with few cameras, with and without an activity.")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--session", type=Path, help="folder with a session.toml and true markers")
    where.add_argument("--out", type=Path, help="folder for a walk that is filmed")
    parser.add_argument("--motion", type=Path, help="with --out: a captured walk; by default the walking cycle that ships")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--plot", type=Path, help="file for a picture of the errors, .png")
    parser.add_argument("--cameras", type=bb.whole_number(1), default=2, help="use the first so many (%(default)s); with 1, silhouettes alone")
    parser.add_argument(
        "--activity", help="an activity: a name, or an .npz of `bayes-body learn activity-hmm`; by default people who are not tracked"
    )
    parser.add_argument(
        "--subject", choices=["known", "unknown"], default="unknown", help="whether the activity is the tracked person's (%(default)s)"
    )
    parser.add_argument("--gamma", type=float, help="exponent of the agreement of areas; by default 5 with one camera, else 0")
    parser.add_argument("--methods", nargs="+", choices=["hmm_apf", "apf", "hmm_tempered"], help="only these; all by default")
    parser.add_argument("--runs", type=bb.whole_number(1), default=10, help="runs of each (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(1), default=150, help="number of frames (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="seed of the film and of the first run (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="2 runs, 20 frames, 100 particles at most: a trial")
    arguments = parser.parse_args()
    if arguments.subject == "known" and arguments.activity is None:
        parser.error("--subject known needs --activity, learned from other walks of the tracked person with `bayes-body learn activity-hmm`")
    return arguments


def main() -> None:
    arguments = parse()
    bb.configure()
    frames, runs, most = (20, 2, 100) if arguments.quick else (arguments.frames, arguments.runs, None)
    if arguments.session:
        whole = bb.load_session(arguments.session)
    else:
        whole = bb.compare.film_in_room(arguments.out, frames, arguments.seed, arguments.motion, bb.watched("filming"))
    session = bb.compare.with_cameras(whole, arguments.cameras, arguments.seed)
    definitions = bb.compare.few_camera_definitions(arguments.cameras, arguments.activity, arguments.subject == "known", arguments.gamma)
    found = {}
    for name in arguments.methods or definitions:
        own = definitions[name].kernel.options.particles
        particles = own if most is None else min(own, most)
        found[name] = bb.compare.follow(session, definitions[name], runs, arguments.seed, frames, particles, bb.watched(name))
    figures = {"cameras": arguments.cameras, "subject": arguments.subject, "runs": runs, **{name: each.figures() for name, each in found.items()}}
    arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    for name in found:
        print(name, *(f"{key} {_told(value)}" for key, value in figures[name].items()), sep="\n    ")
    if arguments.plot:
        bb.draw_error_curves(arguments.plot, {kind: {name: getattr(each, field) for name, each in found.items()} for kind, field in PANELS.items()})


def _told(value) -> str:
    if isinstance(value, dict):
        return f"{value['mean']:.1f}" + (f" ± {value['sd']:.1f}" if value["sd"] is not None else "")
    return f"{value:.2f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
