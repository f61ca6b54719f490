"""Measure what Sidenbladh, Black & Fleet 2000 report, for docs/papers/figures/sidenbladh_2000.json.

    python inference/papers/sidenbladh_2000.py --all

The experiments are functions of the programs in the folder `sidenbladh_2000`; the claims are in its `claims.toml`.
"""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import replacing
from bayes_body.model.dynamics.angle_cycle import load_angle_cycle
from bayes_body.view.colours import INK, run_line

sys.path.append(str(Path(__file__).with_suffix("")))
from arm_picture import draw_shoulder
from bending_arm import film_arm, interval_of, track_arm
from eigencurves import draw_eigencurves
from filmed_walk import FPS
from image_motion import RADIUS_M, errors, heading_error_deg, motion_figures, track_by_mapping, track_three_times
from reproduce import Case, Experiment, Values, reproduce

MODEL = "sidenbladh_2000_walking"


def arm(case: Case) -> Mapping[str, Values]:
    """The twist of an arm that bends (Fig. 4), in films with several twists."""
    intervals = []
    for number, twist_deg in enumerate(case.sizes["twists_deg"]):
        with tempfile.TemporaryDirectory() as folder:
            filmed = film_arm(Path(folder) / "film", twist_deg, case.seed, case.motion)
            draws = track_arm(filmed, case.sizes["particles"], case.seed)
        intervals.append(interval_of(filmed, draws))
        if case.pictures is not None and number == 0:
            draw_shoulder(case.pictures / "sidenbladh_2000_arm.png", draws, filmed.angles)
    return {
        "arm": {
            "90 % interval before the bend": float(np.median([interval.before_deg for interval in intervals])),
            "90 % interval after the bend": float(np.median([interval.after_deg for interval in intervals])),
            "films with the truth in every interval after the bend": 100 * float(np.mean([interval.holds for interval in intervals])),
            "films whose filter knows nothing before and the truth after": 100 * float(np.mean([interval.passes for interval in intervals])),
        }
    }


def walk(case: Case, radius_m: float | None) -> tuple[dict[str, float], dict[str, Float[np.ndarray, " frame"]]]:
    """Track a walk by image motion, by the prior alone, and with silhouettes and edges; return figures, and the absolute errors, metres."""
    session = case.film("side_1", case.sizes["frames"], fps=FPS, radius_m=radius_m)
    tracks = track_three_times(session, MODEL, case.sizes["particles"], case.seed, radius_m is not None)
    return motion_figures(session, tracks), {name: errors(session, draws)[0] for name, draws in tracks._asdict().items()}


def straight(case: Case) -> Mapping[str, Values]:
    """A straight walk past the camera (Fig. 5)."""
    figures, _ = walk(case, None)
    return {
        "straight": {"relative error": figures["relative_error_mm"], "absolute error": figures["absolute_error_mm"]},
        "seconds": {"5000 particles": figures["seconds_per_frame"]},
        "edges": {
            "drift, image motion": figures["drift_mm_per_50_frames"],
            "drift, with silhouettes and edges": figures["drift_with_edges_mm_per_50_frames"],
        },
    }


def planar(case: Case) -> Mapping[str, Values]:
    """A straight walk, where a limb's visible half is a plane, as in the paper, or a cylinder (Fig. 2)."""
    session, values = case.film("side_1", case.sizes["frames"], fps=FPS), dict[str, float]()
    for mapping in ("plane", "cylinder"):
        draws = track_by_mapping(session, MODEL, mapping, case.sizes["particles"], case.seed)
        values[f"heading off in the last frame, {mapping}"] = heading_error_deg(session, draws)
        values[f"absolute error, {mapping}"] = 1000 * float(errors(session, draws)[0].mean())
    return {"planar": values}


def circle(case: Case) -> Mapping[str, Values]:
    """A walk on a circle (Fig. 6), and the prior alone (Fig. 7)."""
    figures, by_frame = walk(case, RADIUS_M)
    if case.pictures is not None:
        draw_prior(case.pictures / "sidenbladh_2000_prior.png", {"image motion": by_frame["tracked"], "the prior alone": by_frame["prior"]})
    return {
        "circle": {
            "relative error": figures["relative_error_mm"],
            "absolute error": figures["absolute_error_mm"],
            "drift": figures["drift_mm_per_50_frames"],
        },
        "prior_alone": {
            "absolute error, the prior alone": figures["prior_only_absolute_error_mm"],
            "absolute error, image motion": figures["absolute_error_mm"],
        },
    }


def draw_prior(path: Path, absolute_m: Mapping[str, Sequence[float] | Float[np.ndarray, " frame"]]) -> None:
    """Write a .png of the absolute errors by frame.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    for number, (name, error_m) in enumerate(absolute_m.items()):
        axes.plot(1000 * np.asarray(error_m), color=INK, linestyle=run_line(number), label=name)
    axes.set(xlabel="frame", ylabel="mean error of the markers, mm", ylim=(0, None))
    axes.legend()
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)


def eigencurves(case: Case) -> Mapping[str, Values]:
    """The learned cycle (Fig. 3)."""
    cycle = load_angle_cycle("walking_angles_25")
    if case.pictures is not None:
        draw_eigencurves(case.pictures / "sidenbladh_2000_eigencurves.png", cycle)
    return {"eigencurves": {"modes": float(len(cycle.modes)), "share of the variance": cycle.explained}}


EXPERIMENTS = (
    Experiment(("eigencurves",), eigencurves, facts=True),
    Experiment(("arm",), arm, {"particles": 10_000, "twists_deg": [20, -30]}, {"particles": 500, "twists_deg": [20]}),
    Experiment(("straight", "seconds", "edges"), straight, {"frames": 50, "particles": 5000}, {"frames": 6, "particles": 200}),
    Experiment(("planar",), planar, {"frames": 50, "particles": 5000}, {"frames": 6, "particles": 200}),
    Experiment(("circle", "prior_alone"), circle, {"frames": 50, "particles": 15_000}, {"frames": 6, "particles": 200}),
)

if __name__ == "__main__":
    reproduce("sidenbladh_2000", EXPERIMENTS)
