"""Find a person in single frames, or track them, with a loose-limbed body and without any first pose (Sigal, Isard, Haussecker & Black 2011).

    python inference/papers/sigal_2011/loose_limbed.py --session SESSION --mode pose --json poses.json --plot poses.png

`--mode pose` searches each frame on its own, and lets neighbouring frames decide which way the person faces. `--mode track` finds the person once and
follows them by particle belief propagation. With the session's true markers, errors are those of the paper's tables.
"""

import argparse
import json
import sys
from pathlib import Path

import jax

import bayes_body as bb
from bayes_body.base.errors import InputError

sys.path.append(str(Path(__file__).parents[1]))
from error_plot import draw_errors
from single_frames import single_frames, track_figures

MODELS = {10: "sigal_2011_10", 15: "loose_limbed_15"}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Find or track a person with a loose-limbed body.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--plot", type=Path, help="file for a picture of the errors, .png")
    parser.add_argument("--parts", type=int, choices=MODELS, default=15, help="parts of the body (%(default)s)")
    parser.add_argument("--mode", choices=["pose", "track"], default="pose", help="single frames, or the whole recording (%(default)s)")
    parser.add_argument("--model", help="a loose-limbed definition of your own, instead of --parts")
    parser.add_argument("--frames", type=bb.whole_number(1), help="number of frames; all by default")
    parser.add_argument("--every", type=bb.whole_number(1), default=12, help="with `pose`: search every so many frames (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="ten frames: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    session, name = bb.unposed(bb.load_session(arguments.session)), arguments.model or MODELS[arguments.parts]
    count = min(arguments.frames or session.frames, session.frames)
    if arguments.mode == "pose":
        frames = range(0, count, arguments.every)[: 10 if arguments.quick else None]
        poses = single_frames(bb.PersonSearch(session, name, arguments.seed), frames, bb.watched("frames"))
        figures, errors = poses.figures(), poses.error_m
    else:
        model, key = bb.load_model(name, session), jax.random.key(arguments.seed)
        frames, recovery = range(min(10, count) if arguments.quick else count), bb.PersonRecovery(session, model)
        draws = bb.track(key, session, model, model.kernel("particle_bp"), particles=500, frames=len(frames), recovery=recovery)
        figures, errors = track_figures(session, draws)
    figures = {"mode": arguments.mode, "model": name, "cameras": len(session.views), **figures}
    arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    for key, value in figures.items():
        if key != "errors_mm":
            print(f"{key:<20}{value}")
    if arguments.plot:
        draw_errors(arguments.plot, frames, errors)


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
