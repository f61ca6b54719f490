"""A user's own terms: what a plugin may do, that it is run only where it is named, and a sentence for each way in which it can be wrong."""

import pickle
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from own_terms import GOOD, MODEL, plugins_of_this_test

import bayes_body as bb
from bayes_body.base import registry
from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.model.plugins import load as plugins
from bayes_body.model.plugins.load import check_own_factors, load_plugin, loaded, plugins_to_blame, providing, unload
from bayes_body.model.plugins.terms import check_result
from bayes_body.recording.observation.frames import read_frame
from bayes_body.workshop.calibration import replications
from bayes_body.workshop.calibration.replications import Experiments


@pytest.fixture(autouse=True)
def _as_it_was(monkeypatch):
    # A user's code runs without checks of types; what they would say is what is tested here.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with plugins_of_this_test():
        yield


@pytest.fixture
def write(tmp_path):
    """A plugin's file: GOOD with replacements; each must have something to replace."""

    def file(*changes: tuple[str, str], name: str = "mine.py", text: str = GOOD) -> Path:
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return file


@pytest.fixture
def density(tmp_path, textured_session):
    """The first frame's density of MODEL, whatever the plugin now says."""

    def build(text: str = MODEL):
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        model = build_model(tmp_path / "mine.toml", textured_session)
        return model, model.density(model.observe(read_frame(textured_session, 0)))

    return build


def test_its_terms_have_their_names(write, density, textured_session):
    plugin = load_plugin(write())
    assert set(plugin.places) == {("observation", "brightness"), ("likelihood", "brightness")}
    assert registry.find("likelihood", "brightness").note == "a toy"
    model, found = density()
    pose = model.initial["pose"]
    level = read_frame(textured_session, 0).images[0].mean() / 255
    assert found.parts(model.initial)["brightness"] == pytest.approx(-2.0 * level * float(jnp.sum(pose**2)), rel=1e-5)
    check_own_factors(found, model.initial)


def test_a_bare_function_is_no_leaf_of_the_model(write, density):
    load_plugin(write())
    model, _ = density()
    assert all(hasattr(leaf, "dtype") for leaf in jax.tree.leaves(model.factors))


def test_without_it_its_name_means_nothing(density):
    with pytest.raises(InputError, match=r"likelihood #1\.kind: likelihood 'brightness' does not exist; .* name its file with --plugin\."):
        density()


def test_it_is_run_once_until_it_changes(write):
    first = load_plugin(write())
    assert load_plugin(write()) is first
    second = load_plugin(write(("stiffness: float = 4.0", "stiffness: float = 5.0")))
    assert second != first and loaded() == (second,)
    assert registry.find("likelihood", "brightness").options().stiffness == 5.0


def test_what_it_provides_is_known(write):
    plugin = load_plugin(write())
    assert providing({("likelihood", "brightness"), ("kernel", "sir")}) == (plugin,)
    assert providing({("kernel", "sir")}) == ()
    unload(plugin)
    assert loaded() == () and "brightness" not in registry.names("likelihood")


def test_nothing_is_left_beside_the_file(write, tmp_path):
    load_plugin(write())
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]


def test_the_observation_of_another_likelihood(write):
    text = GOOD.replace('note="a toy"', 'observation="silhouette_edges"')
    start, end = text.index("@bb.register"), text.index('@bb.register("likelihood"')
    load_plugin(write(text=text[:start] + text[end:]))
    shared, own = (registry.find("observation", name) for name in ("silhouette_edges", "brightness"))
    assert own.options is shared.options and callable(own.build(options=own.options()))


