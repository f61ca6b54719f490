"""An activity from captured motion: what was put in is found, several activities are kept apart, and bad input is a sentence."""

import jax
import numpy as np
import pytest
import tomlkit

from bayes_body.base.errors import InputError
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.cli.learn_motion import labelled
from bayes_body.cli.main import main
from bayes_body.model.body.build import build_body
from bayes_body.model.definition import load_body
from bayes_body.model.dynamics.activity import load_activity, save_activity
from bayes_body.recording.readers.mocap import read_motion, resample
from bayes_body.workshop.learning import activity_motions
from bayes_body.workshop.learning.activity_hmm import LEAST_DEG, LearnOptions, angles_for, emitted, learn_activity, log_likelihood_ratio
from bayes_body.workshop.learning.activity_motions import Captured, captured, learned_dofs, no_walk
from bayes_body.workshop.learning.baum_welch import Hmm, fit, log_likelihood, padded
from bayes_body.workshop.learning.hmm_choice import Track, choose, shares_of, starts, stationary

BODY, FRAMES = "person_31", 120
OPTIONS = LearnOptions(components=2, states=6, restarts=1)
TEST_SUBJECTS = {"35", "38", "39", "06"}


@pytest.fixture(scope="module")
def schema():
    return load_body(BODY)


@pytest.fixture(scope="module")
def topology(schema):
    return build_body(BODY, schema).skeleton.topology


@pytest.fixture(scope="module")
def planted(topology):
    """A plane of learned angles, and the mean pose of each of three people."""
    rng = np.random.default_rng(0)
    places = learned_dofs(topology)
    basis = np.linalg.qr(rng.normal(size=(len(places), 2)))[0]
    return places, basis, dict(zip("abc", 0.1 * rng.normal(size=(3, len(places))), strict=True))


def _motion(planted, topology, name, subject, label="walk", period=40.0, radius=(0.5, 0.3), seed=0):
    """An ellipse in the planted plane, with noise; the root turns and moves on, and the head turns."""
    places, basis, means = planted
    rng = np.random.default_rng([seed, *map(ord, name)])
    phase = 2 * np.pi * (np.arange(FRAMES) / period + rng.uniform())
    features = np.stack([radius[0] * np.cos(phase), radius[1] * np.sin(phase)], axis=1) + 0.02 * rng.normal(size=(FRAMES, 2))
    dofs = np.zeros((FRAMES, len(topology.dof_names)))
    dofs[:, places] = means[subject] + features @ basis.T + 0.002 * rng.normal(size=(FRAMES, len(places)))
    dofs[:, 0], dofs[:, 3] = 0.02 * np.arange(FRAMES), (0.05 * np.arange(FRAMES) + np.pi) % (2 * np.pi)
    dofs[:, topology.dof_names.index("head_y")] = 0.3 * (np.arange(FRAMES) % 2)
    return Captured(name, subject, label, dofs)


@pytest.fixture(scope="module")
def walks(planted, topology):
    return [_motion(planted, topology, f"{person}{k}", person) for person in "abc" for k in range(2)]


@pytest.fixture(scope="module")
def found(walks, schema):
    return learn_activity(walks, BODY, schema, OPTIONS)


@pytest.mark.slow
def test_the_subspace_that_was_put_in_is_found(found, planted, topology, walks):
    activity, (places, basis, _) = found.activity, planted
    assert len(places) == 22 and activity.names == tuple(topology.dof_names[k] for k in places)
    assert activity.subjects == ("a", "b", "c") and activity.labels == ("walk",) * 6 and activity.fps == 60
    assert activity.kept > 0.99 and np.abs(activity.basis @ activity.basis.T - basis @ basis.T).max() < 0.01
    expected = np.stack([np.concatenate([walk.dofs[:, places] for walk in walks if walk.subject == person]).mean(axis=0) for person in "abc"])
    np.testing.assert_allclose(activity.means, expected, atol=1e-9)
    np.testing.assert_allclose(activity.between, expected.std(axis=0, ddof=1), atol=1e-9)
    np.testing.assert_allclose(activity.centre, 0, atol=1e-9)
    # The noise is less than half a degree.
    np.testing.assert_allclose(activity.residual, np.radians(LEAST_DEG))
    angles = np.concatenate([walk.dofs[:, places] for walk in walks])
    np.testing.assert_allclose([activity.low, activity.high], [angles.min(axis=0), angles.max(axis=0)])
    assert not found.sentences


