"""The scale of a likelihood: closed forms, refusals, and a small simulated recording through the command line."""

import dataclasses
import json

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.model.definition import load_definition
from bayes_body.workshop.calibration.replications import ReplicationLog
from bayes_body.workshop.learning import likelihood_scale
from bayes_body.workshop.learning.likelihood_scale import Trial, choose_scale, pooled, trials, with_scale


def trial(scale, inside, known=100):
    return Trial("walk", scale, inside, known, 40.0, 0.8, 500.0)


def test_recordings_are_pooled_by_what_they_know():
    scales, coverage = pooled([trial(8.0, 50), trial(2.0, 90), trial(2.0, 300, 300), trial(8.0, 250, 300)])
    assert scales.tolist() == [2.0, 8.0]
    assert np.allclose(coverage, [390 / 400, 300 / 400])


def test_the_scale_is_where_the_line_crosses_the_level():
    # 0.95 at 2, 0.85 at 8: the middle, on a logarithmic axis.
    assert np.isclose(choose_scale(np.array([1.0, 2.0, 8.0]), np.array([0.97, 0.95, 0.85])), 4.0)
    # Noise may cross twice; the sharpest posterior that is honest is wanted.
    assert np.isclose(choose_scale(np.array([1.0, 2.0, 4.0, 8.0, 16.0]), np.array([0.95, 0.89, 0.91, 0.95, 0.85])), 8 * 2**0.5)


def test_where_no_scale_is_honest_the_most_honest_is_taken():
    assert choose_scale(np.array([4.0, 8.0, 16.0]), np.array([0.8, 0.85, 0.7])) == 8
    # Of two that are as honest, the sharper one.
    assert choose_scale(np.array([4.0, 8.0, 16.0]), np.array([0.86, 0.85, 0.7])) == 8


def test_scales_that_do_not_reach_the_level_say_where_to_go():
    with pytest.raises(InputError, match="try smaller ones"):
        choose_scale(np.array([8.0, 16.0]), np.array([0.7, 0.6]))
    with pytest.raises(InputError, match="try larger ones"):
        choose_scale(np.array([1.0, 2.0]), np.array([0.99, 0.95]))


def test_the_scale_is_the_only_change():
    definition = load_definition("silhouettes")
    changed = with_scale(definition, 3.5)
    (before,), (after,) = definition.likelihoods, changed.likelihoods
    assert after.options.precision == 3.5
    assert after.options.model_copy(update={"precision": before.options.precision}) == before.options
    assert changed.kernel == definition.kernel and definition.likelihoods[0].options.precision != 3.5


def test_a_likelihood_without_a_scale_is_refused():
    with pytest.raises(InputError, match="0 likelihoods with a precision"):
        with_scale(load_definition("keypoints"), 1.0)


def test_a_recording_without_a_truth_is_refused(textured_session):
    with pytest.raises(InputError, match="no truth"):
        next(trials([textured_session], load_definition("silhouettes"), [1.0], None, 10))


def test_trials_that_were_made_are_not_made_again(textured_session, tmp_path, monkeypatch):
    sessions, made = [dataclasses.replace(textured_session, truth="truth.npz")] * 2, []

    def one(session, model, scale, *rest):
        made.append(scale)
        return trial(scale, len(made))._replace(recording=session.title)

    monkeypatch.setattr(likelihood_scale, "_trial", one)
    arguments = (sessions, load_definition("arm"), [1.0, 2.0], None, 10, 0, None)
    begun = trials(*arguments, ReplicationLog(tmp_path / "t.partial", {"seed": 0}))
    first = [next(begun) for _ in range(3)]
    again = list(trials(*arguments, ReplicationLog(tmp_path / "t.partial", {"seed": 0})))
    assert made == [1.0, 2.0, 1.0, 2.0]
    assert again[:3] == first and [each.inside for each in again] == [1, 2, 3, 4]


@pytest.mark.parametrize("scales", ["3", "1,two", "1,-2", "1,inf"])
def test_scales_that_are_none_are_refused(scales, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["learn", "likelihood-scale", str(tmp_path), "--scales", scales])
    assert stopped.value.code == 2
    assert f"--scales: {scales!r}; expected two or more numbers above 0" in capsys.readouterr().err


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated") / "stranger"
    with pytest.raises(SystemExit):
        main(["simulate", "walk", "--rig", "room_4", "--subject", "41", "--seed", "5", "--frames", "3", "--out", str(folder)])
    return folder


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_what_the_command_finds_is_what_its_trials_say(recording, tmp_path, capsys):
    out = tmp_path / "scale.json"
    command = ["learn", "likelihood-scale", str(recording), "--kernel", "sir", "--particles", "400", "--scales", "0.01,1000", "--json", str(out)]
    with pytest.raises(SystemExit) as stopped:
        main(command)
    told = capsys.readouterr().out
    assert stopped.value.code == 0, told
    figures = json.loads(out.read_text())
    soft, sharp = figures["trials"]
    # The prior alone holds the truth; a likelihood so sharp that one particle is left, hardly ever.
    assert soft["inside"] / soft["known"] > 0.9 > 0.3 > sharp["inside"] / sharp["known"]
    assert soft["known"] == 3 * 15 * 3 and soft["ess"] > 100 > sharp["ess"]
    assert 0.01 < figures["precision"] < 1000 and f"precision = {figures['precision']:.3g}" in told
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_a_mode_seeker_is_refused(recording, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["learn", "likelihood-scale", str(recording), "--model", "deutscher_2005", "--particles", "50", "--scales", "1,2", "--frames", "1"])
    assert stopped.value.code == 2
    assert "a mode seeker; expected a kernel whose particles are draws from the posterior" in capsys.readouterr().err
