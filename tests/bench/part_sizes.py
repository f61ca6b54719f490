"""Error and coverage of loose-limbed people with sizes from a table, unknown, and right: `python tests/bench/part_sizes.py SESSION...`.

A session is a simulated person of another's proportions, with clothes, such as

    bayes-body simulate 38/38_01.amc --subject 138 --seed 6 --frames 40 --out test_38

"table" has the body file's proportions at the person's height, "unknown" the same with unknown lengths and widths of the parts, and "fitted" lengths
that are fitted to the true markers of the first frame, and widths that are fitted to its silhouettes: as near to the truth as the body comes.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import jax  # noqa: E402
import numpy as np  # noqa: E402

from bayes_body.initial import apply_first_pose, first_pose  # noqa: E402
from bayes_body.model.build import build_model  # noqa: E402
from bayes_body.model.definition import load_definition, parse_definition  # noqa: E402
from bayes_body.recording.evidence.markers import MARKERS  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402
from bayes_body.results.metrics import accuracy_figures, draws_against_truth  # noqa: E402
from bayes_body.results.metrics.truth import true_markers  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402

VARIANTS = {"table": (), "unknown": ("lengths", "widths"), "unknown lengths": ("lengths",), "unknown widths": ("widths",), "fitted": ()}


def definition_of(name, unknowns):
    """The definition with unknown sizes."""
    definition = load_definition(name)
    tables = "".join(f'[[unknown]]\nkind = "{kind}"\n\n' for kind in unknowns)
    return parse_definition(name, definition.text.replace("[kernel]", f"{tables}[kernel]"), definition.body_text)


def session_of(session, variant):
    """The session with what is known of the body."""
    if variant != "fitted":
        return replace(session, fit_lengths=False, fit_outline=False)
    first = dict(zip(MARKERS, map(tuple, np.asarray(true_markers(session)[0], float).tolist()), strict=True))
    known = {name: place for name, place in first.items() if np.isfinite(place).all()}
    return replace(session, initial_markers=known, initial_keypoints={}, fit_lengths=True, fit_outline=True)


def figures(name, path, variant, args):
    """Error, coverage, evidence and effective draws of one run."""
    session = session_of(load_session(Path(path)), variant)
    model = build_model(definition_of(name, VARIANTS[variant]), session)
    model = apply_first_pose(model, session, first_pose(model, session, "fitted"))
    clock = []
    draws = track(
        jax.random.key(args.seed),
        session,
        model,
        model.kernel(samples=args.samples, particles=args.particles),
        frames=min(args.frames, session.frames),
        on_frame=lambda _: clock.append(time.process_time()),
    )
    found = draws_against_truth(session, draws)
    row = accuracy_figures(found, mode_seeker=False)
    worst = found.plain.coverage_by_marker[-1]
    last = draws.frames[-1]
    sizes = {
        term.name: {
            part: [float(mean), float(sd)]
            for part, mean, sd in zip(
                term.space.labels,
                np.mean(np.asarray(last.states[term.name], float), axis=(0, 1)),
                np.std(np.asarray(last.states[term.name], float), axis=(0, 1)),
                strict=True,
            )
        }
        for term in model.unknowns
    }
    return {
        "session": Path(path).name,
        "variant": variant,
        "seed": args.seed,
        "error_mm": row["error_mm_mean"],
        "fitted_offset_mm": row.get("error_mm_mean_fitted_offset"),
        "coverage_90": row["coverage_90"],
        "worst_marker": [found.plain.names[int(worst.argmin())], float(worst.min())],
        "log_evidence": float(sum(np.mean(frame.info.log_evidence) for frame in draws.frames)),
        "joint_ess_min": float(min(np.min(frame.info.messages["joint_ess"]) for frame in draws.frames)),
        "belief_ess_min": float(min(np.min(frame.info.messages["belief_ess"]) for frame in draws.frames)),
        "lost": int(sum(np.sum(frame.lost) for frame in draws.frames)),
        "cpu_s": float(np.median(np.diff(clock))),
        "sizes": sizes,
    }


def main() -> None:
    """Print a line of JSON for each session and variant."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sessions", nargs="+")
    parser.add_argument("--model", default="loose_limbed_15")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--samples", type=int, default=500)
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["table", "unknown", "fitted"])
    args = parser.parse_args()
    for path in args.sessions:
        for variant in args.variants:
            print(json.dumps(figures(args.model, path, variant, args)), flush=True)


if __name__ == "__main__":
    sys.exit(main())