KERNEL = """
@bb.register("kernel", "mine", {options})
def kernel(options, **_):
    return lambda key, particles, density: (particles, None)
"""
LIKELIHOOD, OBSERVATION = '"likelihood", "brightness"', '"observation", "brightness"'
FAULTS = {
    "syntax": (("class Options(bb.Schema):", "class Options(bb.Schema)"), ["line 7", "expected ':' in the line `class Options(bb.Schema)`"]),
    "null bytes": (("stiffness: float", "\0"), ["null bytes", "expected Python"]),
    "import": (("import jax.numpy as jnp", "import no_such_module"), ["line 3", "`import no_such_module`", "ModuleNotFoundError: No module"]),
    "error": (("stiffness: float = 4.0", "stiffness: float = 1 / 0"), ["line 8", "ZeroDivisionError: division by zero", "expected code that"]),
    "exit": (("import jax.numpy as jnp", "raise SystemExit(3)"), ["line 3", "SystemExit: 3"]),
    "unknown room": ((LIKELIHOOD, '"likelyhood", "brightness"'), ["line 14", "room 'likelyhood' does not exist", "did you mean"]),
    "nothing": (("@bb.register", "# @bb.register"), ["registers nothing", "expected at least one term", "@bb.register"]),
    "twice": ((OBSERVATION, LIKELIHOOD), ["line 14", "likelihood 'brightness' is registered twice", "rename yours"]),
    "built-in": ((LIKELIHOOD, '"likelihood", "silhouette_edges"'), ["likelihood 'silhouette_edges' is registered twice"]),
    "no schema": (("Options, note", "dict(a=1), note"), ["likelihood 'brightness': options: {'a': 1} is not a schema", "class Options(Schema)"]),
    "no model": (("Options(bb.Schema)", "Options"), ["likelihood 'brightness': options: Options is not a schema", "derives from Schema"]),
    "no name": ((LIKELIHOOD, '"likelihood", Options'), ["register: likelihood", "the name <class", "expected a string"]),
    "no observation": ((OBSERVATION, '"observation", "other"'), ["likelihood 'brightness'", "no observation", 'observation="markers_gaussian"']),
    "unknown observation": (('note="a toy"', 'observation="silhouete"'), ["line 14", "observation 'silhouete' does not exist; did you mean"]),
    "kernel": (("POSE =", KERNEL.format(options="bb.Schema") + "\nPOSE ="), ["kernel 'mine'", "no `particles`", "add `particles: Count"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_plugin_that_cannot_be_used(write, fault):
    change, parts = FAULTS[fault]
    path, before = write(change), dict(registry._terms)
    with pytest.raises(InputError) as error:
        load_plugin(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
    for part in parts:
        assert part in str(error.value)
    # So that the corrected file can be loaded by the same process.
    assert {place: term for place, term in registry._terms.items() if place not in registry._BUILT_IN} == {
        place: term for place, term in before.items() if place not in registry._BUILT_IN
    }
    assert loaded() == () and not [name for name in sys.modules if name.startswith(plugins.MODULES)]
    load_plugin(write())


@pytest.mark.parametrize("kind", ["none", "folder", "bytes"])
def test_a_file_that_is_none(tmp_path, kind):
    path = tmp_path / "mine.py"
    if kind == "folder":
        path.mkdir()
    if kind == "bytes":
        path.write_bytes(b"\xff\xfe\x00x")
    found = {"none": "no such file", "folder": "a folder", "bytes": "not text"}[kind]
    with pytest.raises(InputError, match=f"mine.py: {found}; expected a Python file"):
        load_plugin(path)


def test_two_files_of_one_name(write, tmp_path):
    load_plugin(write())
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="has the same file name; expected a file name of its own"):
        load_plugin(write(name="other/mine.py"))


BUILDS = {
    "fails": (("return bb.Factor", "return bb.Faktor"), ["line 18", "`return bb.Faktor", "AttributeError: module 'bayes_body' has no attribute"]),
    "nothing": (("return bb.Factor", "bb.Factor"), ["likelihood 'brightness'", "returns nothing", "expected a Factor", "return one"]),
    "another name": (("bb.Factor(name", 'bb.Factor("x"'), ["its factor is called 'x'", "expected 'brightness'", "pass on the name"]),
    "another side": (('name, "likelihood"', 'name, "prior"'), ['has the side "prior"', 'expected "likelihood"']),
    "its arguments": (
        ("def build(name, options, body, **_)", "def build(name, options)"),
        ["line 14", "TypeError: build() got an unexpected keyword"],
    ),
    "its own sentence": (("return bb.Factor", 'raise bb.InputError("scale: 3; expected 4.")  # '), ["mine.py: line 18: scale: 3; expected 4."]),
    "leaves the program": (("return bb.Factor", "raise SystemExit(0)  # "), ["line 18", "SystemExit: 0", "correct the plugin"]),
    "observation": (("return lambda frame: frame", "lambda frame: frame"), ["observation 'brightness'", "returns nothing", "a function of a frame"]),
}


@pytest.mark.parametrize("fault", BUILDS)
def test_a_term_that_cannot_be_built(write, density, fault):
    change, parts = BUILDS[fault]
    path = write(change)
    load_plugin(path)
    with pytest.raises(InputError) as error:
        density()
    assert str(error.value).startswith(str(path))
    for part in parts:
        assert part in str(error.value)


VALUES = {
    "vector": (("jnp.sum(values[POSE] ** 2)", "values[POSE] ** 2"), "returns an array of shape (4,); expected one number, of shape ()"),
    "one in a list": (("jnp.sum(values[POSE] ** 2)", "jnp.sum(values[POSE] ** 2, keepdims=True)"), "returns an array of shape (1,)"),
    "nothing": (("return -options", "-options"), "returns nothing; expected one number"),
    "truth": (("return -options.stiffness * level * jnp.sum(values[POSE] ** 2)", "return values[POSE][0] > 0"), "returns a number of type bool"),
    "NaN": (("** 2)", "** 0 * jnp.nan)"), "is NaN at the first pose, with the data of the first frame; expected a finite number, or minus infinity"),
    "infinity": (("return -options", "return jnp.inf + options"), "is infinite at the first pose"),
    "scope": (("(POSE,)", '(bb.Variable("poses"),)'), "its scope: has ('poses', 0); expected variables (name, offset) of the model: ('pose', -1)"),
}


@pytest.mark.parametrize("fault", VALUES)
@pytest.mark.parametrize("second", [False, True], ids=["alone", "after another"])
def test_a_log_potential_that_no_posterior_can_be_made_of(write, density, fault, second):
    change, said = VALUES[fault]
    path = write(change)
    load_plugin(path)
    model, found = density(MODEL.replace("[[likelihood]]", '[[likelihood]]\nkind = "silhouette_edges"\n\n[[likelihood]]') if second else MODEL)
    with pytest.raises(InputError) as error:
        check_own_factors(found, model.initial)
    assert str(error.value).startswith(f"{path}: line 16, likelihood 'brightness'") and said in str(error.value)


def test_minus_infinity_is_a_log_potential(write, density):
    load_plugin(write(("return -options", "return -jnp.inf + options")))
    model, found = density()
    check_own_factors(found, model.initial)


def test_built_in_factors_are_left_alone(textured_session):
    model = build_model("arm", textured_session)
    nonsense = model.density({"silhouette_edges": np.nan})
    check_own_factors(nonsense, model.initial)


def test_terms_registered_in_a_program_are_checked_too(density):
    bb.register("observation", "brightness")(lambda **_: lambda frame: 0.0)
    pose = bb.Variable("pose")
    bb.register("likelihood", "brightness")(lambda name, **_: bb.Factor(name, "likelihood", (pose,), jax.tree_util.Partial(lambda v, d: v[pose])))
    model, found = density(MODEL.replace("stiffness = 2.0", ""))
    with pytest.raises(InputError, match=r"^likelihood 'brightness': its log-potential: returns an array of shape \(4,\)"):
        check_own_factors(found, model.initial)


def test_what_fails_in_a_plugin_s_code_later_is_its_line(write, density, textured_session):
    path = write(("jnp.sum(values[POSE] ** 2)", "jnp.sum(values[POSE] @ jnp.ones(7))"))
    load_plugin(path)
    model, found = density()
    with pytest.raises(InputError) as error, plugins_to_blame():
        jax.jit(lambda state: found(state))(model.initial)
    assert f"{path}: line 17, `return -options.stiffness" in str(error.value) and "TypeError: dot_general requires" in str(error.value)


CALLS = {
    "its arguments": (
        ("def log_potential(values, level)", "def log_potential(values)"),
        ["line 16, `def log_potential", "TypeError: ", "takes 1 positional"],
    ),
    "a condition": (
        ("return -options", "if values[POSE][0] > 0: level = 0\n        return -options"),
        ["line 17, `if values", "TracerBoolConversionError"],
    ),
    "text": (
        ("return -options.stiffness * level * jnp.sum(values[POSE] ** 2)", "return 'far'"),
        ["line 16", "returns str; expected arrays of numbers"],
    ),
    "the host": (
        ("return -options", "level = jax.pure_callback(lambda: 1 / 0, jax.ShapeDtypeStruct((), 'float32'))\n        return -options"),
        ["line 17, `level = jax.pure_callback", "ZeroDivisionError: division by zero"],
    ),
}


@pytest.mark.parametrize("fault", CALLS)
def test_what_fails_where_it_is_called(write, density, fault):
    change, parts = CALLS[fault]
    path = write(change, ("import jax.numpy as jnp", "import jax, jax.numpy as jnp"))
    load_plugin(path)

    def use():
        with plugins_to_blame():
            model, found = density()
            jax.block_until_ready(jax.jit(lambda state: found(state))(model.initial))

    with pytest.raises(InputError) as error:
        use()
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)
    for part in parts:
        assert part in str(error.value)


def test_a_signal_that_arrives_in_its_code_is_not_its_fault(write):
    """SIGTERM raises SystemExit wherever the program is."""

    def stop():
        raise SystemExit(143)

    registry.interrupt = stop
    load_plugin(write(("return lambda frame: frame", "from bayes_body.base import registry; registry.interrupt(); return lambda frame: frame")))
    with pytest.raises(SystemExit), plugins_to_blame():
        registry.find("observation", "brightness").build(options=None)
    del registry.interrupt


def test_an_observation_has_the_same_arrays_in_every_frame(write, density, textured_session):
    path = write(("return lambda frame: frame.images[0].mean() / 255", "return lambda frame: jnp.ones(2 + frame.index)"))
    load_plugin(path)
    model, _ = density()
    with pytest.raises(InputError) as error:
        model.observe(read_frame(textured_session, 1))
    said = "returns arrays of the shapes float32[3], and returned float32[2] before; expected the same in every frame"
    assert str(error.value).startswith(f"{path}: line 12, observation 'brightness': ") and said in str(error.value)


def test_an_observation_returns_numbers(write, density):
    load_plugin(write(("frame.images[0].mean() / 255", "'dark'")))
    with pytest.raises(InputError, match=r"mine.py: line 12, observation 'brightness': returns str; expected arrays of numbers"):
        density()


DYNAMICS = """
import bayes_body as bb
import jax.numpy as jnp
import numpyro.distributions as dist

@bb.register("dynamics", "sway")
def build(options, body, fps, **_):
    def near(state, scale=1.0):
        return {"pose": dist.Normal(state["pose"], 0.1 * scale).to_event(1)}
    return bb.Transition("sway", near, near)
"""
SWAYING = """
title  = "Mine"
source = "nobody"
body.name = "arm_4"
dynamics = { kind = "sway" }
kernel = { kind = "sir", particles = 20 }

[[likelihood]]
kind = "silhouette_edges"
"""
MOTIONS = {
    "right": (("sway", "sway"), None),
    "nothing": (("return {", "{"), ["line 8, dynamics 'sway': returns nothing; expected a mapping from names of variables"]),
    "fails": (('state["pose"], 0.1', 'state["poses"], 0.1'), ["line 9, `return {", "KeyError: 'poses'"]),
    "no event": ((".to_event(1)", ""), ["line 8, dynamics 'sway': its log-density: has the shape (4,)", "`.to_event(1)`"]),
    "other variables": (('return {"pose"', 'return {"arm"'), ["draws states with `arm` (4,); expected `pose` (4,), as the first state has"]),
    "another shape": (('Normal(state["pose"],', 'Normal(state["pose"][:3],'), ["draws states with `pose` (3,); expected `pose` (4,)"]),
    "no distribution": (('dist.Normal(state["pose"], 0.1 * scale).to_event(1)', "0.0"), ["'pose' is float; expected a distribution of numpyro"]),
    "NaN": (("0.1 * scale)", "jnp.nan * scale, validate_args=False)"), ["'pose' is not finite in a state that it draws"]),
}


@pytest.mark.parametrize("fault", MOTIONS)
def test_a_motion_prior(write, density, fault):
    change, parts = MOTIONS[fault]
    path = write(change, text=DYNAMICS)
    load_plugin(path)

    def use():
        model, found = density(SWAYING)
        check_own_factors(found, model.initial)
        return model

    if parts is None:
        # A bare function is no leaf of the model, and a model that is built again is not compiled again.
        assert all(hasattr(leaf, "dtype") for leaf in jax.tree.leaves(use().transition))
        return
    with pytest.raises(InputError) as error:
        use()
    assert str(error.value).startswith(f"{path}: line ")
    for part in parts:
        assert part in str(error.value)


SAMPLER = """
import bayes_body as bb
import jax
import jax.numpy as jnp

class Options(bb.Schema):
    particles: bb.Count = 10

@bb.register("kernel", "mine", Options)
def build(options, **_):
    def kernel(key, particles, density):
        n = particles.log_weights.shape[0]
        one = jnp.ones(())
        info = bb.FilterInfo(jnp.arange(n), one, one[None], one[None], one, one > 2, one[None], jnp.asarray(n))
        return bb.Particles(dict(particles.states), particles.log_weights), info
    return kernel
"""
SAMPLERS = {
    "right": (("mine", "mine"), None),
    "nothing": (("return bb.Particles", "bb.Particles"), ["returns nothing; expected a pair (bb.Particles, bb.FilterInfo)"]),
    "one of two": (("log_weights), info\n", "log_weights), None\n"), ["returns (Particles, nothing); expected a pair"]),
    "fails": (("one = jnp.ones(())", "one = jnp.ones(3) @ jnp.ones(4)"), ["line 13, `one = ", "TypeError: "]),
    "its arguments": (("kernel(key, particles, density)", "kernel(key, particles)"), ["line 11, `def kernel", "takes 2 positional arguments"]),
    "fewer": (
        ("particles.log_weights), info", "particles.log_weights[:5]), info"),
        ["`log_weights` of the particles is float32[5]; expected float32[10]"],
    ),
    "no states": (("bb.Particles(dict(particles.states)", "bb.Particles({}"), ["particles with log_weights; expected log_weights, pose"]),
    "another type": (("particles.log_weights), info", "jnp.arange(n)), info"), ["`log_weights` of the particles is int32[10]; expected float32[10]"]),
    "a shape": (("jnp.arange(n), one, one[None]", "jnp.arange(n), one[None], one[None]"), ["`ess` of its bb.FilterInfo has the shape (1,)"]),
    "NaN": (("particles.log_weights), info", "particles.log_weights * jnp.nan), info"), ["log-weights of frame 7 are NaN; expected normalised"]),
    "NaN states": (("dict(particles.states)", "{'pose': particles.states['pose'] * jnp.nan}"), ["'pose' is NaN in some particles of frame 7"]),
}


@pytest.mark.parametrize("fault", SAMPLERS)
def test_a_kernel(write, fault):
    change, parts = SAMPLERS[fault]
    path = write(change, text=SAMPLER)
    load_plugin(path)
    particles = bb.Particles({"pose": jnp.zeros((10, 4))}, jnp.full(10, -jnp.log(10.0)))
    kernel = registry.find("kernel", "mine").build(options=None)

    def use():
        found, _ = jax.jit(lambda key, particles: kernel(key, particles, None))(jax.random.key(0), particles)
        check_result(kernel, found, 7)

    if parts is None:
        use()
        return
    with pytest.raises(InputError) as error:
        use()
    assert str(error.value).startswith(f"{path}: line 1")
    for part in parts:
        assert part in str(error.value)


def test_sentences_come_back_from_other_processes():
    """As the check's processes send them: each of a file's faults stays one sentence."""
    fault = FaultyFileError(["a: 1; expected 2.", "b: 3; expected 4."])
    again = pickle.loads(pickle.dumps(fault))
    assert again.sentences == fault.sentences and str(again) == str(fault)


def test_what_fails_in_a_process_of_the_check_is_its_line(write, monkeypatch):
    path = write(("stiffness: float = 4.0", "stiffness: float = 4.0\n\ndef late(key): return 1 / 0"))
    load_plugin(path)

    def late(key):
        return sys.modules[f"{plugins.MODULES} mine"].late(key)

    monkeypatch.setattr(replications, "_make", lambda: Experiments(0, {"late": late}))
    monkeypatch.setattr(replications, "_runner", None)
    with pytest.raises(InputError, match=r"mine.py: line 10, `def late.*ZeroDivisionError: division by zero; expected code that runs"):
        replications._work("late", 0)


def test_what_fails_elsewhere_is_not_a_plugin_s_fault(write):
    load_plugin(write())
    with pytest.raises(ZeroDivisionError), plugins_to_blame():
        raise ZeroDivisionError


def test_a_definition_of_the_plugin_s_terms_says_what_is_wrong_with_them(write, density):
    load_plugin(write())
    with pytest.raises(InputError, match=r"likelihood #1: stifness: unknown key; did you mean 'stiffness'\?"):
        density(MODEL.replace("stiffness", "stifness"))
    assert load_definition("arm").likelihoods[0].kind == "silhouette_edges"
