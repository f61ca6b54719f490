"""`bb.track` from a script: the model's own kernel, settings that are left out, and the warnings of the command line."""

import dataclasses
import inspect
import warnings

import jax
import numpy as np
import pytest

import bayes_body as bb
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.runs.track import settings_left_out

KEY = jax.random.key(0)
# Of the definition; the kernel's own defaults are others.
PARTICLES, RESAMPLING = 60, "multinomial"


@pytest.fixture(scope="module")
def definition():
    """The arm, with its own settings of the particle filter."""
    arm = load_definition("arm")
    kernel = f'kind = "sir"\nparticles = {PARTICLES}\nresampling = "{RESAMPLING}"\n'
    text = arm.text.replace('kind = "sir"\nparticles = 2000\n', kernel)
    assert text != arm.text
    return parse_definition("arm", text, arm.body_text)


@pytest.fixture(scope="module")
def model(definition, textured_session):
    return build_model(definition, textured_session)


@pytest.fixture(scope="module")
def tracked(textured_session, model):
    """Draws of the model's own kernel, and what was shown."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        draws = bb.track(KEY, textured_session, model, runs=2)
    return draws, [str(each.message) for each in shown if each.category is bb.RunWarning]


@pytest.mark.filterwarnings("ignore::bayes_body.base.errors.RunWarning")
def test_without_a_kernel_the_definition_s_is_used_with_all_its_settings(textured_session, model, tracked):
    draws, _ = tracked
    assert (draws.kernel, draws.particles) == ("sir", PARTICLES)
    with pytest.warns(
        bb.RunWarning, match=rf"leaves out settings of the model 'arm': resampling is 'systematic', not '{RESAMPLING}'; use model\.kernel"
    ):
        defaults = bb.track(KEY, textured_session, model, bb.kernels.sir(), PARTICLES, runs=2)
    meant = bb.track(KEY, textured_session, model, bb.kernels.sir(RESAMPLING), PARTICLES, runs=2)
    evidence = [np.asarray(each.info.log_evidence).sum(axis=1) for each in (draws, defaults, meant)]
    assert (evidence[0] == evidence[2]).all() and (evidence[0] != evidence[1]).all()


def test_the_warnings_are_shown_and_kept(tracked):
    draws, shown = tracked
    assert shown == list(draws.warnings) and any("effective particles of 60" in sentence for sentence in shown)


@pytest.mark.slow
def test_the_warnings_are_those_of_the_command_line(textured_session, definition, tracked, tmp_path):
    session = dataclasses.replace(textured_session, folder=tmp_path / "session")
    bb.save_session(session)
    for view in session.views:
        (session.folder / view.camera.name).symlink_to(textured_session.folder / view.camera.name)
    (tmp_path / "arm.toml").write_text(definition.text, encoding="utf-8")
    lines = []
    with warnings.catch_warnings():
        # Nothing is said twice.
        warnings.simplefilter("error", bb.RunWarning)
        summary = run(Settings(session.folder, tmp_path / "run", str(tmp_path / "arm.toml"), runs=2), lines.append, bar=False)
    assert summary["warnings"] == list(tracked[0].warnings) and f"warning     {summary['warnings'][-1]}" in lines


def test_what_is_left_out_is_named_unless_it_is_meant(model, textured_session):
    assert settings_left_out(model, model.kernel()) == settings_left_out(model, bb.kernels.annealed()) == ""
    assert "particles is 4000, not 60" in settings_left_out(model, bb.kernels.sir(RESAMPLING))
    assert settings_left_out(model, bb.kernels.sir(RESAMPLING), particles=10) == ""
    smc = build_model("silhouettes", textured_session)
    sentence = settings_left_out(smc, bb.kernels.tempered(moves=3, particles=10))
    assert "prediction is 'particles', not 'gaussian'" in sentence and "moves is" not in sentence and "particles is" not in sentence


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (lambda *given: given[1:4] + given[:1], r"track: key: a Session; expected a random key; write track\(key, session, model, kernel=None"),
        (lambda key, session, model, kernel: (0, session, model), "track: key: a int; expected a random key"),
        (lambda key, session, model, kernel: (key, model, session), "track: session: a Model; expected a Session"),
        (lambda key, session, model, kernel: (key, session, model, "sir"), r"track: kernel: 'sir'; expected a kernel; write model\.kernel\(\)"),
    ],
    ids=["the old order", "a seed", "the model first", "a name"],
)
def test_another_order_of_the_arguments_is_refused_with_the_right_one(textured_session, model, arguments, said):
    # Without the tests' checks of types, which users do not have.
    track = inspect.unwrap(bb.track)
    with pytest.raises(bb.InputError, match=said):
        track(*arguments(KEY, textured_session, model, bb.kernels.sir()))


def test_smoothing_from_a_script_gives_paths_and_refuses_a_mode_seeker(textured_session, tracked):
    draws, _ = tracked
    paths = bb.smooth(KEY, textured_session, draws, draws=20, moves=0)
    assert len(paths.frames) == len(draws.frames) and paths.particles == 20 and paths.runs == 2
    tree = bb.to_datatree(paths)
    assert bb.diagnose(tree).smoothed and not bb.diagnose(tree).mode_seeker
    # Of equal weight, and connected: each state is one of the filter's, or near one.
    assert np.ptp(paths.log_weights) == 0 and np.isfinite(paths.states["pose"]).all()
    with pytest.raises(bb.InputError, match="their kernel seeks modes"):
        bb.smooth(KEY, textured_session, dataclasses.replace(draws, declared_sample=False))
