"""Let the motion prior run without any image, beside the tracked result (Sidenbladh, Black & Fleet 2000, Fig. 7).

    python inference/papers/sidenbladh_2000/prior_only.py --session SESSION --out RUN

If the prior alone stayed on the person, the images would not be needed. If the tracked body followed the prior, they would have no effect.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import jax

import bayes_body as bb
from bayes_body.base.errors import InputError
from bayes_body.results.metrics.truth import draws_against_truth

sys.path.append(str(Path(__file__).parents[1]))
from error_plot import draw_errors


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Compare a motion prior without images with the tracked result.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml")
    parser.add_argument("--out", type=Path, required=True, help="folder for both overlays and the picture of the errors")
    parser.add_argument("--model", default="sidenbladh_2000_walking", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=5000, help="particles (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(1), default=1, help="independent filters (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(1), help="number of frames; all by default")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="two frames, 64 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    session, definition = bb.load_session(arguments.session), bb.load_definition(arguments.model)
    particles = 64 if arguments.quick else arguments.particles
    frames = min(2 if arguments.quick else arguments.frames or session.frames, session.frames)
    # Without likelihoods the images say nothing.
    prior = replace(definition, likelihoods=())
    for name, chosen in (("tracked", definition), ("prior_only", prior)):
        model, key, folder = bb.load_model(chosen, session), jax.random.key(arguments.seed), arguments.out / name
        folder.mkdir(parents=True, exist_ok=True)
        draws = bb.track(key, session, model, bb.kernels.sir(), particles=particles, runs=arguments.runs, frames=frames)
        bb.draw_overlay(session, draws, folder)
        against = draws_against_truth(session, draws)
        if against is None:
            print(f"{name}: the session has no truth; look at {folder / 'overlay.mp4'}")
            continue
        error = against.plain.frame_error.mean(axis=1)
        draw_errors(folder / "errors.png", range(frames), error)
        print(f"{name}: {1000 * error.mean():.0f} mm from the truth in the mean, {1000 * error[-1]:.0f} mm in frame {frames - 1}")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
