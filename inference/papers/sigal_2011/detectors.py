"""What detectors bring to message passing: the same recordings tracked with and without them (Sigal, Isard, Haussecker & Black 2011, 4.2 and 5).

    python inference/papers/sigal_2011/detectors.py --session WALK --views 7 4 3 --seeds 0 1 --json detectors.json

Each recording is tracked with its first 7, 4 and 3 cameras, by a loose-limbed model whose definition names no detectors, and then some. The body and
the first pose are fitted once, with all cameras. With `--black` no camera sees some of the frames, and nobody looks for a lost person, so that only
the detectors can bring the body back.

Two tracks of few particles differ by chance more than by their detectors. With `--again`, these frames are therefore sampled again and again, all
from the particles that one track without detectors had in the frame before. The estimate of a frame's evidence is unbiased. So a better proposal has
a larger mean of the log-evidence, and a smaller standard deviation.

A belief has converged at the first iteration after which no further one moves its mean farther than SETTLED times what its particles alone explain.
Counts and shares are means over all parts.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any, get_args

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

SETTLED = 2.0
# Added to the seed for frames that are sampled again.
AGAIN = 1000
COLUMNS = ("cameras", "frame", "seed", "detectors", "error_mm", "coverage", "iterations", "belief_ess", "share", "log_evidence", "lost", "cpu_s")
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
    parser.add_argument("--again", type=bb.whole_number(1), nargs="+", help="frames that are sampled again for each seed, from the same particles")
    parser.add_argument("--particles", type=bb.whole_number(1), default=300, help="joint draws, and particles of each part (%(default)s)")
    parser.add_argument("--iterations", type=bb.whole_number(3), default=6, help="iterations of messages (%(default)s)")
    return parser.parse_args()


def with_cameras(session, count: int | None):
    """Return the recording with its first cameras; what is known of the first pose in the others is left out."""
    names = [view.camera.name for view in session.views[:count]]
    known = {name: points for name, points in (session.initial_keypoints or {}).items() if name in names}
    return dataclasses.replace(session, views=session.views[:count], initial_keypoints=known or None)


def known(figure: float) -> float | None:
    """Return a figure; None if it is not known, for which JSON has no number."""
    return float(figure) if np.isfinite(figure) else None


def figures_of(session, draws, cpu: list[float], first: int = 0) -> dict[str, Any]:
    """Return the figures of one track, of the frames from `first` on."""
    of_track, error = track_figures(session, draws)
    against, frames = draws_against_truth(session, draws), list(draws.frames)[first:]
    told = [{name: np.asarray(value, float)[0] for name, value in frame.info.messages.items()} for frame in frames]
    moved = np.stack([figures["message_change"][1:] / np.sqrt(2 / figures["belief_ess"]) for figures in told])
    # Number of iterations up to the last one that moved the mean; the first one makes it.
    still_moving = np.cumsum((moved > SETTLED)[:, ::-1], axis=1) > 0
    shares = np.stack([figures["proposal_shares"][:, 2] for figures in told])
    return {
        "error_mm": known(1000 * error[first:].mean()),
        "coverage": None if against is None or first else known(against.plain.coverage[-1]),
        "iterations": 1 + float(still_moving.sum(axis=1).mean()),
        "belief_ess": float(np.mean([figures["belief_ess"] for figures in told])),
        "share": float(shares.mean()),
        "log_evidence": float(np.mean([np.asarray(frame.info.log_evidence)[0] for frame in frames])),
        "lost": sum(frame.lost for frame in frames),
        "cpu_s": (cpu[-1] - cpu[0]) / (len(cpu) - 1) if len(cpu) > 1 else None,
        "shares": {name: round(float(share), 4) for name, share in zip(draws.model.body.placement.names, shares.mean(axis=0), strict=True)},
        "errors_mm": of_track["errors_mm"][first:],
    }


def compared(arguments: argparse.Namespace, session, estimate, count: int | None):
    """Yield the figures of a recording with some of its cameras, for each seed and choice of detectors."""
    name, session = session.folder.name, with_cameras(session, count)
    model = apply_first_pose(build_model(arguments.model, session), session, estimate)
    kernel = model.kernel("particle_bp", samples=arguments.particles, iterations=arguments.iterations)

    def track(seed: int, choice: str, frames: int, frames_before: list | None = None):
        names = TOGETHER[choice] if choice in TOGETHER else tuple(choice.split("+"))
        tracked, cpu = dataclasses.replace(model, definition=dataclasses.replace(model.definition, detectors=names)), list[float]()
        key, now = jax.random.key(seed), lambda _: cpu.append(time.process_time())
        return bb.track(key, session, tracked, kernel, arguments.particles, frames=frames, into=frames_before, on_frame=now), cpu

    case = {"recording": name, "cameras": len(session.views)}
    if not arguments.again:
        for seed in arguments.seeds:
            for choice in arguments.detectors:
                draws, cpu = track(seed, choice, min(arguments.frames, session.frames))
                yield case | {"frame": "all", "seed": seed, "detectors": choice} | figures_of(session, draws, cpu)
        return
    before = list(track(arguments.seeds[0], "none", max(arguments.again))[0].frames)
    for frame in arguments.again:
        for seed in arguments.seeds:
            for choice in arguments.detectors:
                # Another key than that of the track, whose frame would be the same without detectors.
                draws, cpu = track(AGAIN + seed, choice, frame + 1, before[:frame])
                yield case | {"frame": frame, "seed": seed, "detectors": choice} | figures_of(session, draws, cpu, frame)


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