@pytest.mark.slow
def test_changes_are_of_all_dofs_and_not_by_full_turns(found, topology):
    change = dict(zip(topology.dof_names, found.activity.change, strict=True))
    assert change["root_x"] == pytest.approx(0.01) and change["head_y"] == pytest.approx(0.15)
    assert change[topology.dof_names[3]] == pytest.approx(0.025)


@pytest.mark.slow
def test_the_model_explains_motion_held_out(found, walks, topology):
    # Six states around an ellipse explain more than one Gaussian does, whose density here is about that of training.
    places = learned_dofs(topology)
    features = np.concatenate([(walk.dofs[:, places] - walk.dofs[:, places].mean(axis=0)) @ found.activity.basis for walk in walks])
    one = Hmm(np.ones(1), np.ones((1, 1)), features.mean(axis=0)[None], np.cov(features.T)[None])
    assert found.held_out > log_likelihood(one, padded([features]))[0] / len(features) + 1
    assert found.held_out < found.training < found.held_out + 1
    np.testing.assert_allclose(found.activity.initial, 1 / 6)
    np.testing.assert_allclose(found.activity.transition.sum(axis=1), 1)


@pytest.mark.slow
def test_turns_and_second_solutions_are_no_variation(walks, found, schema, topology):
    y, x, z = (topology.dof_names.index(f"l_shoulder_{axis}") for axis in "yxz")
    other = walks[3].dofs.copy()
    other[:, [y, x, z]] = np.stack([other[:, y] + np.pi, np.pi - other[:, x], other[:, z] - np.pi], axis=1)
    other[:, topology.dof_names.index("r_knee")] += 2 * np.pi
    same = learn_activity([*walks[:3], walks[3]._replace(dofs=other), *walks[4:]], BODY, schema, OPTIONS).activity
    np.testing.assert_allclose(same.means, found.activity.means, atol=1e-6)
    np.testing.assert_allclose(angles_for(found.activity, other, topology), walks[3].dofs[:, learned_dofs(topology)], atol=1e-5)


@pytest.mark.slow
def test_the_start_is_chosen_by_motion_held_out():
    rng = np.random.default_rng(1)
    tracks = [Track(person, np.cumsum(rng.normal(size=(60, 2)), axis=0) % 3) for person in "aab"]
    # Padded to three motions as `choose` does, so that programs are shared.
    seeds, scores = (5, 6, 7), []
    for seed in seeds:
        held = 0.0
        for learned, other in (((0, 1), (2,)), ((2,), (0, 1))):
            data = [tracks[k].features for k in learned]
            hmm = Hmm(*(part[0] for part in fit(starts(np.concatenate(data), 3, (seed,)), padded(data, 3)).hmm))
            held += log_likelihood(hmm, padded([tracks[k].features for k in other], 3)).sum()
        scores.append(held / 180)
    found = choose(tracks, 3, seeds)
    assert found.held_out == pytest.approx(max(scores), abs=1e-6) and found.seed == seeds[int(np.argmax(scores))]
    assert found.of_motion.mean() == pytest.approx(found.held_out)
    # The same seed alone gives the same model, learned from all motions.
    alone = choose(tracks, 3, (found.seed,))
    np.testing.assert_allclose(alone.hmm.locations, found.hmm.locations, atol=1e-8)
    everything = padded([track.features for track in tracks])
    assert found.training == pytest.approx(log_likelihood(found.hmm, everything).sum() / 180)


def test_one_person_is_no_error_but_a_sentence(walks, schema):
    found = learn_activity([walk._replace(subject="a") for walk in walks], BODY, schema, OPTIONS)
    assert found.sentences == ("only one person (a): how the mean poses of people differ is not known",)
    assert not found.activity.between.any() and np.isfinite(found.held_out)


def test_for_one_person_the_last_fifth_is_held_out():
    track = Track("a", np.random.default_rng(2).normal(size=(60, 2)))
    found = choose([track], 3, (0,))
    first, last = track.features[:48], track.features[48:]
    hmm = Hmm(*(part[0] for part in fit(starts(first, 3, (0,)), padded([first])).hmm))
    assert found.held_out == pytest.approx(log_likelihood(hmm, padded([last]))[0] / 12, abs=1e-6)


def test_a_motion_that_does_not_belong_is_told(walks, planted, topology, schema):
    far = _motion(planted, topology, "c9", "c", radius=(3.0, 3.0))
    (told,) = learn_activity([*walks[:5], far], BODY, schema, OPTIONS).sentences
    assert told.startswith("c9: ") and told.endswith("nats a frame less likely than the other motions of 'walk': perhaps another activity")


