"""Names -> terms. A definition names its likelihoods, dynamics, potentials, observations and kernels; here the names get their meaning.

A built-in term is imported when its name is first asked for, so that listing names costs nothing. A user's plugin adds its own by `register`.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Literal, NamedTuple, get_args

from pydantic import BaseModel

from bayes_body.errors import InputError, input_error, nearest
from bayes_body.toml.schema import Schema

type Room = Literal["likelihood", "observation", "dynamics", "potential", "kernel"]
type Place = tuple[Room, str]

# The remedy where a definition names a term of the user's own.
OWN = "If it is a term of your own, name its file with --plugin."
ROOMS: tuple[Room, ...] = get_args(Room.__value__)


class Term(NamedTuple):
    """What a name stands for.

    Attributes:
        options: the schema of its options, a pydantic model.
        build: makes the term from them.
        note: what a user must know of it before a run; said at every run.
    """

    options: type[BaseModel]
    build: Callable[..., Any]
    note: str = ""


_BUILT_IN: dict[Place, str] = {
    ("likelihood", "silhouette_edges"): "bayes_body.likelihood.silhouette_edges",
    ("likelihood", "markers_gaussian"): "bayes_body.likelihood.markers_gaussian",
    ("likelihood", "silhouette_bernoulli"): "bayes_body.likelihood.silhouette_bernoulli",
    ("likelihood", "edge_phase"): "bayes_body.likelihood.edge_phase",
    ("observation", "edge_phase"): "bayes_body.observation.edge_phase",
    ("observation", "silhouette_edges"): "bayes_body.observation.silhouette_edges",
    ("observation", "markers_gaussian"): "bayes_body.observation.markers_gaussian",
    ("observation", "silhouette_bernoulli"): "bayes_body.observation.silhouette_bernoulli",
    ("dynamics", "diffusion"): "bayes_body.dynamics.diffusion",
    ("dynamics", "second_order"): "bayes_body.dynamics.second_order",
    ("potential", "intersection"): "bayes_body.potentials.intersection",
    ("kernel", "sir"): "bayes_body.kernels.particle_filter",
    ("kernel", "hmc"): "bayes_body.kernels.hmc_filter",
    ("kernel", "annealed"): "bayes_body.kernels.annealed_filter",
    ("kernel", "tempered"): "bayes_body.kernels.tempered_smc",
}
_terms: dict[Place, Term] = {}


def register(
    room: Room, name: str, options: type[BaseModel] = Schema, note: str = "", observation: str | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a build function a name in a room.

    Args:
        room: likelihood, observation, dynamics, potential or kernel.
        name: what `kind` shall say in a definition.
        options: the schema of the term's table, a subclass of `Schema`; by default it has none.
        note: what a user must know before trusting its results.
        observation: of a likelihood, the observation that prepares its data, where that is not one of its own.

    Raises:
        InputError: there is no such room or observation, the name is taken, or the options are no schema.
    """

    def decorate(build: Callable[..., Any]) -> Callable[..., Any]:
        _check(room, name, options, build)
        terms: dict[Place, Term] = {(room, name): Term(options, build, note)}
        if observation is not None:
            terms["observation", name] = find("observation", observation)
        for place in terms:
            taken = place in _terms or _BUILT_IN.get(place, _home(build)) != _home(build)
            if taken:
                raise InputError(f"{place[0]} '{name}' is registered twice; expected a new name; rename yours.")
        _terms.update(terms)
        return build

    return decorate


def _check(room: Room, name: str, options: type[BaseModel], build: Callable[..., Any]) -> None:
    """What types promise, for those whose code no type checker has seen."""
    if room not in ROOMS:
        raise InputError(f"register: room '{room}' does not exist; {nearest(str(room), ROOMS)}")
    if not isinstance(name, str) or not name:
        raise input_error(f"register: {room}", f"the name {name!r}", "a text", f'name it, such as register("{room}", "mine")')
    if not (isinstance(options, type) and issubclass(options, BaseModel)):
        shown = options.__name__ if isinstance(options, type) else repr(options)
        raise input_error(f"{room} '{name}': options", f"{shown} is no schema", "a class that derives from Schema", "write `class Options(Schema)`")
    if not callable(build):
        raise input_error(f"{room} '{name}'", f"{build!r} cannot be called", "a build function", "put @register above a function")


def _home(build: Callable[..., Any]) -> str:
    return getattr(build, "__module__", "")


@contextmanager
def additions() -> Iterator[list[Place]]:
    """Collects what is registered inside, built-in terms left out; if the inside fails, that is forgotten again."""
    before, found = set(_terms), []

    def new() -> list[Place]:
        return [place for place in _terms if place not in before and place not in _BUILT_IN]

    try:
        yield found
    except BaseException:
        forget(new())
        raise
    found += new()


def forget(places: Iterable[Place]) -> None:
    """Give names free again."""
    for place in places:
        _terms.pop(place, None)


def replace(place: Place, term: Term) -> None:
    """Let a name that is registered stand for another term."""
    _terms[place] = term


def names(room: Room) -> tuple[str, ...]:
    """All names of a room, sorted."""
    return tuple(sorted({name for r, name in [*_BUILT_IN, *_terms] if r == room}))


def own_names(room: Room) -> tuple[str, ...]:
    """Those that are not built in, sorted."""
    return tuple(sorted(name for r, name in _terms if r == room and (r, name) not in _BUILT_IN))


def notes(places: Iterable[Place]) -> Iterator[str]:
    """What must be known of these terms, a sentence each; most have none."""
    for room, name in dict.fromkeys(places):
        note = find(room, name).note
        if note:
            yield f"{name}: {note}"


def find(room: Room, name: str) -> Term:
    """The term of that name.

    Raises:
        InputError: there is none; it names the nearest known name, and how a term of one's own is found.
    """
    if (room, name) not in _terms and (room, name) in _BUILT_IN:
        import_module(_BUILT_IN[room, name])
    if (room, name) not in _terms:
        known = nearest(name, names(room))
        raise InputError(f"{room} '{name}' does not exist; {known}{'' if known.endswith('?') else '.'} {OWN}")
    return _terms[room, name]
