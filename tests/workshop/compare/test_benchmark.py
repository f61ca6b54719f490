"""Every kernel on every definition, generated from the registry and the definitions' folder: one that is added is here without an edit."""

import json
import re
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_terms import plugins_of_this_test

from bayes_body.base import registry
from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.observation.frames import read_frame
from bayes_body.workshop.compare import Row, Scene, Scenes, Settings, benchmark_rows, pairs
from bayes_body.workshop.compare.benchmark import FIGURES, followed, measured, options_of
from bayes_body.workshop.compare.scenes import not_generative

TINY = Settings(frames=2, most_particles=12)
# One sentence: found, expected, remedy.
NO_NODES = r"^the kernel 'particle_bp': [^\n]+; expected [^\n]+; give the body the placement \"parts\"[^\n]+\."
NO_GAUSSIAN = r"^the kernel laplace: [^\n]+; expected [^\n]+; use --kernel tempered\."
SENTENCE = re.compile(r"^[^\n]+; expected [^\n]+; [^\n]+\.$")


class TinyScenes(Scenes):
    """Data drawn from the model where its likelihoods are distributions, else images of drifting blobs: so that every view is tried."""

    def __init__(self, folder, session):
        super().__init__(folder, TINY.frames)
        self.blobs = session

    def _make(self, definition):
        model = build_model(definition, self.blobs)
        return Scene(self.blobs, model, "blobs") if not_generative(model) else self._drawn(definition)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory, keypoint_session):
    return TinyScenes(tmp_path_factory.mktemp("scenes"), keypoint_session)


def _lacks_nodes(pair, model) -> bool:
    """Whether message passing finds no graph: the body is not placed by its parts."""
    return pair.kernel == "particle_bp" and model.body.variable != "parts"


def _lacks_gaussian(pair, model) -> bool:
    """Whether the prediction cannot be one Gaussian: a frame depends on more than the sampled variables of the frame before."""
    return pair.kernel == "laplace" and (model.reads_before or model.transition.frames_read != 1)


def _follows_gradients(pair, options) -> bool:
    return pair.kernel in ("hmc", "laplace") or getattr(options, "move", None) == "hmc"


ALL = list(pairs())


@pytest.fixture(scope="module")
def frame_densities(keypoint_session):
    """`frame_densities("arm")`: a model, its particles before the first frame, and the density of that frame."""

    @cache
    def made(name):
        model = build_model(name, keypoint_session)
        start = model.start(TINY.most_particles)
        return model, start, model.density(model.observe(read_frame(keypoint_session, 0)), start)

    return made


def _form(tree):
    """Tree, shapes and types: arguments of one form go through one compiled program."""
    leaves, structure = jax.tree.flatten(jax.eval_shape(lambda tree: tree, tree))
    return structure, [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in leaves]


def _check_refusal(error, blind):
    # JAX adds a note of its own to what leaves a trace; the sentence is the message.
    assert SENTENCE.match(str(error.value)) and f"'{blind}' has no gradient" in str(error.value)


# With the terms, the motion prior and the kernel of another definition.
LIKE_ANOTHER = ("darby_2008_monocular", "poon_fleet_2002", "silhouettes")

# Read while tests are collected, for each kernel.
_kind = cache(lambda model: load_definition(model).kernel.kind)


def _tier(pair):
    """The arms with every kernel, other bodies with their own. The gradients of bodies of parts, with 60 variables or more, take long to trace."""
    own = pair.kernel == _kind(pair.model) and not pair.model.startswith("sigal") and pair.model not in LIKE_ANOTHER
    gradients_of_image_motion = pair == ("sidenbladh_2000_arm", "hmc")
    return pytest.mark.slow if own or pair.model.startswith("arm") or gradients_of_image_motion else pytest.mark.long


@pytest.mark.parametrize("pair", [pytest.param(pair, id=f"{pair.model}-{pair.kernel}", marks=_tier(pair)) for pair in ALL])
def test_every_kernel_is_traced_on_every_definition(frame_densities, pair):
    """All pairs, not compiled: states of the form that went in come out, so that one program serves all frames; or a sentence says why not."""
    definition, (model, start, density) = load_definition(pair.model), frame_densities(pair.model)
    options = options_of(definition, pair.kernel, TINY.most_particles)
    kernel = registry.find("kernel", pair.kernel).build(options=options)
    blind = [factor.name for factor in model.factors if factor.side == "likelihood" and not factor.has_gradient]
    if blind and _follows_gradients(pair, options):
        with pytest.raises(InputError) as error:
            jax.eval_shape(kernel, jax.random.key(0), start, density)
        _check_refusal(error, blind[0])
        return
    if _lacks_nodes(pair, model) or _lacks_gaussian(pair, model):
        with pytest.raises(InputError, match=NO_NODES if pair.kernel == "particle_bp" else NO_GAUSSIAN):
            jax.eval_shape(kernel, jax.random.key(0), start, density)
        return
    particles, info = jax.eval_shape(kernel, jax.random.key(0), start, density)
    assert _form(particles) == _form(start)
    assert info.ancestors.shape == (TINY.most_particles,) and info.ess.shape == info.log_evidence.shape == info.lost.shape == ()