@pytest.mark.slow
def test_several_activities_have_models_of_their_own(walks, planted, topology, schema):
    runs = [_motion(planted, topology, f"{person}9", person, "run", 25.0, (0.2, 0.8)) for person in "abc"]
    options = OPTIONS._replace(states=8, switch_per_s=0.6)
    activity = learn_activity([*walks[2:], *runs], BODY, schema, options).activity
    assert activity.labels == ("walk",) * 4 + ("run",) * 4
    A = activity.transition
    np.testing.assert_allclose(A.sum(axis=1), 1)
    # A hundredth a frame, to where the other activity is on average.
    np.testing.assert_allclose(A[:4, 4:].sum(axis=1), 0.01)
    np.testing.assert_allclose(A[:4, 4:], np.tile(0.01 * stationary(A[4:, 4:] / 0.99), (4, 1)), atol=1e-12)
    np.testing.assert_allclose(activity.initial, 1 / 8)


def test_states_are_shared_in_proportion_to_frames():
    assert shares_of({"walk": 3000, "run": 1000}, 20) == {"walk": 15, "run": 5}
    assert shares_of({"walk": 3000, "run": 100}, 20) == {"walk": 16, "run": 4}
    assert shares_of({"walk": 300}, 2) == {"walk": 2}


def test_too_little_motion_is_a_sentence(walks, schema):
    with pytest.raises(InputError, match="'walk': 720 frames for 100 states; expected at least 10 frames a state; learn fewer states, or give more"):
        learn_activity(walks, BODY, schema, OPTIONS._replace(states=100))
    with pytest.raises(InputError, match="'run': 30 frames for 4 states"):
        shares_of({"walk": 3000, "run": 30}, 20)
    with pytest.raises(InputError, match="states: 7 for 2 activities; expected at least 4 for each"):
        shares_of({"walk": 3000, "run": 3000}, 7)
    with pytest.raises(InputError, match="the motions: none; expected at least one"):
        learn_activity([], BODY, schema, OPTIONS)
    with pytest.raises(InputError, match="components: 23; expected 1 to 22"):
        learn_activity(walks, BODY, schema, OPTIONS._replace(components=23))
    with pytest.raises(InputError, match="all frames alike; expected motion"):
        learn_activity([Captured("still", "a", "walk", np.zeros((60, 31)))], BODY, schema, OPTIONS)


def test_frames_are_not_invented(cmu_mocap, schema):
    motion = resample(read_motion(cmu_mocap / "02" / "02_01.amc"), 30.0)
    with pytest.raises(InputError, match="02_01: 30 frames a second; expected 60 or more; leave it out, or learn at 30"):
        captured("02_01", "02", "walk", motion, BODY, schema, 60.0)


def test_what_is_emitted_has_the_moments_of_the_model(found):
    activity = found.activity
    drawn = emitted(activity, 6000, jax.random.key(1))
    np.testing.assert_array_equal(drawn, emitted(activity, 6000, jax.random.key(1)))
    features = (drawn - activity.means.mean(axis=0)) @ activity.basis
    weights = stationary(activity.transition)
    mean = weights @ activity.locations
    away = activity.locations - mean
    covariance = np.einsum("n,nij->ij", weights, activity.covariances + away[:, :, None] * away[:, None])
    assert np.abs(features.mean(axis=0) - mean).max() < 0.03
    assert np.abs(np.cov(features.T) - covariance).max() < 0.02


def test_another_activity_is_less_likely(found, planted, topology):
    ratios = []
    for radius in ((0.5, 0.3), (0.3, 0.6), (1.0, 1.0)):
        motion = _motion(planted, topology, "new", "b", seed=4, radius=radius)
        ratios.append(log_likelihood_ratio(found.activity, angles_for(found.activity, motion.dofs, topology)))
    assert abs(ratios[0]) < 0.5 and ratios[1] < -3 and ratios[2] < ratios[1] - 3


def test_a_file_holds_it(found, tmp_path):
    save_activity(found.activity, tmp_path / "mine.npz")
    read = load_activity(tmp_path / "mine.npz")
    assert (read.names, read.labels, read.subjects, read.fps) == (found.activity.names, found.activity.labels, ("a", "b", "c"), 60.0)
    np.testing.assert_allclose(read.covariances, found.activity.covariances, rtol=1e-6)


