"""What the plots are made of: means and quantiles, limbs, bins, ranks, equal-weight draws, the command that repeats a run."""

import dataclasses
import shlex

import numpy as np
import pytest

from bayes_body.view.report.figures import MOST_POINTS, bins, draw_runs, encoded, new_panel, style
from bayes_body.view.report.head import LONGEST, command, provenance_section
from bayes_body.view.report.inspection import FEWEST_DRAWS, MOST_DRAWS, OTHER, by_limb, chosen_dofs, chosen_frames, equal_weight_sample, limb, spoken
from bayes_body.view.report.markup import Markup, joined, tag
from bayes_body.view.report.ranks import rank_region


def test_curves_are_weighted_means_and_quantiles_in_degrees_and_metres(inspect):
    rng = np.random.default_rng(2)
    pose, log_weight = rng.normal(size=(2, 300, 3, 2)), rng.normal(size=(2, 300, 3))
    it = inspect(draws=300, frames=3, dofs=("root_x", "l_knee"), units=("m", "rad"), pose=pose, log_weight=log_weight)
    weights = np.exp(log_weight) / np.exp(log_weight).sum(axis=1, keepdims=True) / 2
    assert it.units == ("m", "°") and it.curves.mean.shape == (3, 2)
    for place, factor in ((0, 1.0), (1, 180 / np.pi)):
        values = pose[..., place] * factor
        np.testing.assert_allclose(it.curves.mean[:, place], (weights * values).sum(axis=(0, 1)), rtol=1e-4, atol=1e-5)
        for share, ends in ((0.05, it.curves.q05), (0.95, it.curves.q95)):
            held = (weights * (values <= ends[:, place] + 1e-5)).sum(axis=(0, 1))
            assert np.abs(held - share).max() < weights.max() + 1e-9


def test_long_runs_are_thinned_evenly(inspect):
    it = inspect(frames=2 * MOST_POINTS + 1, draws=30)
    assert it.frames == range(0, 2 * MOST_POINTS + 1, 3) and len(it.curves.mean) == len(it.frames) <= MOST_POINTS


@pytest.mark.parametrize("frames", [1, 4, MOST_POINTS, MOST_POINTS + 1, 5 * MOST_POINTS + 3])
def test_bins_hold_every_frame_once(frames):
    found = bins(frames)
    assert len(found) <= MOST_POINTS
    assert [frame for piece in found for frame in range(piece.start, piece.stop)] == list(range(frames))


def test_a_spike_between_the_points_of_a_long_line_is_still_drawn():
    values = np.zeros((1, 5 * MOST_POINTS))
    values[0, 777] = 40.0
    _, axes = new_panel("spike", "frame", "one")
    draw_runs(axes, np.arange(values.shape[1]), values)
    (band,) = axes.collections
    assert band.get_paths()[0].vertices[:, 1].max() == 40.0
    assert np.asarray(axes.lines[0].get_ydata()).max() == 0


def test_limbs_and_names():
    dofs = ["root_x", "l_hip_y", "r_hip_y", "l_knee", "thorax_z", "r_elbow", "shoulder_x", "wing_flap"]
    groups = by_limb(dofs)
    assert groups == {
        "Left leg": [1, 3],
        "Right leg": [2],
        "Right arm": [5],
        "Arm": [6],
        "Trunk and head": [4],
        "Position and orientation of the whole body": [0],
        OTHER: [7],
    }
    assert (spoken("l_hip_y"), spoken("root_x"), limb("l_foot")) == ("left hip y", "root x", "Left leg")


@pytest.mark.parametrize(("runs", "draws"), [(2, 100), (4, 25)])
def test_of_agreeing_sets_of_runs_95_in_100_stay_in_the_rank_region(runs, draws):
    rng, sets = np.random.default_rng(99), 2000
    even = np.arange(1, draws) / draws
    height = rank_region(runs, draws) * np.sqrt(even * (1 - even))
    inside = 0
    for _ in range(sets):
        values = rng.normal(size=(runs, draws))
        ranks = (values[..., None] <= np.quantile(values, even, method="inverted_cdf")).mean(axis=1)
        inside += bool((np.abs(ranks - even) <= height + 1e-9).all())
    # Both the region and this count are simulated, of 500 and 2000 sets.
    assert abs(inside / sets - 0.95) < 4 * np.sqrt(0.95 * 0.05 * (1 / 500 + 1 / sets))