# A fault of a kernel shows on any model, and a fault of a model with any kernel. How the two fit together is traced above.
EVERY_KERNEL_ON = "arm_markers"
# A whole body with the kernel that is the definition's own.
WITH_ITS_OWN_KERNEL = ("deutscher_2005", "annealed")


def _marks(pair):
    if pair.model == EVERY_KERNEL_ON:
        return () if pair.kernel in ("sir", "particle_bp") else pytest.mark.slow
    return pytest.mark.slow if (pair.model, pair.kernel) == WITH_ITS_OWN_KERNEL else pytest.mark.long


@pytest.mark.parametrize("pair", [pytest.param(pair, id=f"{pair.model}-{pair.kernel}", marks=_marks(pair)) for pair in ALL])
def test_a_kernel_follows_a_scene_of_a_definition(scenes, pair, monkeypatch):
    """One kernel on one model; `slow`: every kernel on it, and a whole body with its own; `long`: all pairs."""
    definition, options = load_definition(pair.model), options_of(load_definition(pair.model), pair.kernel, TINY.most_particles)
    term, traces = registry.find("kernel", pair.kernel), []

    def counted(**arguments):
        kernel = term.build(**arguments)
        return lambda *state: traces.append(1) or kernel(*state)

    monkeypatch.setitem(registry._terms, ("kernel", pair.kernel), term._replace(build=counted))
    blind = [f.name for f in scenes.of(definition).model.factors if f.side == "likelihood" and not f.has_gradient]
    if blind and _follows_gradients(pair, options):
        with pytest.raises(InputError) as error:
            followed(scenes, definition, pair.kernel, options, TINY)
        _check_refusal(error, blind[0])
        return
    model = scenes.of(definition).model
    if _lacks_nodes(pair, model) or _lacks_gaussian(pair, model):
        with pytest.raises(InputError, match=NO_NODES if pair.kernel == "particle_bp" else NO_GAUSSIAN):
            followed(scenes, definition, pair.kernel, options, TINY)
        return
    scene, draws = followed(scenes, definition, pair.kernel, options, TINY)
    assert len(traces) == 1
    _check_draws(scene, draws)
    figures = measured(scene.session, draws)
    assert set(figures) == set(FIGURES) and figures["seconds_per_frame"] > 0
    mode_seeker = bool(term.note)
    assert (figures["log_evidence"] is None) == (figures["ess_per_second"] is None) == mode_seeker
    if scene.kind == "drawn":
        assert 0 < figures["error_mm_mean"] < 500
        assert (figures["coverage_90"] is None) == mode_seeker


def _check_draws(scene, draws):
    count, body = draws.particles, scene.model.body
    for frame in draws.frames:
        placing = frame.states[body.variable]
        assert placing.shape == (1, count, *scene.model.initial[body.variable].shape) and np.isfinite(placing).all()
        assert np.isclose(np.exp(np.asarray(frame.log_weights, float)).sum(), 1, atol=1e-4)
        assert frame.info.ancestors.shape == (1, count) and not frame.lost
        assert 1 - 1e-4 <= frame.info.ess.item() <= count + 1e-3
        if body.variable == "pose":
            low, high = np.asarray(body.skeleton.low), np.asarray(body.skeleton.high)
            assert (placing >= low - 1e-5).all() and (placing <= high + 1e-5).all()


def test_pairs_are_all_of_them():
    every = pairs()
    assert len(every) == len(set(every)) == len({pair.model for pair in every}) * len(registry.names("kernel"))
    assert ("arm", "sir") in every
    assert pairs(["arm"], ["sir"]) == (("arm", "sir"),)
    with pytest.raises(InputError, match="kernel 'sirr' does not exist; did you mean 'sir'"):
        pairs(["arm"], ["sirr"])


