"""Error, coverage and CPU time of kernels on keypoints of captured walks: `BAYES_BODY_DATA=... python tests/bench/held_out_walks.py`.

The walks are of subjects from whom nothing that ships was learned. Keypoints are drawn with the noise that the model `keypoints` assumes, then 5 %
are moved anywhere and 10 % are taken away. The body is that of the model in the pose nearest to the captured one, so what is compared is the kernel
and the motion prior. A seed is one set of keypoints and one run of each kernel.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import jax  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
from keypoint_walks import Network, captured_walk, person_of, walk_session  # noqa: E402

from bayes_body.results.metrics import draws_against_truth  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402

WALKS = ("35/35_02", "38/38_01")
PARTICLES = {"laplace": 512, "tempered": 1000}


def figures(session, model, kind, seed, cameras=None):
    """Mean error (mm), share of the truth in the 90 % intervals, and CPU seconds a frame without compilation."""
    kernel = model.kernel(kind, particles=PARTICLES[kind])
    track(jax.random.key(seed), session, model, kernel, frames=2)
    begun = time.process_time()
    draws = track(jax.random.key(seed), session, model, kernel)
    seconds = (time.process_time() - begun) / session.frames
    accuracy = draws_against_truth(session, draws).plain
    again = [int(frame.info.modes["attempt"][0]) for frame in draws.frames if frame.info.modes]
    return {
        "error_mm": 1e3 * float(np.nanmean(accuracy.error)),
        "coverage_90": float(accuracy.coverage[-1]),
        "cpu_s": seconds,
        "log_evidence": float(sum(np.sum(frame.info.log_evidence) for frame in draws.frames)),
        "evaluations": float(np.mean([np.mean(frame.info.evaluations) for frame in draws.frames])),
        "again": np.bincount(again, minlength=3).tolist(),
    }


def print_costs(rows) -> None:
    """Of each kernel, the median over the walks: CPU time a frame, also as a share of the last kernel's, and evaluations of the likelihood."""
    kinds = list(dict.fromkeys(row["kernel"] for row in rows))
    seconds = {kind: float(np.median([row["cpu_s"] for row in rows if row["kernel"] == kind])) for kind in kinds}
    for kind in kinds:
        evaluations = np.median([row["evaluations"] for row in rows if row["kernel"] == kind])
        share = f"1/{seconds[kinds[-1]] / seconds[kind]:.0f} of {kinds[-1]}'s"
        print(f"{kind}: {1e3 * seconds[kind]:.1f} ms CPU a frame, {share}; {evaluations:.0f} evaluations, {evaluations / seconds[kind]:.0f} a second")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--walks", nargs="+", default=WALKS)
    parser.add_argument("--first", type=int, default=60, help="first frame of each walk, at 60 frames a second")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--kernels", nargs="+", default=list(PARTICLES))
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    rows = []
    print(f"{'walk':10} {'seed':>4} {'kernel':10} {'error, mm':>9} {'in 90 %':>8} {'CPU s':>8} {'log Z':>10}  frames by attempts")
    for name in options.walks:
        person = person_of(captured_walk(Path(os.environ["BAYES_BODY_DATA"]) / "cmu_mocap" / f"{name}.amc", options.frames, options.first), True)
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                session, _ = walk_session(Path(folder), person, Network(0.05, 0.1, "assumed", seed))
                model = bb.load_model("keypoints", session, show=lambda _: None)
                for kind in options.kernels:
                    found = figures(session, model, kind, seed)
                    rows.append({"walk": name, "seed": seed, "kernel": kind, **found})
                    numbers = f"{found['error_mm']:9.1f} {found['coverage_90']:8.3f} {found['cpu_s']:8.4f} {found['log_evidence']:10.1f}"
                    print(f"{name:10} {seed:4d} {kind:10} {numbers}  {found['again']}", flush=True)
    print_costs(rows)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
