"""A run's figures for a terminal."""

from bayes_body.results.metrics.figures import NAMES
from bayes_body.view.figures_text import figures_text, warning_line

SUMMARY = {
    **{"frames": 5, "frames_lost": 1, "cameras": 2, "dof": 31, "seconds_per_frame": 0.25, "seconds_compile": 3.0, "evaluations_per_second": 1e4},
    **{"peak_memory_mb": 900.0, "ess_median": 100.0, "ess_min": 40.0, "particles": 500, "iou_median": None, "rhat_max": 1.234},
    "marker_disagreement_mm": None,
}
ERRORS = {"error_mm_mean": 48.2, "error_mm_std": 12.4, "error_mm_optimistic": 30.6, "error_mm_relative": 40.1, "error_mm_mean_fitted_offset": 35.5}


def test_figures_have_units_and_what_does_not_exist_is_a_dash():
    frames, time, particles, agreement = figures_text(SUMMARY | dict.fromkeys(NAMES)).splitlines()
    assert frames == "frames      5, lost 1; 2 cameras, 31 dofs"
    assert time == "time        0.250 s a frame; compilation 3.0 s; 10,000 evaluations/s; 900 MB"
    assert particles == "particles   effective 100 (median), 40 (minimum) of 500"
    assert agreement == "agreement   overlap with the silhouettes (IoU) -; R-hat over runs at most 1.23; mean markers of the runs - apart"
    # The filter does not know whether it is on the person: the judge does.
    assert figures_text(SUMMARY | {"frames_off": [3, 4, 5]}).splitlines()[0] == "frames      5, lost 1, off the person 3; 2 cameras, 31 dofs"
    # As an older version wrote it.
    assert figures_text(SUMMARY).splitlines() == [frames, time, particles, agreement]


def test_a_run_is_headed_by_what_it_was_fitted_to():
    given = SUMMARY | {"iou_median": 0.5, "reprojection_px_median": 4.24}
    heads = {
        reads: figures_text(given | {"reads": [reads]}).splitlines()[3].split("; R-hat")[0][12:] for reads in ("keypoints", "silhouettes", "other")
    }
    assert heads["keypoints"] == "reprojection error of the keypoints 4.2 px (median)"
    assert heads["silhouettes"] == heads["other"] == "overlap with the silhouettes (IoU) 0.500"
    assert "silhouettes" not in figures_text(given | {"reads": ["edges"]})


def test_of_one_gaussian_the_terminal_says_whether_it_was_reached_and_where_it_fits():
    fit = {"joint_steps_max": 7.0, "joint_converged_share": 1.0, "joint_pareto_k_share": 0.62}
    (line,) = figures_text(SUMMARY | fit).splitlines()[4:]
    assert line == "joint       converged after 7 Newton steps; Pareto k at most 0.7 in windows about 62 % of the frames"
    (line,) = figures_text(SUMMARY | fit | {"joint_converged_share": 0.5, "joint_pareto_k_share": None}).splitlines()[4:]
    assert line == "joint       not converged after 7 Newton steps; Pareto k unknown"


def test_a_warning_is_called_one():
    assert warning_line("frame 3: lost.") == "warning     frame 3: lost."


def test_with_a_truth_there_is_a_line_on_it():
    none = SUMMARY | dict.fromkeys(NAMES)
    whole = figures_text(none | ERRORS | {"coverage_50": 0.31, "coverage_90": 0.62}).splitlines()[-1]
    assert whole == (
        "accuracy    48 mm from the truth, sd over the frames 12 mm, best particle 31 mm, relative to the pelvis 40 mm, "
        "with the skeletons' offset fitted 36 mm; 31 % of the truth inside the 50 % intervals, 62 % of the truth inside the 90 % intervals"
    )
    assert figures_text(none | {"error_mm_mean": 48.2}).splitlines()[-1] == "accuracy    48 mm from the truth"
    calibration = {"error_mm_mean": 48.2, "ece_radial": 0.08, "ece_radial_by_marker": {"l_wrist": 0.31, "head": 0.02}}
    assert figures_text(none | calibration).splitlines()[-1] == "accuracy    48 mm from the truth; calibration error 0.08 (worst l_wrist, 0.31)"
