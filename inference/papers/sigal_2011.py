"""Measure what Sigal, Isard, Haussecker & Black 2011 report, for docs/papers/figures/sigal_2011.json.

    python inference/papers/sigal_2011.py --all

The experiments are functions of the programs in the folder `sigal_2011`; the claims are in its `claims.toml`.
"""

import sys
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import bayes_body as bb
from bayes_body.base.files.shipped import learned_file
from bayes_body.model.build import Model
from bayes_body.model.definition import DetectorName
from bayes_body.recording.session.session import Session
from bayes_body.tracking.draws import Draws

sys.path.append(str(Path(__file__).with_suffix("")))
from convergence import changes_of, draw_convergence
from detectors import figures_of
from error_plot import draw_errors
from real_recording import distances_mm
from recover import darkened
from reproduce import Case, Experiment, Values, reproduce
from single_frames import SingleFrames, single_frames, track_figures

RIG = "humaneva_7"
BODYTRACK = "bodytrack_4cam"
# What finds people in single frames and tracks them, by the number of parts. Both have a likelihood for each part. Messages do not see a likelihood
# of the whole body, such as that of `loose_limbed_10`: one of 500 joint draws is effective then.
MODELS = {10: "sigal_2011_10", 15: "loose_limbed_15"}
# How they track. Ten parts leave out the strata of the paper, which take ten times as long (`pampas`).
PASSING = {
    10: {"method": "mixture", "schedule": "flooding", "samples": 300, "iterations": 4, "annealing": 1.0, "shares": (0.3, 0.05, 0.2, 0.65)},
    15: {},
}
TREE, PAMPAS = "sigal_2011_tree", "sigal_2011_15"
# What proposes places of the parts, by the words of the row.
DETECTORS: dict[str, tuple[DetectorName, ...]] = {"without": (), "with detectors": ("limbs", "silhouettes")}


def poses(case: Case, parts: int, cameras: int) -> SingleFrames:
    """Find the person in single frames, without a first pose."""
    session = bb.unposed(case.film(RIG, case.sizes["frames"], cameras))
    return single_frames(bb.PersonSearch(session, MODELS[parts], case.seed), range(0, session.frames, case.sizes["every"]))


def pose(case: Case, parts: int) -> Mapping[str, Values]:
    """Single frames seen by seven cameras (Table 2, Fig. 11 and 12)."""
    found_poses = poses(case, parts, 7)
    figures = found_poses.figures()
    if case.pictures is not None:
        draw_errors(case.pictures / f"sigal_2011_pose_{parts}.png", found_poses.frames, found_poses.error_m)
    # Of the median frame: the first one compiles.
    seconds = float(np.median(np.nansum(list(found_poses.seconds.values()), axis=0)))
    rows: dict[str, Values] = {
        f"pose_{parts}": {
            "mean error": figures["mean_mm"],
            "median error": figures["median_mm"],
            "standard deviation of the error": figures["sd_mm"],
            "frames below 80 mm": percent(figures["under_80"]),
            "frames below 120 mm": percent(figures["under_120"]),
            "frames at or above 120 mm": None if figures["under_120"] is None else 100 - 100 * figures["under_120"],
        },
        f"pose_{parts}_seconds": {"pose estimation": seconds},
    }
    if parts == 10:
        rows["turned"] = {"turned round, each frame alone": percent(figures["flips_alone"]), "with its neighbours": percent(figures["flips"])}
    return rows


def percent(share: float | None) -> float | None:
    """Return a share in percent; None stays."""
    return None if share is None else 100 * share


def views(case: Case) -> Mapping[str, Values]:
    """Single frames seen by fewer cameras, ten parts."""
    by_cameras = {cameras: poses(case, 10, cameras).figures() for cameras in (4, 3)}
    medians = {f"median error, {cameras} cameras": figures["median_mm"] for cameras, figures in by_cameras.items()}
    return {"views": medians | {"turned round, 3 cameras": percent(by_cameras[3]["flips"])}}


