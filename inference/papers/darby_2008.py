"""Measure what Darby, Li & Costen 2008 report: `python inference/papers/darby_2008.py --all` writes docs/papers/figures/darby_2008.json.

The experiments are functions of the programs in the folder `darby_2008`; the claims are in its `claims.toml`.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

from bayes_body.model.definition import load_body
from bayes_body.model.dynamics.activity import load_activity, save_activity
from bayes_body.recording.readers.mocap import read_motion
from bayes_body.workshop.learning.activity_hmm import LearnOptions, learn_activity
from bayes_body.workshop.learning.activity_motions import captured

sys.path.append(str(Path(__file__).with_suffix("")))
from activity_graph import draw_activity
from error_plot import draw_error_curves
from few_cameras import GUIDED, PANELS, PLAIN, POSTERIOR, Followed, few_camera_definitions, follow, prior_definitions
from reproduce import Case, Experiment, Values, reproduce

BODY = "person_31"
# Walks of the same people, from which the activity of a known person is learned.
TRAINING = {"38_02": ("38_01",), "35_02": ("35_01", "35_05", "35_07", "35_08", "35_09", "35_10")}
# The paper's number of states, and the frames that a state needs.
STATES, FRAMES_OF_STATE = 30, 10


def activity_of(case: Case) -> str:
    """Return the file of an activity that is learned from other walks of the subject; learned when it is not there yet."""
    names = TRAINING.get(str(case.subject), ())
    path = case.work / "activities" / f"{'_'.join(names)}.npz"
    if not path.exists():
        schema, usual = load_body(BODY), LearnOptions()
        motions = [captured(name, str(case.subject), "walk", read_motion(case.captured(name)), BODY, schema, usual.fps) for name in names]
        options = usual._replace(states=min(STATES, sum(len(motion.dofs) for motion in motions) // FRAMES_OF_STATE))
        path.parent.mkdir(parents=True, exist_ok=True)
        save_activity(learn_activity(motions, BODY, schema, options).activity, path)
    return str(path)


def followed(case: Case, cameras: int, names: tuple[str, ...], activity: str | None = None, gamma: float | None = None) -> dict[str, Followed]:
    """Return the runs of some definitions on the subject's film, by name."""
    sizes = case.sizes
    session = case.film("room_4", sizes["frames"], cameras)
    definitions = few_camera_definitions(cameras, activity, activity is not None, gamma)
    particles = {name: min(definitions[name].kernel.options.particles, sizes["particles"]) for name in names}
    return {name: follow(session, definitions[name], sizes["runs"], case.seed, None, particles[name]) for name in names}


def mean_mm(track: Followed, field: str) -> float:
    """Return the mean of an error over runs and frames."""
    return 1000 * float(getattr(track, field).mean())


def lost_percent(*tracks: Followed) -> float:
    """Return the share of the runs that lost the person."""
    return 100 * sum(track.lost for track in tracks) / sum(len(track.relative_m) for track in tracks)


def two_cameras(case: Case) -> Mapping[str, Values]:
    """Two cameras, an unknown person (Fig. 2a)."""
    tracks = followed(case, 2, (GUIDED, PLAIN))
    guided, plain = tracks[GUIDED], tracks[PLAIN]
    if case.pictures is not None:
        named = {"guided": guided, "plain": plain}
        panels = {kind: {name: getattr(track, field) for name, track in named.items()} for kind, field in PANELS.items()}
        draw_error_curves(case.pictures / "darby_2008_two_cameras.png", panels)
    return {
        "two_cameras": {
            "optimistic error, guided": mean_mm(guided, "optimistic_m"),
            "optimistic error, plain": mean_mm(plain, "optimistic_m"),
            "guided / plain": mean_mm(guided, "optimistic_m") / mean_mm(plain, "optimistic_m"),
            "absolute error, guided": mean_mm(guided, "absolute_m"),
        },
        "robust": {"lost runs, guided": lost_percent(guided), "lost runs, plain": lost_percent(plain)},
        "evaluations": {
            "guided": guided.evaluations,
            "plain": plain.evaluations,
            "frames per second, guided": guided.figures()["frames_per_second"],
        },
    }


def two_cameras_known(case: Case) -> Mapping[str, Values]:
    """Two cameras, a known person (Fig. 2a)."""
    track = followed(case, 2, (GUIDED,), activity_of(case))[GUIDED]
    return {"two_cameras_known": {"optimistic error, guided": mean_mm(track, "optimistic_m"), "absolute error, guided": mean_mm(track, "absolute_m")}}


