"""Diagnostics of a posterior made by hand: closed forms, and each sentence exactly where its limit is crossed."""

import dataclasses

import numpy as np
import pytest

from bayes_body.density.kernel import NO_ANCESTOR
from bayes_body.results.posterior.diagnostics import Thresholds, diagnose, frame_ranges, sentences, worst_figures
from bayes_body.results.posterior.genealogy import unique_ancestors

RUNS, DRAWS, FRAMES = 3, 400, 12


def few(count, frames, run=1):
    """Weights of which `count` are equal and the others nothing, in those frames of a run."""
    out = np.full((RUNS, DRAWS, FRAMES), -np.log(DRAWS))
    for frame in frames:
        out[run, :, frame] = -np.inf
        out[run, :count, frame] = -np.log(count)
    return out


def test_effective_sample_size_of_equal_weights_is_their_number(make_tree):
    found = diagnose(make_tree(log_weight=few(37, [4])))
    assert np.isclose(found.ess[1, 4], 37) and np.isclose(found.ess[0], DRAWS).all()


def test_a_block_changes_nothing(make_tree):
    rng = np.random.default_rng(0)
    tree = make_tree(log_weight=rng.normal(size=(RUNS, DRAWS, FRAMES)), ancestor=rng.integers(0, DRAWS, size=(RUNS, DRAWS, FRAMES)))
    whole, cut = diagnose(tree), diagnose(tree, block=5)
    for field in dataclasses.fields(whole):
        a, b = getattr(whole, field.name), getattr(cut, field.name)
        assert np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b


def test_unique_ancestors_of_a_hand_made_genealogy(make_tree):
    # Of frame 2's six particles the parents are 0 and 1, of these the parent is 3; frame 1 shuffles.
    ancestor = np.array([[0, 1, 2, 3, 4, 5], [3, 3, 2, 2, 1, 0], [0, 0, 0, 1, 1, 1], [5, 5, 5, 5, 0, 0]]).T[None]
    counts = unique_ancestors(make_tree(runs=1, draws=6, frames=4, ancestor=ancestor), (1, 2, 3))
    assert np.array_equal(counts[:, 0], [[6, 4, 2, 2], [np.nan, 4, 1, 2], [np.nan, np.nan, 1, 1]], equal_nan=True)


def test_particles_without_ancestors_have_no_number_of_ancestors(make_tree):
    """As with a prediction by a Gaussian, here in the second of four frames."""
    ancestor = np.tile(np.arange(6)[None, :, None], (1, 1, 4))
    ancestor[:, :, 1] = NO_ANCESTOR
    tree = make_tree(runs=1, draws=6, frames=4, ancestor=ancestor)
    np.testing.assert_array_equal(unique_ancestors(tree, (1, 2))[:, 0], [[6, np.nan, 6, 6], [np.nan, np.nan, np.nan, 6]])
    everywhere = make_tree(ancestor=np.full((3, 400, 12), NO_ANCESTOR))
    assert sentences(diagnose(everywhere)) == [] and worst_figures(diagnose(everywhere))["ancestors_min"] is None


def test_paths_of_a_smoother_get_its_remedy(make_tree):
    tree = make_tree(**apart(3))
    tree.attrs["smoothed"] = 1
    assert "smooth with more --moves, or smooth a run with more --particles" in sentences(diagnose(tree))[0]


def joint(make_tree, **figures):
    """The diagnosis of paths from one Gaussian, which converged and fits, but for the figures given."""
    good = {"steps": np.full((RUNS, FRAMES), 7), "converged": np.ones((RUNS, FRAMES), bool), "pareto_k": np.full((RUNS, FRAMES), 0.7)}
    tree = make_tree(ancestor=np.full((RUNS, DRAWS, FRAMES), NO_ANCESTOR))
    near = figures.pop("near_limit", np.zeros((RUNS, FRAMES, 2), bool))
    values = {f"joint_{name}": (("chain", "frame"), value) for name, value in (good | figures).items()}
    values["joint_near_limit"] = (("chain", "frame", "dof"), near)
    tree["filter"] = tree["filter"].to_dataset().assign(values).assign_coords(dof=tree["posterior"]["dof"])
    tree.attrs["smoothed"] = 1
    return diagnose(tree)


def test_one_gaussian_of_all_frames_that_fits_gives_no_warning(make_tree):
    found = joint(make_tree)
    assert sentences(found) == []
    figures = {name: value for name, value in worst_figures(found).items() if name.startswith("joint_")}
    assert figures == {"joint_steps_max": 7, "joint_converged_share": 1, "joint_pareto_k_share": 1, "joint_near_limit_max": 0}


