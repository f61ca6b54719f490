"""Track a walk by image motion, and compare it with the motion prior alone and with edges (Sidenbladh, Black & Fleet 2000, 7).

    python inference/image_motion.py --path circle --moving --out RUN --json figures.json

Films a walk with one camera and tracks it three times with the particle filter. Image motion says how the body moves, not where it is, so that errors
add up; silhouettes and edges say where it is. Copy this file and change it.
"""

import argparse
import json
import sys
from pathlib import Path

import bayes_body as bb
from bayes_body.errors import InputError

PARTICLES = {"straight": 5000, "circle": 15_000}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track a walk by image motion.")
    parser.add_argument("--path", choices=PARTICLES, default="straight", help="the way that the person walks (%(default)s)")
    parser.add_argument("--moving", action="store_true", help="with a camera that is carried around the person")
    parser.add_argument("--out", type=Path, required=True, help="folder for the recording and the overlays")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--motion", type=Path, help="a captured walk; by default the walking cycle that ships")
    parser.add_argument("--model", default="sidenbladh_2000_walking", help="a definition with image motion (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(2), default=50, help="number of frames (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), help="particles; by default 5000 on a straight way, 15000 on a circle")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="seed of the person, the room and the filters (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="12 frames, 500 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    frames = 12 if arguments.quick else arguments.frames
    particles = 500 if arguments.quick else arguments.particles or PARTICLES[arguments.path]
    where = arguments.out / "recording", arguments.path, arguments.moving
    session = bb.compare.film_walk(*where, frames, arguments.seed, arguments.motion, bb.watched("filming"))
    found = bb.compare.compare_walk(session, particles, arguments.seed, arguments.model, turns=arguments.path == "circle")
    figures = {"path": arguments.path, "moving": arguments.moving, **bb.compare.motion_figures(session, found)}
    arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    for key, value in figures.items():
        print(f"{key:<36}{value:.1f}" if isinstance(value, float) else f"{key:<36}{value}")
    for name, draws in found._asdict().items():
        bb.draw_overlay(session, draws, arguments.out / name)


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
