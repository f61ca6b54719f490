"""Black out some frames of a recording, and see whether the track finds the person again.

    python inference/papers/sigal_2011/recover.py --session SESSION --out RUN --model silhouettes --kernel tempered

Writes a copy of the session in which a stretch of frames is black in every camera, tracks it with and without recovery, and prints the error of the
frames before, in and after the stretch if the session has true markers.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import cv2
import jax
import numpy as np

import bayes_body as bb
from bayes_body.base.errors import InputError

sys.path.append(str(Path(__file__).parents[1]))
from error_plot import draw_errors
from single_frames import track_figures


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track a recording with some black frames, with and without recovery.")
    parser.add_argument("--session", type=Path, required=True, help="folder with a session.toml; its cameras have videos or numbered images")
    parser.add_argument("--out", type=Path, required=True, help="folder for the darkened copy and the figures")
    parser.add_argument("--model", default="loose_limbed_15", help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--kernel", choices=sorted(bb.kernels.__all__), default="particle_bp", help="the sampler (%(default)s)")
    parser.add_argument("--black", type=int, nargs=2, default=(20, 30), metavar=("FROM", "TO"), help="black frames, the last not included (20 30)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=500, help="particles (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(1), help="number of frames; all by default")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    return parser.parse_args()


def darkened(session, folder: Path, black: range):
    """Return a copy of the session with black frames, as numbered images."""
    views = []
    for view in bb.watched("copy")(range(len(session.views))):
        name = session.views[view].camera.name
        (folder / name).mkdir(parents=True, exist_ok=True)
        for frame in range(session.frames):
            picture = bb.read_colour(session, frame, session.views[view])
            if picture is not None:
                cv2.imwrite(str(folder / name / f"{frame:06d}.png"), np.zeros_like(picture) if frame in black else picture)
        background = session.views[view].background
        background = None if background is None else str((session.folder / background).resolve())
        views.append(dataclasses.replace(session.views[view], video=None, images=f"{name}/%06d.png", masks=None, background=background, offset=0))
    truth = None if session.truth is None else str((session.folder / session.truth).resolve())
    copy = dataclasses.replace(session, folder=folder, first_frame=0, views=tuple(views), truth=truth)
    bb.save_session(copy)
    return copy


def main() -> None:
    arguments = parse()
    bb.configure()
    black = range(*arguments.black)
    session = darkened(bb.load_session(arguments.session), arguments.out / "session", black)
    model = bb.load_model(arguments.model, session)
    options = {"particles": arguments.particles, "frames": arguments.frames}
    kernel, figures = model.kernel(arguments.kernel), {}
    for name, recovery in (("without", None), ("with", bb.PersonRecovery(session, model, arguments.seed))):
        draws = bb.track(jax.random.key(arguments.seed), session, model, kernel, recovery=recovery, **options)
        of_track, error = track_figures(session, draws)
        parts = {"before": error[: black.start], "after": error[black.stop + 10 :]}
        figures[name] = {part: 1000 * float(np.mean(errors)) for part, errors in parts.items()} | {"restarted": draws.frames_restarted}
        print(f"{name} recovery: {figures[name]}")
        figures[name]["errors_mm"] = of_track["errors_mm"]
        draw_errors(arguments.out / f"{name}.png", range(len(error)), error)
    (arguments.out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