def test_where_one_gaussian_of_all_frames_fits_badly(make_tree):
    shapes, converged, near = np.full((RUNS, FRAMES), 0.2), np.ones((RUNS, FRAMES), bool), np.zeros((RUNS, FRAMES, 2), bool)
    shapes[1, 4:6], converged[2], near[:, :2, 1] = [0.71, np.inf], False, True
    found = joint(make_tree, pareto_k=shapes, converged=converged, near_limit=near)
    search, windows, limits = sentences(found)
    assert search.startswith(
        "the search for the Gaussian of all frames did not end within 7 steps in run 3: do not use its paths; smooth with --start"
    )
    assert windows.startswith(
        "frames 4-5: the Gaussian of all frames fits badly in windows about 6% of the frames, Pareto k inf at worst, at frame 5 ("
    )
    assert limits.startswith("knee (17% of the frames): within three standard deviations of a limit, where the Gaussian is too far from it")
    assert np.isclose(worst_figures(found)["joint_pareto_k_share"], 34 / 36)
    (sentence,) = sentences(joint(make_tree, pareto_k=np.full((RUNS, FRAMES), np.nan)))
    assert sentence.startswith("too few paths for Pareto k")


@pytest.mark.parametrize("frames", [1, 7, 150])
def test_unique_ancestors_by_following_each_particle(make_tree, frames):
    rng = np.random.default_rng(frames)
    ancestor = rng.integers(0, 9, size=(2, 9, frames))
    counts = unique_ancestors(make_tree(runs=2, draws=9, frames=frames, ancestor=ancestor), (1, 5, 10))
    for row, lag in enumerate((1, 5, 10)):
        for run, frame in np.ndindex(2, frames):
            lineage = np.arange(9)
            for back in range(min(lag, frame + 1)):
                lineage = ancestor[run, lineage, frame - back]
            expected = len(set(lineage)) if frame - lag + 1 >= 0 else np.nan
            assert np.array_equal(counts[row, run, frame], expected, equal_nan=True)


def test_the_spread_of_the_evidence(make_tree):
    rng = np.random.default_rng(1)
    evidence = rng.normal(size=(RUNS, FRAMES))
    found = diagnose(make_tree(log_evidence=evidence))
    assert np.isclose(found.evidence_sd, evidence.sum(axis=1).std(ddof=1)) and np.allclose(found.evidence_sd_frames, evidence.std(axis=0, ddof=1))
    evidence[0, 3] = -np.inf
    found = diagnose(make_tree(log_evidence=evidence))
    assert np.isnan(found.evidence_sd) and np.isnan(found.evidence_sd_frames[3]) and np.isfinite(found.evidence_sd_frames[4])


def test_a_sound_run_says_nothing(make_tree):
    assert sentences(diagnose(make_tree())) == []


def evidence(total_sd):
    out = np.zeros((RUNS, FRAMES))
    out[:, 7] = total_sd * np.array([-1.0, 0.0, 1.0])
    return {"log_evidence": out}


def ancestors(count):
    out = np.tile(np.arange(DRAWS)[None, :, None], (RUNS, 1, FRAMES))
    out[2, :, 5] %= count
    return {"ancestor": out}


def apart(shift):
    pose = np.random.default_rng(5).normal(size=(RUNS, DRAWS, FRAMES, 2))
    pose[0, :, 3:6, 1] += shift
    return {"pose": pose}


def heavy(k):
    out = np.zeros((RUNS, DRAWS, FRAMES))
    out[0, :, 8] = -k * np.log((np.arange(DRAWS) + 0.5) / DRAWS)
    return {"log_weight": out}


def accepted(rate):
    return {"acceptance_rate": np.where(np.arange(FRAMES)[None, :, None] == 2, rate, 0.6) * np.ones((RUNS, 1, 3))}


def flags(frame, value):
    return np.where(np.arange(FRAMES) == frame, value, not value)