def test_equal_weight_draws_are_as_many_as_the_weights_are_worth_and_keep_the_mean(inspect):
    rng = np.random.default_rng(4)
    pose, log_weight = rng.normal(size=(2, 4000, 1, 2)), np.zeros((2, 4000, 1))
    log_weight[0, 100:] = -50.0
    it = inspect(frames=1, draws=4000, dofs=("root_x", "l_knee"), units=("m", "rad"), pose=pose, log_weight=log_weight)
    sample = equal_weight_sample(it, 0)
    assert sample.poses.shape == (2, 100, 2)
    mean = sample.poses[0].mean(axis=0) * [1, np.pi / 180]
    np.testing.assert_allclose(mean, pose[0, :100, 0].mean(axis=0), atol=1e-3)
    log_weight[0, 1:] = -50.0
    assert equal_weight_sample(inspect(frames=1, draws=4000, log_weight=log_weight), 0).poses.shape[1] == FEWEST_DRAWS
    assert equal_weight_sample(inspect(frames=1, draws=4000), 0).poses.shape[1] == MOST_DRAWS


def test_the_worst_frame_and_dofs_are_chosen(inspect):
    pose = 0.1 * np.random.default_rng(0).normal(size=(2, 200, 9, 5))
    pose[1, :, 6, 3] += 2.0
    it = inspect(frames=9, draws=200, pose=pose)
    assert chosen_frames(it) == [0, 6, 8] and chosen_dofs(it)[0] == 3
    widest = 0.1 * np.random.default_rng(0).normal(size=(1, 200, 9, 5))
    widest[..., 4] *= 5
    assert chosen_dofs(inspect(frames=9, runs=1, draws=200, pose=widest))[0] == 4


def test_a_figure_becomes_the_smaller_of_svg_and_png():
    rng = np.random.default_rng(0)
    with style():
        simple, axes = new_panel("A line", "frame", "m")
        axes.plot([0, 1])
        crowded, axes = new_panel("Points", "frame", "m")
        axes.scatter(*rng.normal(size=(2, 20_000)))
        kinds = [encoded(figure, "alt").uri.split(";")[0] for figure in (simple, crowded)]
    assert kinds == ["data:image/svg+xml", "data:image/png"]


def test_markup_escapes_what_is_not_markup():
    assert tag("p", "a < b & c", Markup("<b>d</b>"), title='"q"') == '<p title="&quot;q&quot;">a &lt; b &amp; c<b>d</b></p>'
    assert joined(["<", Markup("<hr>")]) == "&lt;\n<hr>"
    assert tag("pre", "a\x1b[1m\nb\0", title="\x07") == r'<pre title="\x07">a\x1b[1m' + "\n" + r"b\x00</pre>"


def test_the_command_repeats_the_run_into_another_folder(inspect):
    run = inspect().run
    words = shlex.split(command(run))
    assert words[:2] == ["bayes-body", "track"] and words[2] == run.settings["session"]
    options = dict(zip(words[3::2], words[4::2], strict=True))
    expected = {"--model": "arm", "--kernel": "sir", "--particles": "60", "--runs": "2", "--seed": "7"}
    assert options == expected | {"--out": f"{run.folder}_again"}


def test_a_definition_as_long_as_a_book_is_cut(inspect):
    run = dataclasses.replace(inspect().run, texts=inspect().run.texts | {"text": "x" * (2 * LONGEST)})
    text = provenance_section(run)
    assert text.count("x") < 1.1 * LONGEST and "cut after 200,000 characters of 400,000" in text


def test_a_number_and_its_unit_stand_on_one_line():
    assert tag("p", "54 % in 3 m, 7 mm <b>, 12 frames, 5 more") == "<p>54\u00a0% in 3\u00a0m, 7\u00a0mm &lt;b&gt;, 12 frames, 5 more</p>"
    assert joined(["1 s", "2 steps"]) == "1\u00a0s\n2 steps"
