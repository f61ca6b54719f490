"""What the unknowns of `keypoints` are worth: `BAYES_BODY_DATA=... python tests/bench/unknowns.py --json FILE`.

Twenty simulated recordings of captured people. Lengths, cameras, clocks and the places of keypoints are drawn from other tables than those of the
prior (tests/unknown_recordings.py). Of each recording there are these runs ("arms"):

- fixed: all is taken as the session says, without unknowns;
- free: the model as it ships;
- delays: the same with unknown delays, where there are delays;
- truth: true lengths, cameras and offsets are known, and the cameras are synchronous. It is the floor;
- one more for each `--set`: as free, with other options of its unknowns.

Errors are also given after the best rigid motion and scale of a whole recording: rig and person may move together, and no image shows it.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import jax  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
from keypoint_walks import Network, captured_walk  # noqa: E402
from unknown_figures import figures, with_known_offsets  # noqa: E402
from unknown_recordings import MARGIN, Spread, movement_of, record  # noqa: E402

from bayes_body.base.progress import watched  # noqa: E402
from bayes_body.runs.unknowns.definition import with_unknowns  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402

TRAIN = ("02_01", "02_02", "05_01", "07_01", "07_03", "08_01", "08_03", "16_15", "16_16", "16_47")
TEST = ("06_01", "35_02", "35_07", "38_01", "38_02", "39_01", "39_02", "39_03", "39_07", "39_12")
# The split that everything learned here keeps to.
TRAIN_SUBJECTS = ("02", "05", "07", "08", "16")
ARMS = ("fixed", "free", "delays", "truth")
DELAY_S = (0.008, 0.025)
FADES_S = 0.5
# What is asked of the arm `free`.
ASKED = {
    "unknowns in their 90 % intervals": (0.80, 0.98),
    "markers in their 90 % intervals, mean": (0.85, 0.95),
    "the same, least recording": (0.75, 1.0),
    "the same, worst marker": (0.70, 1.0),
    "aligned error over that of truth": (0.0, 1.25),
}


def changed(definition, settings):
    """The definition with options of its unknowns changed, given as `unknown.option=number`."""
    for setting in settings:
        path, value = setting.split("=")
        kind, option = path.split(".")
        if kind not in [term.kind for term in definition.unknowns]:
            sys.exit(f"--set {setting}: the model has no unknown '{kind}'; it has {', '.join(term.kind for term in definition.unknowns)}")
        update = {option: float(value)}
        terms = [replace(term, options=term.options.model_copy(update=update)) if term.kind == kind else term for term in definition.unknowns]
        definition = replace(definition, unknowns=tuple(terms))
    return definition


def track_arm(arm, recording, synchronous, options, seed):
    """Figures of one arm, and CPU seconds a frame, compilation included."""
    session = synchronous.known if arm == "truth" else recording.session
    definition = changed(bb.load_definition(options.model), [] if arm in ARMS else arm.split())
    if arm in ("fixed", "truth"):
        definition = replace(definition, unknowns=())
    if arm == "delays":
        definition = with_unknowns(definition, delays=True)
    model = bb.load_model(definition, session, show=lambda _: None)
    if arm == "truth":
        model = with_known_offsets(model, synchronous.truth.offsets_m)
    begun = time.process_time()
    draws = track(jax.random.key(seed), session, model, runs=options.runs)
    seconds = (time.process_time() - begun) / session.frames
    return {**figures(recording, session, draws), "cpu_s": seconds}


def recorded(name, seed, folder, options):
    """The recording, and the same without delays; both with the same noise."""
    path = Path(os.environ["BAYES_BODY_DATA"]) / "cmu_mocap" / name[:2] / f"{name}.amc"
    first = round(options.first_s * options.fps) - MARGIN
    movement = movement_of(captured_walk(path, options.frames + 2 * MARGIN, first, options.fps), options.fps)
    network = Network(0.05, 0.1, "assumed", seed, options.lasting, FADES_S * options.fps)
    spread = Spread(delay_s=DELAY_S if options.delays else (0.0, 0.0), whole_frames=options.whole_frames)
    recording = record(folder / "stated", movement, network, spread, seed)
    return recording, record(folder / "synchronous", movement, network, spread._replace(delay_s=(0.0, 0.0)), seed)


def rows_of(options):
    """Yield a row for each recording and arm."""
    names = {"train": TRAIN, "test": TEST, "all": TRAIN + TEST}[options.subjects]
    names = options.recordings or names
    for place in watched("recordings")(range(len(names))):
        name = names[place]
        seed = (TRAIN + TEST).index(name) if name in TRAIN + TEST else place
        with tempfile.TemporaryDirectory() as folder:
            recording, synchronous = recorded(name, seed, Path(folder), options)
            for arm in arms_of(options):
                row = track_arm(arm, recording, synchronous, options, seed)
                yield {"recording": name, "split": "train" if name[:2] in TRAIN_SUBJECTS else "test", "arm": arm, **row}


def arms_of(options):
    """The arms in order: those that were chosen, then one for each `--set`."""
    return [*(arm for arm in options.arms if arm != "delays" or options.delays), *(" ".join(settings) for settings in options.set)]


# -- tables -----------------------------------------------------------------------------------------------------------------------------


def line_of(row) -> str:
    """One recording and arm."""
    worst = min(row["by_marker"], key=row["by_marker"].get)
    kinds = ", ".join(f"{kind} {np.mean(entries['inside']):.2f}" for kind, entries in row["unknowns"].items())
    errors = f"{row['rms_mm']:6.1f} {row['aligned_rms_mm']:6.1f} {row['coverage_90']:6.3f} {row['by_marker'][worst]:5.2f} {worst:10}"
    return f"{row['recording']:6} {row['arm'][:30]:6} {errors} {row['rhat_unknowns']:5.2f} {1e3 * row['cpu_s']:5.0f} {kinds}"


def summary_of(rows, arm):
    """The means over the recordings of one arm, by title."""
    chosen = [row for row in rows if row["arm"] == arm]

    def mean(key):
        return float(np.mean([row[key] for row in chosen]))

    def angle(name, key):
        return float(np.mean([row["angles"][name][key] for row in chosen if name in row["angles"]]))

    by_marker = {name: np.mean([row["by_marker"][name] for row in chosen]) for name in chosen[0]["by_marker"]}
    summary = {key: mean(key) for key in ("mean_mm", "rms_mm", "aligned_mean_mm", "aligned_rms_mm", "coverage_90", "coverage_50", "crps_mm")}
    summary |= {
        "least_recording": min(row["coverage_90"] for row in chosen),
        "worst_marker": float(min(by_marker.values())),
        "worst_marker_name": min(by_marker, key=by_marker.get),
        "worst_marker_of_a_recording": min(min(row["by_marker"].values()) for row in chosen),
    }
    for kind in chosen[0]["unknowns"]:
        entries = [row["unknowns"][kind] for row in chosen]
        score = np.concatenate([np.divide(entry["error"], entry["sd"]) for entry in entries])
        inside = float(np.mean(np.concatenate([entry["inside"] for entry in entries])))
        summary[kind] = {"inside": inside, "rms_z": float(np.sqrt(np.mean(score**2)))}
    for name in chosen[0]["angles"]:
        summary[name] = {key: angle(name, key) for key in ("rms_deg", "coverage_90")}
    for key in ("rhat_pose", "rhat_pose_max", "rhat_unknowns"):
        summary[key] = float(np.max([row[key] for row in chosen]))
    return {**summary, "log_evidence": mean("log_evidence"), "cpu_s": float(np.median([row["cpu_s"] for row in chosen])), "recordings": len(chosen)}


def table_of(rows) -> str:
    """A Markdown table with a column for each arm."""
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    by_arm = {arm: summary_of(rows, arm) for arm in arms}

    def line(title, cell):
        return f"| {title} | " + " | ".join(cell(by_arm[arm]) for arm in arms) + " |"

    lines = [f"| {by_arm[arms[0]]['recordings']} recordings | " + " | ".join(arms) + " |", "|---|" + "---|" * len(arms)]
    lines += [
        line("markers, mm: mean, rms", lambda s: f"{s['mean_mm']:.0f}, {s['rms_mm']:.0f}"),
        line("after one similarity", lambda s: f"{s['aligned_mean_mm']:.1f}, {s['aligned_rms_mm']:.1f}"),
        line("in 90 % intervals; in 50 %", lambda s: f"{s['coverage_90']:.3f}; {s['coverage_50']:.2f}"),
        line("least recording", lambda s: f"{s['least_recording']:.2f}"),
        line("worst marker", lambda s: f"{s['worst_marker']:.2f} ({s['worst_marker_name']})"),
        line("CRPS, mm", lambda s: f"{s['crps_mm']:.2f}"),
        line("log-evidence", lambda s: f"{s['log_evidence']:.0f}"),
    ]
    for kind in dict.fromkeys(kind for row in rows for kind in row["unknowns"]):
        cells = lambda s, kind=kind: f"{s[kind]['inside']:.2f}; {s[kind]['rms_z']:.2f}" if kind in s else ""  # noqa: E731
        lines.append(line(f"{kind} in 90 % intervals; rms z", cells))
    for name in dict.fromkeys(name for row in rows for name in row["angles"]):
        cells = lambda s, name=name: f"{s[name]['rms_deg']:.1f}; {s[name]['coverage_90']:.2f}"  # noqa: E731
        lines.append(line(f"{name.replace('_', ' ')}, degrees rms; in 90 % intervals", cells))
    lines.append(line("R-hat: pose, unknowns", lambda s: f"{s['rhat_pose_max']:.2f}, {s['rhat_unknowns']:.2f}"))
    lines.append(line("CPU, ms a frame", lambda s: f"{1e3 * s['cpu_s']:.0f}"))
    return "\n".join(lines)


def asked_of(rows) -> str:
    """What was asked of the arm `free`, and what it did."""
    free, truth = summary_of(rows, "free"), summary_of(rows, "truth")
    kinds = next(row for row in rows if row["arm"] == "free")["unknowns"]
    figures_of = {
        "unknowns in their 90 % intervals": [free[kind]["inside"] for kind in kinds],
        "markers in their 90 % intervals, mean": [free["coverage_90"]],
        "the same, least recording": [free["least_recording"]],
        "the same, worst marker": [free["worst_marker"]],
        "aligned error over that of truth": [free["aligned_rms_mm"] / truth["aligned_rms_mm"]],
    }
    lines = []
    for title, (low, high) in ASKED.items():
        values = figures_of[title]
        verdict = "yes" if all(low <= value <= high for value in values) else "NO"
        lines.append(f"{verdict:3} {title}: {', '.join(f'{value:.3f}' for value in values)} (asked {low:g} to {high:g})")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="keypoints", help="a definition that reads keypoints; its unknowns are those of the arm `free`")
    parser.add_argument("--subjects", choices=("train", "test", "all"), default="all")
    parser.add_argument("--recordings", nargs="+", metavar="NAME", help="such as 35_02, in place of the twenty")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--fps", type=float, default=60.0)
    parser.add_argument("--first-s", type=float, default=0.3, help="seconds of each motion that are left out")
    parser.add_argument("--runs", type=int, default=2, help="independent runs of each arm, for R-hat")
    parser.add_argument("--delays", action="store_true", help=f"cameras are {1e3 * DELAY_S[0]:g} to {1e3 * DELAY_S[1]:g} ms early or late")
    parser.add_argument("--whole-frames", action="store_true", help="with --delays: less than half a frame of them is left")
    parser.add_argument(
        "--lasting", type=float, default=0.0, help=f"share of the noise's squared scale that is an error which fades in {FADES_S:g} s; default 0"
    )
    parser.add_argument("--set", nargs="+", action="append", default=[], metavar="UNKNOWN.OPTION=NUMBER", help="such as keypoint_offsets.lasts_s=10")
    parser.add_argument("--json", type=Path, help="write the rows there, after each recording")
    options = parser.parse_args()
    if not os.environ.get("BAYES_BODY_DATA"):
        sys.exit("BAYES_BODY_DATA is not set; expected the folder that holds cmu_mocap; set it and run again.")
    print("record arm     rms, aligned mm  in 90 %, worst marker    R-hat CPU ms  unknowns in their 90 % intervals")
    rows = []
    for row in rows_of(options):
        rows.append(row)
        print(line_of(row), flush=True)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    for split in ("train", "test"):
        chosen = [row for row in rows if row["split"] == split]
        if chosen and len(chosen) < len(rows):
            print(f"\n{split}\n\n{table_of(chosen)}")
    print(f"\n{table_of(rows)}")
    if {"free", "truth"} <= set(options.arms):
        print(f"\n{asked_of(rows)}")


if __name__ == "__main__":
    main()