@pytest.fixture
def rows(tmp_path):
    def made(asked, done=(), settings=TINY) -> list[Row]:
        (tmp_path / "scenes").mkdir(exist_ok=True)
        return list(benchmark_rows(asked, settings, tmp_path / "scenes", done))

    return made


@pytest.mark.long
def test_a_row_that_is_there_is_not_made_again(rows):
    asked = pairs(["arm_markers"], ["sir"])
    (first,) = rows(asked)
    assert first["scene"] == "drawn" and first["why_not"] is first["error"] is None and first["error_mm_mean"] > 0
    # As it comes back from a file.
    kept = json.loads(json.dumps(first)) | {"error_mm_mean": -1.0}
    assert rows(asked, [kept]) == [kept]
    for settings in (Settings(frames=3, most_particles=12), Settings(frames=2, most_particles=13), Settings(frames=2, most_particles=12, seed=1)):
        assert rows(asked, [kept], settings)[0]["error_mm_mean"] > 0
    assert rows(asked, [kept | {"error": "it failed"}])[0]["error_mm_mean"] > 0


@pytest.mark.slow
def test_the_same_settings_make_the_same_row(rows):
    one, other = (rows(pairs(["arm_markers"], ["sir"]))[0] for _ in range(2))
    assert [one[key] for key in ("error_mm_mean", "coverage_90", "log_evidence")] == [
        other[key] for key in ("error_mm_mean", "coverage_90", "log_evidence")
    ]


def test_what_cannot_be_has_its_sentence_and_the_others_go_on(rows, tmp_path):
    asked = [*pairs(["arm", "no_such"], ["sir"]), *pairs(["arm_markers"], ["sir"])]
    lonely, missing, fine = rows(asked)
    assert SENTENCE.match(lonely["why_not"])
    assert "'silhouette_edges' is not a distribution over data" in lonely["why_not"] and "--session" in lonely["why_not"]
    assert "model 'no_such' does not exist" in missing["why_not"]
    assert all(row[figure] is None for row in (lonely, missing) for figure in FIGURES)
    assert fine["error_mm_mean"] > 0


@pytest.mark.slow
def test_a_fault_of_the_program_is_told_apart(rows):
    from bayes_body.base.toml.schema import Count, Schema

    class Options(Schema):
        particles: Count = 10

    def fails(key, particles, density):
        raise ZeroDivisionError("by design")

    with plugins_of_this_test():
        registry.register("kernel", "broken", Options)(lambda **_: fails)
        # It is in the benchmark at once, because it is registered.
        assert ("arm_markers", "broken") in pairs()
        broken, fine = rows(pairs(["arm_markers"], ["broken", "sir"]))
    assert (broken["error"], broken["why_not"]) == ("ZeroDivisionError: by design", None) and "Traceback" in broken["details"]
    assert fine["error"] is None and fine["error_mm_mean"] > 0


@pytest.mark.slow
def test_a_recording_that_was_given_takes_the_place_of_scenes(rows, textured_session):
    from bayes_body.recording.session.read import save_session

    save_session(textured_session)
    settings = Settings(frames=2, most_particles=12, session=textured_session.folder)
    arm, markers = rows(pairs(["arm", "arm_markers"], ["sir"]), settings=settings)
    assert arm["scene"] == "recording" and arm["log_evidence"] < 0 and arm["error_mm_mean"] is None
    assert "no keypoints" in markers["why_not"]


@pytest.mark.slow
def test_what_is_drawn_is_the_model_s_own(tmp_path):
    """The truth of a drawn scene is what its data are of: at the true pose they lie within their own noise."""
    scene = Scenes(tmp_path, 4).of(load_definition("arm_markers"))
    truth = np.load(scene.session.truth_path)
    known = list(scene.model.body.markers.names)
    positions = truth["markers"][:, [list(truth["names"]).index(name) for name in known]]
    assert np.isfinite(positions).all() and np.isnan(truth["markers"]).any()
    from bayes_body.base.geometry.camera import project
    from bayes_body.recording.evidence.markers import MARKERS

    places = [MARKERS.index(name) for name in known]
    for frame in range(4):
        seen = scene.model.observe(read_frame(scene.session, frame))["markers_gaussian"]
        pixels = jax.vmap(project, (0, None))(scene.model.rig, jnp.asarray(positions[frame], jnp.float32))[0]
        off = np.abs(np.asarray(seen.pixels)[:, places] - pixels)
        assert np.median(off) < 12 and (seen.confidence[:, places] > 0).mean() > 0.5
    assert not (positions[0] == positions[3]).all()
