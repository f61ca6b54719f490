"""R-hat and independent draws: as ArviZ computes them, seeing runs that disagree, and counting weights."""

import numpy as np
import pytest

from bayes_body.density.spaces import SE3, Plate, circle, numbered, space_to_text
from bayes_body.results.posterior import frame_rhat
from bayes_body.results.posterior.agreement import independent_draws, rhat_of_block
from bayes_body.results.posterior.blocks import Block, coordinate_blocks
from bayes_body.results.posterior.diagnostics import diagnose, sentences
from bayes_body.tracking.draws import FrameResult


def block(poses, log_weights=None) -> Block:
    if log_weights is None:
        log_weights = np.full(poses.shape[:3], -np.log(poses.shape[1]))
    return Block(range(poses.shape[2]), poses, log_weights)


@pytest.mark.parametrize("draws", [200, 201])
def test_r_hat_is_that_of_arviz(draws):
    from arviz_stats.base import array_stats

    rng = np.random.default_rng(0)
    poses = rng.normal(size=(3, draws, 2, 4))
    poses[0, :, 1, 2] += 0.7
    poses[1, :, 0, 3] *= 3.0
    # Few values: many draws share a rank.
    poses[..., 0] = poses[..., 0].round()
    found = rhat_of_block(block(poses))
    for frame, dof in np.ndindex(2, 4):
        # The draws come in another order, and where they are split is a matter of it.
        assert abs(found[frame, dof] - array_stats.rhat(poses[:, :, frame, dof], chain_axis=0, draw_axis=1)) < 0.02
    assert found[1, 2] > 1.05 and found[0, 3] > 1.05
    assert found[0, :3].max() < 1.03


def test_a_frame_s_figures_do_not_depend_on_its_block():
    rng = np.random.default_rng(1)
    poses, log_weights = rng.normal(size=(2, 50, 6, 3)), rng.normal(size=(2, 50, 6))
    whole = rhat_of_block(block(poses, log_weights))
    late = rhat_of_block(Block(range(4, 6), poses[:, :, 4:], log_weights[:, :, 4:]))
    assert np.array_equal(whole[4:], late)


def test_weights_alone_may_tell_runs_apart():
    rng = np.random.default_rng(2)
    poses = rng.normal(size=(4, 2000, 1, 2))
    assert rhat_of_block(block(poses)).max() < 1.01
    tilted = np.zeros((4, 2000, 1))
    tilted[0] = 2.0 * poses[0, :, :, 0]
    found = rhat_of_block(block(poses, tilted))
    assert found[0, 0] > 1.1 and found[0, 1] < 1.02


def test_no_r_hat_of_one_run_or_of_what_never_moves():
    poses = np.random.default_rng(3).normal(size=(2, 20, 1, 2))
    poses[..., 1] = 4.0
    found = rhat_of_block(block(poses))
    assert np.isfinite(found[0, 0]) and np.isnan(found[0, 1])
    assert np.isnan(rhat_of_block(block(poses[:1]))).all()
    assert np.isnan(independent_draws(block(poses[:1]))).all()
    assert np.isnan(independent_draws(block(np.ones((2, 20, 1, 2))))).all()


@pytest.mark.parametrize("copies", [1, 10])
def test_copies_count_once(copies):
    rng = np.random.default_rng(4)
    distinct, runs, dofs = 40, 8, 60
    poses = np.repeat(rng.normal(size=(runs, distinct, 1, dofs)), copies, axis=1)
    found = independent_draws(block(poses))[0]
    # Each dof's share is distributed as χ²(runs - 1) / (runs - 1): relative sd sqrt(2 / 7), the mean of 60 of them.
    assert abs(found / distinct - 1) < 4 * np.sqrt(2 / (runs - 1) / dofs) + 2 / distinct


def test_runs_that_stand_apart_are_worth_one_draw():
    poses = np.random.default_rng(5).normal(size=(4, 500, 1, 10)) * 1e-3 + np.arange(4.0)[:, None, None, None]
    # Their own spread is nothing: each run is one draw, of a variance estimated with divisors 4 above and 3 below.
    assert np.isclose(independent_draws(block(poses))[0], 3 / 4, atol=0.01)


