"""What detectors bring to message passing: the same recordings tracked with and without them (Sigal, Isard, Haussecker & Black 2011, 4.2 and 5).

    python inference/papers/sigal_2011/detectors.py --session WALK --views 7 4 3 --seeds 0 1 --json detectors.json

Each recording is tracked with its first 7, 4 and 3 cameras, by a loose-limbed model whose definition names no detectors, and then some. The body and
the first pose are fitted once, with all cameras. With `--black` no camera sees some of the frames, and nobody looks for a lost person, so that only
the detectors can bring the body back. A belief has converged at the first iteration after which no further one moves its mean by more than SETTLED
standard deviations. Counts and shares are means over all frames and parts.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import get_args

import jax
import numpy as np

import bayes_body as bb
from bayes_body.base.errors import InputError
from bayes_body.initial import apply_first_pose, first_pose
from bayes_body.model.build import build_model
from bayes_body.model.definition import DetectorName
from bayes_body.results.metrics.truth import draws_against_truth

sys.path.append(str(Path(__file__).parents[1]))
from recover import darkened
from single_frames import track_figures

SETTLED = 0.5
COLUMNS = ("cameras", "seed", "detectors", "error_mm", "last_mm", "coverage", "iterations", "belief_ess", "share", "log_evidence", "lost", "cpu_s")
TOGETHER = {"none": (), "all": get_args(DetectorName.__value__)}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track recordings with and without detectors, and compare.")
    parser.add_argument("--session", type=Path, nargs="+", required=True, help="folders with a session.toml")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--views", type=bb.whole_number(1), nargs="+", help="numbers of cameras, the first ones; all by default")
    parser.add_argument("--seeds", type=bb.whole_number(0), nargs="+", default=[0, 1], help="random seeds (0 1)")
    parser.add_argument("--detectors", nargs="+", default=["none", "all"], help="none, all, or names joined by + (none all)")
    parser.add_argument("--model", default="loose_limbed_15", help="a definition of a loose-limbed body (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(1), default=20, help="number of frames (%(default)s)")
    parser.add_argument("--black", type=int, nargs=2, metavar=("FROM", "TO"), help="black frames, the last not included")
    parser.add_argument("--particles", type=bb.whole_number(1), default=300, help="joint draws, and particles of each part (%(default)s)")
    parser.add_argument("--iterations", type=bb.whole_number(3), default=6, help="iterations of messages (%(default)s)")
    return parser.parse_args()


def with_cameras(session, count: int | None):
    """Return the recording with its first cameras; what is known of the first pose in the others is left out."""
    names = [view.camera.name for view in session.views[:count]]
    known = {name: points for name, points in (session.initial_keypoints or {}).items() if name in names}
    return dataclasses.replace(session, views=session.views[:count], initial_keypoints=known or None)


def figures_of(session, draws, cpu: list[float]) -> dict[str, float]:
    """Return the figures of one track."""
    of_track, error = track_figures(session, draws)
    against = draws_against_truth(session, draws)
    told = [{name: np.asarray(value, float)[0] for name, value in frame.info.messages.items()} for frame in draws.frames]
    moved = np.stack([figures["message_change"][1:] for figures in told])
    # Number of iterations up to the last one that moved the mean; the first one makes it.
    still_moving = np.cumsum((moved > SETTLED)[:, ::-1], axis=1) > 0
    shares = np.stack([figures["proposal_shares"][:, 2] for figures in told])
    return {
        "error_mm": of_track["mean_mm"],
        "last_mm": float(1000 * error[-3:].mean()),
        "coverage": float("nan") if against is None else float(against.plain.coverage[-1]),
        "iterations": 1 + float(still_moving.sum(axis=1).mean()),
        "belief_ess": float(np.mean([figures["belief_ess"] for figures in told])),
        "share": float(shares.mean()),
        "log_evidence": float(np.mean([np.asarray(frame.info.log_evidence)[0] for frame in draws.frames])),
        "lost": of_track["frames_lost"],
        "cpu_s": (cpu[-1] - cpu[0]) / max(len(cpu) - 1, 1),
        "shares": {name: round(float(share), 4) for name, share in zip(draws.model.body.placement.names, shares.mean(axis=0), strict=True)},
        "errors_mm": of_track["errors_mm"],
    }


def compared(arguments: argparse.Namespace, session, estimate, count: int | None):
    """Yield the figures of a recording with some of its cameras, for each seed and choice of detectors."""
    name, session = session.folder.name, with_cameras(session, count)
    model = apply_first_pose(build_model(arguments.model, session), session, estimate)
    kernel = model.kernel("particle_bp", samples=arguments.particles, iterations=arguments.iterations)
    for seed in arguments.seeds:
        for choice in arguments.detectors:
            names = TOGETHER[choice] if choice in TOGETHER else tuple(choice.split("+"))
            tracked = dataclasses.replace(model, definition=dataclasses.replace(model.definition, detectors=names))
            cpu, options = list[float](), {"particles": arguments.particles, "frames": min(arguments.frames, session.frames)}
            key, now = jax.random.key(seed), lambda _, cpu=cpu: cpu.append(time.process_time())
            draws = bb.track(key, session, tracked, kernel, on_frame=now, **options)
            case = {"recording": name, "cameras": len(session.views), "seed": seed, "detectors": choice}
            yield case | figures_of(session, draws, cpu)


def main() -> None:
    arguments = parse()
    bb.configure()
    rows = []
    print(f"{'recording':<12}" + "".join(f"{name:>13}" for name in COLUMNS))
    for folder in arguments.session:
        session = bb.load_session(folder)
        estimate = first_pose(build_model(arguments.model, session), session)
        if arguments.black:
            session = darkened(session, arguments.json.with_suffix("") / folder.name, range(*arguments.black))
        for count in arguments.views or [None]:
            for row in compared(arguments, session, estimate, count):
                shown = (f"{row[name]:.4g}" if isinstance(row[name], float) else str(row[name]) for name in COLUMNS)
                print(f"{row['recording']:<12}" + "".join(f"{text:>13}" for text in shown), flush=True)
                rows.append(row)
                arguments.json.write_text(json.dumps({"model": arguments.model, "rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