def tracked(session: Session, model: Model, parts: int, case: Case) -> Draws:
    """Track a person by message passing, from wherever they are first detected."""
    recovery, options = bb.PersonRecovery(session, model, case.seed), {"particles": case.sizes["particles"]}
    return bb.track(jax.random.key(case.seed), session, model, model.kernel("particle_bp", **PASSING[parts]), recovery=recovery, **options)


def track(case: Case, parts: int) -> Mapping[str, Values]:
    """A track by message passing, without a first pose (Table 3, Fig. 13 and 14)."""
    session = bb.unposed(case.film(RIG, case.sizes["frames"]))
    figures, error = track_figures(session, tracked(session, bb.load_model(MODELS[parts], session, lambda line: None), parts, case))
    if case.pictures is not None:
        draw_errors(case.pictures / f"sigal_2011_track_{parts}.png", range(len(error)), error)
    return {
        f"track_{parts}": {"mean error": figures["mean_mm"], "standard deviation of the error": figures["sd_mm"]},
        f"track_{parts}_seconds": {"tracking": figures["seconds_per_frame"]},
    }


def tree(case: Case) -> Mapping[str, Values]:
    """The annealed particle filter on the equal tree of angles (Fig. 15), from a first pose that is placed by hand."""
    session = case.film(RIG, case.sizes["frames"])
    model = bb.load_model(TREE, session, lambda line: None)
    figures, _ = track_figures(session, bb.track(jax.random.key(case.seed), session, model, particles=case.sizes["particles"]))
    return {"annealed": {"mean error": figures["mean_mm"], "standard deviation of the error": figures["sd_mm"]}}


def convergence(case: Case) -> Mapping[str, Values]:
    """How far beliefs move in each iteration (Fig. 8 and 11), tracking ten parts."""
    session = case.film(RIG, case.sizes["frames"])
    model = bb.load_model(MODELS[10], session, lambda line: None)
    kernel = model.kernel("particle_bp", **PASSING[10] | {"iterations": case.sizes["iterations"]})
    changes = changes_of(bb.track(jax.random.key(case.seed), session, model, kernel, particles=case.sizes["particles"]))
    if case.pictures is not None:
        draw_convergence(case.pictures / "sigal_2011_convergence.png", changes)
    means = changes.mean(axis=(0, 2))
    return {
        "convergence": {f"change in iteration {iteration}": float(means[iteration - 2]) for iteration in (2, 5, 10) if iteration < len(means) + 2}
    }


def recovery(case: Case) -> Mapping[str, Values]:
    """Some black frames in all cameras, with and without recovery."""
    black, errors = range(*case.sizes["black"]), {}
    with tempfile.TemporaryDirectory() as folder:
        session = darkened(case.film(RIG, case.sizes["frames"], 4), Path(folder), black)
        model, key = bb.load_model(MODELS[10], session, lambda line: None), jax.random.key(case.seed)
        kernel = model.kernel("particle_bp", **PASSING[10])
        for name, restart in (("without", None), ("with", bb.PersonRecovery(session, model, case.seed))):
            draws = bb.track(key, session, model, kernel, particles=case.sizes["particles"], recovery=restart)
            errors[name] = track_figures(session, draws)[1]
    after = {f"error after the black frames, {name} recovery": 1000 * float(np.mean(error[black.stop :])) for name, error in errors.items()}
    return {"recovery": after | {"error before them": 1000 * float(np.mean(errors["with"][: black.start]))}}


def pampas(case: Case) -> Mapping[str, Values]:
    """The paper's own message passing with its settings, four cameras, from a first pose that is placed by hand."""
    session = case.film(RIG, case.sizes["frames"], 4)
    model = bb.load_model(PAMPAS, session, lambda line: None)
    figures, _ = track_figures(session, bb.track(jax.random.key(case.seed), session, model, particles=case.sizes["particles"]))
    return {"pampas": {"mean error": figures["mean_mm"], "tracking": figures["seconds_per_frame"]}}


