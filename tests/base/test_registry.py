"""Names and terms: built-in ones are all there and have options that a user can leave out; a plugin adds its own; a wrong name says the nearest."""

import pytest
from pydantic import BaseModel

from bayes_body.base import registry
from bayes_body.base.errors import InputError

ROOMS = ("likelihood", "observation", "dynamics", "potential", "kernel")
BUILT_IN = sorted(registry._BUILT_IN)


@pytest.fixture(autouse=True)
def _as_it_was(monkeypatch):
    # Built-in terms are registered once, when they are first asked for: one that is put back must hold them all.
    for place in BUILT_IN:
        registry.find(*place)
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))


class Options(BaseModel):
    """A plugin's."""

    stiffness: float = 1.0


@pytest.mark.parametrize(("room", "name"), BUILT_IN)
def test_every_built_in_name_has_its_term(room, name):
    term = registry.find(room, name)
    assert issubclass(term.options, BaseModel)
    assert callable(term.build)
    required = [key for key, field in term.options.model_fields.items() if field.is_required()]
    assert required or term.options() == term.options.model_validate({})
    assert name in registry.names(room)


@pytest.mark.parametrize(("room", "name"), BUILT_IN)
def test_a_misspelt_option_is_refused(room, name):
    with pytest.raises(ValueError, match="Extra inputs"):
        registry.find(room, name).options.model_validate({"no_such_option": 1})


def test_every_likelihood_has_an_observation():
    assert set(registry.names("likelihood")) <= set(registry.names("observation"))


def test_a_mode_seeker_says_so():
    assert "mode seeker" in registry.find("kernel", "annealed").note
    assert registry.find("kernel", "sir").note == ""


def test_a_plugin_is_found_and_listed():
    @registry.register("potential", "spring", Options, "beware")
    def build(options, **_):
        return options.stiffness

    term = registry.find("potential", "spring")
    assert (term.options, term.note) == (Options, "beware")
    assert term.build(options=Options(stiffness=2.0)) == 2.0
    assert registry.names("potential") == ("intersection", "kinematic", "penetration", "spring", "training_limits")
    # A name belongs to its room.
    with pytest.raises(InputError):
        registry.find("kernel", "spring")


@pytest.mark.parametrize("name", ["intersection", "spring"])
def test_a_name_is_given_once(name):
    registry.find("potential", "intersection")
    if name == "spring":
        registry.register("potential", "spring", Options)(lambda **_: None)
    with pytest.raises(InputError, match=f"potential '{name}' is registered twice; expected a new name; rename yours"):
        registry.register("potential", name, Options)(lambda **_: None)


def test_a_built_in_name_is_taken_even_before_it_was_imported():
    registry._terms.pop(("potential", "intersection"), None)
    with pytest.raises(InputError, match="registered twice"):
        registry.register("potential", "intersection", Options)(lambda **_: None)


@pytest.mark.parametrize(
    ("name", "said"),
    [("aneealed", "did you mean 'annealed'?"), ("gibbs", "known: annealed, hmc, laplace, particle_bp, sir, tempered.")],
    ids=["nearly", "not at all"],
)
def test_a_wrong_name_says_the_nearest_or_all(name, said):
    with pytest.raises(InputError) as error:
        registry.find("kernel", name)
    assert str(error.value) == f"kernel '{name}' does not exist; {said} If it is a term of your own, name its file with --plugin."


@pytest.mark.parametrize("room", ROOMS)
def test_names_are_sorted_and_there(room):
    assert registry.names(room) == tuple(sorted(registry.names(room))) != ()