def test_r_hat_is_that_of_the_run_s_own_summary():
    rng = np.random.default_rng(6)
    poses, log_weights = rng.normal(size=(3, 100, 4, 5)), rng.normal(size=(3, 100, 4))
    found = rhat_of_block(block(poses, log_weights))
    for frame in range(4):
        # R-hat reads neither figures nor times.
        result = FrameResult({"pose": poses[:, :, frame]}, log_weights[:, :, frame], None, np.ones(1, bool), 0.0)
        assert np.allclose(frame_rhat(result, frame, "pose", numbered("pose", (5,))), found[frame])


def yaw_tree(make_tree, angles, space=None):
    """A tree of one angle, whose runs are given in degrees: (run, draw, frame)."""
    runs, draws, frames = angles.shape
    tree = make_tree(runs=runs, draws=draws, frames=frames, dofs=("yaw",), pose=np.radians(angles)[..., None])
    if space is not None:
        tree["posterior"]["pose"].attrs["space"] = space_to_text(space)
    return tree


def test_runs_on_both_sides_of_the_half_turn_agree(make_tree):
    rng = np.random.default_rng(7)
    around = 180 + rng.normal(0.0, 3.0, size=(2, 400, 1))
    # The first run counts the other way round, and half of the second has a turn more.
    angles = around - 360.0 * np.array([1, 0])[:, None, None] + 360.0 * (np.arange(400) % 2)[:, None] * np.array([0, 1])[:, None, None]
    tree = yaw_tree(make_tree, angles, circle(("yaw",), "dof"))
    found = diagnose(tree)
    assert found.dofs == ("yaw",) and found.rhat.max() < 1.02 and found.independent_draws[0] > 5
    assert not any("disagree" in sentence for sentence in sentences(found))
    (block,) = coordinate_blocks(tree)
    assert abs(np.cos(block.poses.mean()) + 1) < 1e-3 and np.degrees(block.poses.std()) == pytest.approx(3.0, abs=0.3)
    # As plain numbers, which a posterior without a space has, they are far apart.
    plain = diagnose(yaw_tree(make_tree, angles))
    assert plain.rhat.max() > 1.3 and plain.independent_draws[0] < 2


def test_runs_that_stand_apart_on_the_circle_are_seen(make_tree):
    angles = np.random.default_rng(8).normal(0.0, 3.0, size=(2, 400, 1)) + np.array([170.0, -170.0])[:, None, None]
    assert diagnose(yaw_tree(make_tree, angles, circle(("yaw",), "dof"))).rhat.max() > 1.3


def test_a_body_of_parts_has_an_r_hat_for_each_coordinate(make_tree):
    rng, space = np.random.default_rng(9), Plate(("torso", "head"), SE3("coordinate"), "part")
    centre = np.tile([0.0, 0, 1, 0, 0, 0, 1], (2, 1))
    tangents = rng.normal(0.0, 0.1, size=(3, 400, 2, 12))
    tangents[0, :, :, space.tangent_labels.index("head_rz")] += 0.3
    points = space.retract(centre, tangents)
    points[..., 3:] *= rng.choice([-1.0, 1.0], size=(*points.shape[:-1], 1))
    tree = make_tree(frames=2)
    arrays = tree["posterior"].to_dataset().drop_vars(["pose", "dof"])
    arrays["parts"] = (("chain", "draw", "frame", "part", "coordinate"), points, {"space": space_to_text(space)})
    arrays["parts_before"] = arrays["parts"] * 0
    tree["posterior"] = tree["posterior"].from_dict({"/": arrays})
    found = diagnose(tree)
    assert found.dofs == space.tangent_labels and found.rhat.shape == (2, 12)
    apart = found.rhat > 1.1
    assert apart[:, space.tangent_labels.index("head_rz")].all() and apart.sum() == 2