def detectors(case: Case) -> Mapping[str, Values]:
    """Tracks with fifteen parts, with and without detections of limbs and silhouettes among the proposals, seen by 7, 4 and 3 cameras."""
    sizes, values, settled = case.sizes, dict[str, float | None](), dict[str, list[float]]()
    for cameras in sizes["cameras"]:
        session = case.film(RIG, sizes["frames"], cameras, sizes["fps"])
        model = bb.load_model(MODELS[15], session, lambda line: None)
        kernel = model.kernel("particle_bp", samples=sizes["particles"], iterations=sizes["iterations"])
        for name, names in DETECTORS.items():
            detecting = replace(model, definition=replace(model.definition, detectors=names))
            draws = bb.track(jax.random.key(case.seed), session, detecting, kernel, sizes["particles"])
            figures = figures_of(session, draws, [])
            values[f"mean error, {cameras} cameras, {name}"] = figures["error_mm"]
            settled.setdefault(f"iterations until the beliefs settle, {name}", []).append(figures["iterations"])
    return {"detectors": values | {name: float(np.mean(counts)) for name, counts in settled.items()}}


def real_recording(case: Case) -> Mapping[str, Values]:
    """A real man in four cameras, found by detectors alone."""
    distances = distances_mm(case.recorded(BODYTRACK), case.work / BODYTRACK, case.seed)
    of_poses, of_mean = (None, None) if distances is None else distances
    return {"real_recording": {"mean error of found poses": of_poses, "error of their mean": of_mean}}


def graphs(case: Case) -> Mapping[str, Values]:
    """Nodes and edges of both graphs (Table 1, Fig. 1)."""
    del case
    figures: dict[str, float] = {}
    for parts, name in MODELS.items():
        definition = bb.load_definition(name)
        options = {term.kind: term.options for term in definition.constraints}
        joints = tomllib.loads(learned_file(options["kinematic"].learned).with_suffix(".toml").read_text(encoding="utf-8"))["parts"]
        pairs = options["penetration"].pairs
        penetration = definition.body.penetration if pairs is None else pairs
        figures |= {f"nodes, {parts} parts": len(joints) + 1, f"kinematic edges, {parts} parts": len(joints)}
        figures[f"penetration edges, {parts} parts"] = len(penetration)
    return {"graphs": figures}


# Frames that are as far from each other as those that decide which way a person faces: each is searched once.
FRAMES, QUICK_FRAMES = {"frames": 25, "every": 12}, {"frames": 2, "every": 2}
TRACK, QUICK_TRACK = {"frames": 12, "particles": 500}, {"frames": 2, "particles": 50}
EXPERIMENTS = (
    Experiment(("graphs",), graphs, facts=True),
    Experiment(("pose_10", "pose_10_seconds", "turned"), lambda case: pose(case, 10), FRAMES, QUICK_FRAMES),
    Experiment(("pose_15", "pose_15_seconds"), lambda case: pose(case, 15), FRAMES, QUICK_FRAMES, costly=True),
    Experiment(("track_10", "track_10_seconds"), lambda case: track(case, 10), TRACK, QUICK_TRACK),
    Experiment(("track_15", "track_15_seconds"), lambda case: track(case, 15), TRACK, QUICK_TRACK, costly=True),
    Experiment(("annealed",), tree, TRACK, QUICK_TRACK),
    Experiment(("convergence",), convergence, {"frames": 3, "iterations": 10, "particles": 500}, QUICK_TRACK | {"iterations": 3}),
    Experiment(("views",), views, FRAMES, QUICK_FRAMES, costly=True),
    Experiment(("pampas",), pampas, {"frames": 4, "particles": 200}, QUICK_TRACK, costly=True),
    Experiment(
        ("detectors",),
        detectors,
        {"cameras": [7, 4, 3], "frames": 6, "fps": 15, "particles": 300, "iterations": 6},
        {"cameras": [3], "frames": 2, "particles": 50, "iterations": 3},
        costly=True,
    ),
    Experiment(("real_recording",), real_recording, {"cameras": 4}, pairs=[(BODYTRACK, seed) for seed in range(10)]),
    Experiment(
        ("recovery",), recovery, {"frames": 48, "black": [8, 38], "particles": 500}, {"frames": 4, "black": [1, 2], "particles": 50}, costly=True
    ),
)

if __name__ == "__main__":
    reproduce("sigal_2011", EXPERIMENTS)
