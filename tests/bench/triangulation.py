"""Keypoints by triangulation and by this package, against the truth: `python tests/bench/triangulation.py`.

Triangulation is Pose2Sim's, restated in tests/weighted_dlt.py. Both get the same keypoints of simulated walks, from the detector of `bayes-body
simulate` (Gaussian, 3 pixels, a smaller confidence where the error is larger), which is not the noise that the model `keypoints` assumes. Keypoints
are projections of the true markers, so a network that places a joint beside the marker is no part of this. Only the first pose differs: this package
gets that of `bayes-body simulate`, a further set of keypoints in the first frame.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import jax  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
from keypoint_errors import METHODS, NETWORKS, errors_of  # noqa: E402
from keypoint_walks import person_of, shipped_walk, walk_session  # noqa: E402

BODIES = {True: "the person has the model's body", False: "the model's body is fitted to the person"}


def compared(known, options):
    """By network and method: the errors of all people, metres, and CPU seconds a frame of each."""
    errors = {name: {method: [] for method in METHODS} for name in NETWORKS}
    seconds = {name: {method: [] for method in METHODS} for name in NETWORKS}
    for seed in options.seeds:
        person = person_of(shipped_walk(options.frames, seed), known)
        for name, network in NETWORKS.items():
            with tempfile.TemporaryDirectory() as folder:
                session, seen = walk_session(Path(folder), person, network._replace(seed=seed))
                model = bb.load_model("keypoints", session, show=lambda _: None)
                # What is compiled here is not measured.
                errors_of(session, model, seen, person.markers, jax.random.key(seed), frames=3)
                for method, (off, used) in errors_of(session, model, seen, person.markers, jax.random.key(seed)).items():
                    errors[name][method].append(off)
                    seconds[name][method].append(used)
    return errors, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the person, the keypoints and the draws")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    figures = {}
    for known, title in BODIES.items():
        errors, seconds = compared(known, options)
        print(f"\n{title}\n\n| | {' | '.join(NETWORKS)} | CPU, ms a frame |\n|---|" + "---|" * (len(NETWORKS) + 1))
        for method in METHODS:
            off = [np.concatenate(errors[name][method]) for name in NETWORKS]
            cells = [f"{1e3 * np.nanmedian(each):.1f}, {1e3 * np.nanpercentile(each, 95):.1f}, {np.isnan(each).sum()}" for each in off]
            used = 1e3 * np.median([seconds[name][method] for name in NETWORKS])
            print(f"| {method} | {' | '.join(cells)} | {used:.1f} |", flush=True)
            figures[f"{title}; {method}"] = {"median, 95 %, missing": cells, "ms": used}
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