def test_the_activity_that_ships_is_a_walk(topology):
    activity, folder = load_activity(), definitions_folder() / "learned"
    assert activity.body == BODY and len(activity.names) == 22 and set(activity.labels) == {"walk"} and len(activity.labels) == 30
    assert not TEST_SUBJECTS & set(activity.subjects) and len(activity.subjects) == 5
    # Darby et al.: 92 % for three people.
    assert 0.9 < activity.kept < 0.94 and activity.basis.shape == (22, 4) and activity.fps == 60
    assert (folder / "walking_hmm.npz").stat().st_size < 100_000
    told = tomlkit.parse((folder / "walking_hmm.toml").read_text())
    assert "$BAYES_BODY_DATA/cmu_mocap/16 " in str(told["command"]) and len(told["motions"]) == 28
    own = log_likelihood_ratio(activity, emitted(activity, 300, jax.random.key(3)))
    assert abs(own) < 1.5


def test_runs_are_no_walks(cmu_mocap):
    run, short = (read_motion(cmu_mocap / name[:2] / f"{name}.amc") for name in ("02_03", "35_01"))
    assert no_walk("02_03", run) == "02_03: 2.6 m/s is a run: left out"
    # An activity needs no whole stride.
    assert no_walk("35_01", short) is None


def test_labels_stand_before_a_path(tmp_path):
    assert labelled("run=02/02_03.amc").label == "run" and str(labelled("run=02/02_03.amc").path) == "02/02_03.amc"
    assert labelled("02/02_03.amc").label is None
    (tmp_path / "a=b.amc").write_text("")
    assert labelled(str(tmp_path / "a=b.amc")).label is None


def _run(words, status, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["learn", "activity-hmm", *words])
    assert stopped.value.code == status
    said = capsys.readouterr()
    return (said.out if status == 0 else said.err).replace("\n", " ")


def test_the_command_writes_an_activity_and_its_source(cmu_mocap, tmp_path, capsys, monkeypatch, planted, topology):
    def ready(name, subject, label, *_):
        return _motion(planted, topology, name, {"02": "a", "05": "b"}[subject], label, radius=(0.5, 0.3) if label == "walk" else (0.2, 0.8))

    monkeypatch.setattr(activity_motions, "captured", ready)
    out, run = tmp_path / "mine.npz", cmu_mocap / "02" / "02_03.amc"
    options = ["--states", "8", "--components", "2", "--restarts", "1", "--source", "CMU", "--out", str(out)]
    said = _run([str(cmu_mocap / "02"), str(cmu_mocap / "05" / "05_01.amc"), f"run={run}", *options], 0, capsys)
    assert "02_03: 2.6 m/s is a run: left out" in said and "8 states from 480 frames of 4 motions of 2 people; 2 features keep" in said
    told = tomlkit.parse(out.with_suffix(".toml").read_text())
    assert told["motions"] == ["02_01", "02_02", "05_01", "02_03"] and told["source"] == "CMU" and told["states"] == [4, 4]
    words = "$BAYES_BODY_DATA/cmu_mocap/02 $BAYES_BODY_DATA/cmu_mocap/05/05_01.amc run=$BAYES_BODY_DATA/cmu_mocap/02/02_03.amc"
    assert told["command"] == f"bayes-body learn activity-hmm {words} --components 2 --states 8 --restarts 1 --out mine.npz"
    assert load_activity(out).labels == ("walk",) * 4 + ("run",) * 4


def test_the_command_refuses_before_it_works(cmu_mocap, tmp_path, capsys):
    walk, out = str(cmu_mocap / "02" / "02_01.amc"), tmp_path / "mine.npz"
    (tmp_path / "there.npz").write_bytes(b"")
    assert "already exists" in _run([walk, "--out", str(tmp_path / "there.npz")], 2, capsys)
    assert "a file that ends in .npz" in _run([walk, "--out", str(tmp_path / "mine.zip")], 2, capsys)
    assert "02_01.amc: 120 frames a second; expected 240 or more" in _run([walk, "--fps", "240", "--out", str(out)], 2, capsys)
    assert "the motions: none" in _run([str(cmu_mocap / "02" / "02_03.amc"), "--out", str(out)], 2, capsys)
    assert not out.exists()


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_the_command_learns_from_a_real_walk(cmu_mocap, tmp_path, capsys):
    said = _run([str(cmu_mocap / "02" / "02_01.amc"), "--states", "8", "--out", str(tmp_path / "mine.npz")], 0, capsys)
    assert "only one person (02)" in said and "8 states from 172 frames of 1 motions of 1 people" in said
    assert load_activity(tmp_path / "mine.npz").kept > 0.9
