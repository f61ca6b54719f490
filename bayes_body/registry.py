"""Names -> terms. A definition names its likelihoods, dynamics, potentials, observations and kernels; here the names get their meaning.

A built-in term is imported when its name is first asked for, so that listing names costs nothing. A user's plugin adds its own by `register`.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel

from bayes_body.errors import InputError, nearest

type Room = Literal["likelihood", "observation", "dynamics", "potential", "kernel"]


class Term(NamedTuple):
    """What a name stands for.

    Attributes:
        options: the schema of its options, a pydantic model.
        build: makes the term from them.
        note: what a user must know before trusting its results; said at every run.
    """

    options: type[BaseModel]
    build: Callable[..., Any]
    note: str = ""


_BUILT_IN: dict[tuple[Room, str], str] = {
    ("likelihood", "silhouette_edges"): "bayes_body.likelihood.silhouette_edges",
    ("observation", "silhouette_edges"): "bayes_body.observation.silhouette_edges",
    ("dynamics", "diffusion"): "bayes_body.dynamics.diffusion",
    ("potential", "intersection"): "bayes_body.potentials.intersection",
    ("kernel", "sir"): "bayes_body.kernels.particle_filter",
    ("kernel", "annealed"): "bayes_body.kernels.annealed_filter",
    ("kernel", "tempered"): "bayes_body.kernels.tempered_smc",
}
_terms: dict[tuple[Room, str], Term] = {}


def register(room: Room, name: str, options: type[BaseModel], note: str = "") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a build function a name in a room.

    Raises:
        InputError: the name is taken.
    """

    def decorate(build: Callable[..., Any]) -> Callable[..., Any]:
        taken = (room, name) in _terms or _BUILT_IN.get((room, name), build.__module__) != build.__module__
        if taken:
            raise InputError(f"{room} '{name}' is registered twice; expected a new name; rename yours.")
        _terms[room, name] = Term(options, build, note)
        return build

    return decorate


def names(room: Room) -> tuple[str, ...]:
    """All names of a room, sorted."""
    return tuple(sorted({name for r, name in [*_BUILT_IN, *_terms] if r == room}))


def find(room: Room, name: str) -> Term:
    """The term of that name.

    Raises:
        InputError: there is none; the nearest known name is said.
    """
    if (room, name) not in _terms and (room, name) in _BUILT_IN:
        import_module(_BUILT_IN[room, name])
    if (room, name) not in _terms:
        raise InputError(f"{room} '{name}' does not exist; {nearest(name, names(room))}")
    return _terms[room, name]
