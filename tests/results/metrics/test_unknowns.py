"""What a run says of its unknowns in the last frame, and of dofs at their limits: figures against a direct computation, lines and warnings."""

import numpy as np
import pytest

from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.results.metrics.unknown_sentences import unknown_lines, unknown_sentences
from bayes_body.results.metrics.unknowns import near_limit_shares, near_limits, unknown_figures
from bayes_body.tracking.draws import FrameResult

RUNS, DRAWS = 2, 400
TABLES = '\n[[unknown]]\nkind = "lengths"\n\n[[unknown]]\nkind = "cameras"\n'


@pytest.fixture(scope="module")
def model(keypoint_session):
    definition = load_definition("arm_markers")
    return build_model(parse_definition("arm", definition.text + TABLES, definition.body_text), keypoint_session)


def frame_of(model, log_weights=None, **states):
    """A frame whose unknowns have half of their prior's spread, and whose pose is in the middle of its limits."""
    rng = np.random.default_rng(4)
    given = {term.name: rng.normal(size=(RUNS, DRAWS, len(term.sd))) * 0.5 * np.asarray(term.sd) for term in model.unknowns}
    middle = (np.asarray(model.body.skeleton.low) + np.asarray(model.body.skeleton.high)) / 2
    given["pose"] = middle + 0.05 * rng.normal(size=(RUNS, DRAWS, len(middle)))
    weights = np.full((RUNS, DRAWS), -np.log(DRAWS)) if log_weights is None else log_weights
    return FrameResult({**given, **states}, weights, None, np.ones(2, bool), 0.0)


def row(figures, name, entry):
    return next(row for row in figures["unknowns"] if (row["name"], row["entry"]) == (name, entry))


def test_figures_are_those_of_all_weighted_draws(model):
    log_weights = np.log(np.random.default_rng(2).dirichlet(np.ones(DRAWS), size=RUNS))
    frame = frame_of(model, log_weights)
    figures = unknown_figures(model, frame, 3)
    assert [(row["name"], row["entry"]) for row in figures["unknowns"]] == [
        (term.name, label) for term in model.unknowns for label in term.space.labels
    ]
    # A label names a bone, and the entries mix to the bones.
    mixing = np.asarray(model.unknowns[0].mixing, float)
    assert not np.allclose(mixing, np.eye(len(mixing)), atol=0.05)
    lengths, weights = frame.states["lengths"].reshape(-1, len(mixing)) @ mixing.T, np.exp(log_weights).reshape(-1) / RUNS
    mean = weights @ lengths
    sd = np.sqrt(weights @ (lengths - mean) ** 2)
    for place, label in enumerate(model.unknowns[0].space.labels):
        entry = row(figures, "lengths", label)
        assert entry["mean"] == pytest.approx(mean[place])
        assert entry["sd"] == pytest.approx(sd[place])
        assert entry["sd_ratio"] == pytest.approx(sd[place] / entry["prior_sd"])
    camera = row(figures, "cameras", "a_turn_x")
    assert camera["unit"] == "rad" and camera["prior_sd"] == pytest.approx(np.radians(0.5))


def test_runs_that_disagree_about_an_unknown_have_a_large_rhat(model):
    frame = frame_of(model)
    alike = unknown_figures(model, frame, 0)
    assert alike["unknowns_rhat_max"] < 1.1
    frame.states["cameras"][1, :, 4] += 0.05
    apart = unknown_figures(model, frame, 0)
    assert apart["unknowns_rhat_max"] == row(apart, "cameras", model.unknowns[1].space.labels[4])["rhat"] > 1.5
    assert apart["unknowns_independent_draws_min"] < 30 < alike["unknowns_independent_draws_min"]


def test_what_does_not_exist_is_none(model, keypoint_session):
    assert unknown_figures(build_model("arm_markers", keypoint_session), frame_of(model), 0) == {}
    single = frame_of(model)
    single = FrameResult({name: values[:1] for name, values in single.states.items()}, single.log_weights[:1], None, single.seen, 0.0)
    figures = unknown_figures(model, single, 0, is_sample=False)
    assert figures["unknowns_rhat_max"] is None and figures["unknowns_independent_draws_min"] is None
    assert all(entry["sd"] is None and entry["sd_ratio"] is None for entry in figures["unknowns"])
    assert unknown_lines(figures)[0] == f"unknowns    {len(figures['unknowns'])} entries"


def test_the_terminal_counts_what_stays_open_and_names_the_largest_shifts(model):
    frame = frame_of(model)
    frame.states["lengths"][..., 1] = 0.03 + np.asarray(model.unknowns[0].sd)[1] * np.random.default_rng(1).normal(size=(RUNS, DRAWS))
    frame.states["cameras"][..., 0] += np.radians(0.8)
    figures = unknown_figures(model, frame, 0)
    counted, furthest = unknown_lines(figures)
    total = len(figures["unknowns"])
    assert counted.startswith(f"unknowns    1 of {total} entries stay as uncertain as their prior; R-hat over runs at most 1.0")
    assert "cameras: a turn x +0." in furthest and "° (1." in furthest and " % (0.4 prior sd)" in furthest
    assert furthest.index("cameras") < furthest.index("lengths")
    assert unknown_lines({}) == []


def test_an_unknown_far_from_its_prior_is_a_warning_with_its_likely_cause(model):
    frame = frame_of(model)
    assert unknown_sentences(unknown_figures(model, frame, 0)) == []
    frame.states["cameras"][..., 3] += 0.07
    (sentence,) = unknown_sentences(unknown_figures(model, frame, 0))
    assert sentence.startswith("cameras: a move x +7") and " mm (3.5 prior sd)" in sentence and "the calibration" in sentence


def test_a_dof_is_near_its_limit_if_the_posterior_says_so_in_all_runs(model):
    high = np.asarray(model.body.skeleton.high)
    elbow = model.body.dof_names.index("elbow")

    def pose(distance, sd, runs=(0, 1)):
        frame = frame_of(model)
        noise = np.random.default_rng(3).normal(size=DRAWS)
        noise = (noise - noise.mean()) / noise.std()
        for run in runs:
            frame.states["pose"][run, :, elbow] = high[elbow] - distance + sd * noise
        return near_limits(model, frame)

    assert not near_limits(model, frame_of(model)).any()
    assert np.flatnonzero(pose(0.19, 0.1)).tolist() == [elbow]
    assert not pose(0.21, 0.1).any()
    assert not pose(0.19, 0.1, runs=(0,)).any()
    # Nearly as wide as the limits are apart: nothing is known.
    assert not pose(0.5, 0.4).any()


def test_a_dof_at_its_limit_is_a_warning_that_names_the_lengths(model):
    flags = np.array([[False, False, False, frame < 3] for frame in range(10)])
    shares = near_limit_shares(model, flags)
    assert shares == {"elbow": 0.3} and near_limit_shares(model, None) == {}
    (sentence,) = unknown_sentences({"near_limit_shares": shares})
    assert sentence.startswith("elbow (30% of the frames): within two posterior standard deviations of a limit")
    assert "wrong lengths" in sentence and "[[unknown]] kind = 'lengths'" in sentence
    assert unknown_sentences({"near_limit_shares": {"elbow": 0.29}}) == []
    with_lengths = {"near_limit_shares": shares, "unknowns": unknown_figures(model, frame_of(model), 0)["unknowns"]}
    assert "wrong lengths" not in unknown_sentences(with_lengths)[0]
    # Of paths from one Gaussian, another sentence says so.
    assert unknown_sentences({"near_limit_shares": shares, "joint_near_limit_max": 0.3}) == []