# What is said; the arrays on this side of the limit, and on the other.
CROSSED = {
    "ess": (
        ["frames 4, 6-7: 49 effective particles of 400", "limit 50", "--particles"],
        {"log_weight": few(49, [4, 6, 7])},
        {"log_weight": few(51, [4])},
    ),
    "k": (["frame 8: a few weights dominate", "Pareto k", "--particles"], heavy(1.1), heavy(0.3)),
    "ancestors": (["frame 5: all particles descend from 9 of the frame before", "limit 10"], ancestors(9), ancestors(10)),
    "rhat": (["frames 3-5: the runs disagree", "knee at frame", "limit 1.05"], apart(1.0), apart(0.02)),
    "evidence": (["log-evidence: sd 2.1 nats over 3 runs", "most at frame 7", "--particles"], evidence(2.1), evidence(1.9)),
    "low acceptance": (["frame 2: 0.14 of the Markov moves accepted", "hardly"], accepted(0.14), accepted(0.16)),
    "high acceptance": (["frame 2: 0.99 of the Markov moves accepted", "too short"], accepted(0.99), accepted(0.97)),
    "lost": (["frame 9: lost", "look at the images"], {"lost": np.tile(flags(9, True), (RUNS, 1))}, {}),
    "unseen": (
        ["nothing seen by camera right in frame 4:"],
        {"seen": np.stack([np.ones(FRAMES, bool), flags(4, False)], axis=1)},
        {"seen": np.ones((FRAMES, 2), bool)},
    ),
}


# Weights of which most are nothing have a tail without end, and heavy ones few effective particles: each is another sentence.
ALONE = {"ess": Thresholds(pareto_k=np.inf), "k": Thresholds(ess=0, ess_share=0, rhat=np.inf)}


@pytest.mark.parametrize("limit", CROSSED)
def test_a_sentence_appears_exactly_when_its_limit_is_crossed(make_tree, limit):
    parts, beyond, within = CROSSED[limit]
    alone = ALONE.get(limit, Thresholds())
    (sentence,) = sentences(diagnose(make_tree(**beyond)), alone)
    for part in parts:
        assert part in sentence
    assert sentences(diagnose(make_tree(**within)), alone) == []


@pytest.mark.parametrize(("above", "rhat", "warned"), [(2, 1.19, False), (3, 1.06, True), (1, 1.21, True)])
def test_a_few_of_many_dofs_may_differ_a_little(make_tree, above, rhat, warned):
    """Of forty dofs, two are five per cent."""
    rhats = np.ones((FRAMES, 40))
    rhats[6, :above] = rhat
    told = sentences(dataclasses.replace(diagnose(make_tree()), rhat=rhats, dofs=tuple(f"dof_{k}" for k in range(40))))
    assert [f"frame 6: the runs disagree, R-hat up to {rhat} (dof_0 at frame 6" in sentence for sentence in told] == [True] * warned


def test_the_limits_are_those_given(make_tree):
    found = diagnose(make_tree(log_weight=few(51, [4])))
    assert len(sentences(found, Thresholds(pareto_k=np.inf, ess=52))) == len(sentences(found, Thresholds(pareto_k=np.inf, ess_share=0.14))) == 1


@pytest.mark.parametrize(
    ("kernel", "options"), [("sir", "raise --particles, or use --kernel tempered"), ("tempered", "raise --particles or --moves.")]
)
def test_the_remedy_is_an_option_that_the_kernel_has(make_tree, kernel, options):
    (sentence,) = sentences(diagnose(make_tree(kernel=kernel, log_weight=few(49, [4]))), Thresholds(pareto_k=np.inf))
    assert options in sentence


def test_a_mode_seeker_s_spread_is_no_uncertainty(make_tree):
    nothing = {"log_evidence": np.full((RUNS, FRAMES), np.nan), "log_weight": few(3, [4])}
    told = sentences(diagnose(make_tree(kernel="annealed", **nothing, **apart(1.0))))
    assert len(told) == 2
    assert "mode seeker" in told[0] and "not a measure of uncertainty" in told[0] and "no evidence" in told[0]
    assert "disagree" in told[1] and "--layers or --particles" in told[1]


def test_a_single_run_has_nothing_to_agree_with(make_tree):
    (sentence,) = sentences(diagnose(make_tree(runs=1)))
    assert "--runs 2" in sentence


def test_the_most_serious_comes_first_and_all_fit_on_a_screen(make_tree):
    bad = evidence(5) | ancestors(2) | apart(3) | {"log_weight": few(3, range(FRAMES))} | CROSSED["lost"][1] | CROSSED["unseen"][1]
    told = sentences(diagnose(make_tree(**bad, **accepted(0.01))))
    assert "lost" in told[0] and len(told) == 8


def test_frames_in_words():
    assert frame_ranges([3]) == "frame 3"
    assert frame_ranges([3, 4, 5, 9]) == "frames 3-5, 9"
    assert frame_ranges(range(0, 40, 2), most=3) == "frames 0, 2, 4 and 17 more"