def posterior(case: Case) -> Mapping[str, Values]:
    """The posterior of the activity with two cameras: the same model, sampled."""
    track = followed(case, 2, (POSTERIOR,))[POSTERIOR]
    inside = 100 * float(track.coverage_90.mean())
    return {"posterior": {"absolute error": mean_mm(track, "absolute_m"), "90 % intervals that hold the truth": inside}}


def one_camera(case: Case) -> Mapping[str, Values]:
    """One camera, an unknown person (Fig. 2b, 2c and 3)."""
    tracks = followed(case, 1, (GUIDED, PLAIN))
    guided, plain = tracks[GUIDED], tracks[PLAIN]
    flat = followed(case, 1, (GUIDED,), gamma=0.0)[GUIDED]
    if case.pictures is not None:
        named = {"γ = 5": guided, "γ = 0": flat, "plain filter": plain}
        draw_error_curves(
            case.pictures / "darby_2008_one_camera.png",
            {kind: {name: getattr(track, PANELS[kind]) for name, track in named.items()} for kind in ("absolute", "relative")},
        )
    return {
        "one_camera_absolute": {
            "largest absolute error, γ = 5": 1000 * float(guided.absolute_m.max()),
            "absolute error, γ = 5": mean_mm(guided, "absolute_m"),
            "absolute error, γ = 0": mean_mm(flat, "absolute_m"),
            "absolute error, plain filter": mean_mm(plain, "absolute_m"),
        },
        "one_camera_relative": {
            "relative error, guided": mean_mm(guided, "relative_m"),
            "relative error, plain": mean_mm(plain, "relative_m"),
            "lost runs, guided": lost_percent(guided),
        },
    }


def one_camera_posterior(case: Case) -> Mapping[str, Values]:
    """The posterior of the activity with one camera."""
    track = followed(case, 1, (POSTERIOR,))[POSTERIOR]
    inside = 100 * float(track.coverage_90.mean())
    return {"one_camera_posterior": {"relative error": mean_mm(track, "relative_m"), "90 % intervals that hold the truth": inside}}


def one_camera_known(case: Case) -> Mapping[str, Values]:
    """One camera, a known person (Fig. 2c)."""
    track = followed(case, 1, (GUIDED,), activity_of(case))[GUIDED]
    return {"one_camera_known": {"relative error, guided": mean_mm(track, "relative_m"), "absolute error, guided": mean_mm(track, "absolute_m")}}


def priors(case: Case) -> Mapping[str, Values]:
    """Three motion priors with one body, likelihood and kernel; two cameras."""
    session, values = case.film("room_4", case.sizes["frames"], 2), dict[str, float]()
    for name, definition in prior_definitions().items():
        track = follow(session, definition, case.sizes["runs"], case.seed, None, case.sizes["particles"])
        values[f"`{name}`: log-evidence"] = track.log_evidence
        values[f"`{name}`: error"] = mean_mm(track, "absolute_m")
        values[f"`{name}`: 90 % intervals that hold the truth"] = 100 * float(track.coverage_90.mean())
    return {"priors": values}


def activity(case: Case) -> Mapping[str, Values]:
    """The learned activity (Fig. 1)."""
    learned = load_activity()
    if case.pictures is not None:
        draw_activity(case.pictures / "darby_2008_activity.png", learned)
    return {
        "activity": {
            "share of the variance in 4 features": 100 * learned.kept,
            "states": float(len(learned.transition)),
            "people": float(len(learned.subjects)),
        }
    }


SIZES, QUICK = {"frames": 60, "runs": 2, "particles": 1000}, {"frames": 4, "runs": 1, "particles": 20}
# As long as the paper's films: the plain filter loses people later than in the first second.
LONG = SIZES | {"frames": 150}
EXPERIMENTS = (
    Experiment(("activity",), activity, facts=True),
    Experiment(("two_cameras", "robust", "evaluations"), two_cameras, LONG, QUICK),
    Experiment(("one_camera_absolute", "one_camera_relative"), one_camera, SIZES, QUICK),
    Experiment(("two_cameras_known",), two_cameras_known, LONG, QUICK),
    Experiment(("one_camera_known",), one_camera_known, SIZES, QUICK),
    Experiment(("posterior",), posterior, SIZES, QUICK),
    Experiment(("one_camera_posterior",), one_camera_posterior, SIZES, QUICK),
    Experiment(("priors",), priors, {"frames": 60, "runs": 1, "particles": 500}, QUICK, costly=True),
)

if __name__ == "__main__":
    reproduce("darby_2008", EXPERIMENTS)
