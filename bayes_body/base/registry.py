"""The registry of terms. It maps the names of likelihoods, dynamics, potentials, unknowns, observations and kernels in a definition to their code.

A built-in term is imported when it is first looked up, so that listing names costs nothing. A user's plugin adds terms with `register`.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, get_args

from pydantic import BaseModel

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.toml.schema import Schema

type Room = Literal["likelihood", "observation", "dynamics", "potential", "unknown", "kernel"]
type Place = tuple[Room, str]

# The remedy if a definition names a user's own term.
OWN = "If it is a term of your own, name its file with --plugin."
ROOMS: tuple[Room, ...] = get_args(Room.__value__)
# What a likelihood may compare the body with. OTHER: a plugin's likelihood that does not say.
EVIDENCE = ("keypoints", "silhouettes", "edges", "image motion")
OTHER = "other"
type Reads = tuple[str, ...] | Callable[[Any], tuple[str, ...]]


class FewCameras(NamedTuple):
    """What is taken by default instead of a kernel if a recording has too few cameras for it.

    Attributes:
        cameras: the smallest number of cameras that suffices.
        kernel: the kernel for fewer.
        options: its options.
        reason: why, as the end of a sentence that begins with the number of cameras.
    """

    cameras: int
    kernel: str
    options: Mapping[str, Any]
    reason: str


class Term(NamedTuple):
    """A registered term.

    Attributes:
        options: the schema of its options, a pydantic model.
        build: makes the term from its options.
        note: what a user must know about it before a run; printed at every run.
        reads: of a likelihood: the EVIDENCE that it compares the body with, or a function of its options that returns it.
        samples_posterior: of a kernel: whether its particles are a sample of the posterior. Those of a mode seeker are not. None: it does not
            say, and is taken for a mode seeker if it estimates no evidence.
        recovers: of a kernel: whether a lost run looks for the person again unless the user says otherwise.
        markov_move: of a kernel: a function of its options that returns its Markov move (`kernels.markov_moves`); None if it has none.
        instead: of a kernel: what a user may do instead where few of its particles carry the weight, such as `use --kernel tempered`.
        runs_together: of a kernel: whether the devices share the runs. Otherwise they share the particles of each run.
        few_cameras: of a kernel: what is taken instead with few cameras; None if it serves any number.
        smoothed_by: of a kernel: options of the smoother for its runs that differ from the smoother's defaults.
        by_particles: of a kernel: whether what a frame predicts for the next one is a mixture about its particles, or a function of its options that
            says so. Of what hardly moves all particles then descend from a few.
        takes_proposals: of a kernel: whether it draws from `Density.proposals`. For other kernels nothing is detected.
    """

    options: type[BaseModel]
    build: Callable[..., Any]
    note: str = ""
    reads: Reads = (OTHER,)
    samples_posterior: bool | None = None
    recovers: bool = False
    markov_move: Callable[[Any], Any] | None = None
    instead: str = ""
    runs_together: bool = False
    few_cameras: FewCameras | None = None
    smoothed_by: Mapping[str, Any] = MappingProxyType({})
    by_particles: bool | Callable[[Any], bool] = False
    takes_proposals: bool = False

    def predicts_by_particles(self, options: Any) -> bool:
        """Return whether a kernel with these options predicts by a mixture about its particles."""
        return self.by_particles(options) if callable(self.by_particles) else self.by_particles

    def evidence(self, options: BaseModel) -> tuple[str, ...]:
        """Return what a likelihood with these options compares the body with."""
        return self.reads(options) if callable(self.reads) else self.reads


_BUILT_IN: dict[Place, str] = {
    ("likelihood", "silhouette_edges"): "bayes_body.model.likelihood.silhouette_edges",
    ("likelihood", "markers_gaussian"): "bayes_body.model.likelihood.markers_gaussian",
    ("likelihood", "silhouette_bernoulli"): "bayes_body.model.likelihood.silhouette_bernoulli",
    ("likelihood", "edge_phase"): "bayes_body.model.likelihood.edge_phase",
    ("likelihood", "regions"): "bayes_body.model.likelihood.regions",
    ("likelihood", "image_motion"): "bayes_body.model.likelihood.image_motion",
    ("observation", "edge_phase"): "bayes_body.recording.observation.edge_phase",
    ("observation", "silhouette_edges"): "bayes_body.recording.observation.silhouette_edges",
    ("observation", "markers_gaussian"): "bayes_body.recording.observation.markers_gaussian",
    ("observation", "silhouette_bernoulli"): "bayes_body.recording.observation.silhouette_bernoulli",
    ("observation", "regions"): "bayes_body.recording.observation.regions",
    ("observation", "image_motion"): "bayes_body.recording.observation.image_motion",
    ("dynamics", "diffusion"): "bayes_body.model.dynamics.diffusion",
    ("dynamics", "second_order"): "bayes_body.model.dynamics.second_order",
    ("dynamics", "constant_velocity"): "bayes_body.model.dynamics.constant_velocity",
    ("dynamics", "rigid_walk"): "bayes_body.model.dynamics.rigid_walk",
    ("dynamics", "walking_cycle"): "bayes_body.model.dynamics.walking_cycle",
    ("dynamics", "activity_hmm"): "bayes_body.model.dynamics.activity_hmm",
    ("potential", "intersection"): "bayes_body.model.potentials.intersection",
    ("potential", "kinematic"): "bayes_body.model.potentials.kinematic",
    ("potential", "penetration"): "bayes_body.model.potentials.penetration",
    ("potential", "training_limits"): "bayes_body.model.potentials.training_limits",
    ("unknown", "lengths"): "bayes_body.model.unknowns.lengths",
    ("unknown", "widths"): "bayes_body.model.unknowns.widths",
    ("unknown", "cameras"): "bayes_body.model.unknowns.cameras",
    ("unknown", "delays"): "bayes_body.model.unknowns.delays",
    ("unknown", "keypoint_offsets"): "bayes_body.model.unknowns.keypoint_offsets",
    ("unknown", "noise"): "bayes_body.model.unknowns.noise",
    ("kernel", "sir"): "bayes_body.kernels.smc.particle_filter",
    ("kernel", "hmc"): "bayes_body.kernels.hmc.hmc_filter",
    ("kernel", "annealed"): "bayes_body.kernels.smc.annealed_filter",
    ("kernel", "particle_bp"): "bayes_body.kernels.messages.particle_bp",
    ("kernel", "laplace"): "bayes_body.kernels.laplace.laplace_filter",
    ("kernel", "tempered"): "bayes_body.kernels.smc.tempered_smc",
}
_terms: dict[Place, Term] = {}


def register(
    room: Room,
    name: str,
    options: type[BaseModel] = Schema,
    note: str = "",
    observation: str | None = None,
    *,
    reads: Reads = (OTHER,),
    samples_posterior: bool | None = None,
    recovers: bool = False,
    markov_move: Callable[[Any], Any] | None = None,
    instead: str = "",
    runs_together: bool = False,
    few_cameras: FewCameras | None = None,
    smoothed_by: Mapping[str, Any] = MappingProxyType({}),
    by_particles: bool | Callable[[Any], bool] = False,
    takes_proposals: bool = False,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a build function under a name in a room. Use it as a decorator.

    What a term is stands here, and nowhere else: no other table names terms.

    Args:
        room: likelihood, observation, dynamics, potential, unknown or kernel.
        name: the value of `kind` in a definition.
        options: the schema of the term's table, a subclass of `Schema`; by default the term has no options.
        note: what a user must know before trusting its results.
        observation: for a likelihood, the observation that prepares its data, unless one of the same name is registered.
        reads: for a likelihood, what it compares the body with: `keypoints`, `silhouettes`, `edges`, `image motion`; or a function of its options.
        samples_posterior: for a kernel, whether its particles are a sample of the posterior. If not, no interval and no evidence is shown. A kernel
            that does not say is taken for a mode seeker if it estimates no evidence.
        recovers: for a kernel, whether a lost run looks for the person again by default.
        markov_move: for a kernel, a function of its options that returns its Markov move, for `bayes-body check`.
        instead: for a kernel, what a user may do instead where few particles carry the weight.
        runs_together: for a kernel of few particles, whether the devices share the runs and not the particles of each run.
        few_cameras: for a kernel, what is taken instead by default if a recording has too few cameras for it.
        smoothed_by: for a kernel, options of the smoother for its runs that differ from the smoother's defaults.
        by_particles: for a kernel, whether it predicts by a mixture about its particles, or a function of its options that says so. Then there is a
            warning for a model with unknowns.
        takes_proposals: for a kernel, whether it draws from the proposals of a density, such as detections.

    Raises:
        InputError: there is no such room or observation, the name is taken, or the options are not a schema.
    """

    def decorate(build: Callable[..., Any]) -> Callable[..., Any]:
        _check(room, name, options, build)
        of_kernel = (samples_posterior, recovers, markov_move, instead, runs_together, few_cameras, smoothed_by, by_particles, takes_proposals)
        term = Term(options, build, note, reads, *of_kernel)
        terms: dict[Place, Term] = {(room, name): term}
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
    """Check the types of the arguments, since a plugin's code need not have passed a type checker."""
    if room not in ROOMS:
        raise InputError(f"register: room '{room}' does not exist; {nearest(str(room), ROOMS)}")
    if not isinstance(name, str) or not name:
        raise input_error(f"register: {room}", f"the name {name!r}", "a string", f'name it, such as register("{room}", "mine")')
    if not (isinstance(options, type) and issubclass(options, BaseModel)):
        shown = options.__name__ if isinstance(options, type) else repr(options)
        problem, remedy = f"{shown} is not a schema", "write `class Options(Schema)`"
        raise input_error(f"{room} '{name}': options", problem, "a class that derives from Schema", remedy)
    if not callable(build):
        raise input_error(f"{room} '{name}'", f"{build!r} cannot be called", "a build function", "put @register above a function")


def _home(build: Callable[..., Any]) -> str:
    return getattr(build, "__module__", "")


@contextmanager
def additions() -> Iterator[list[Place]]:
    """Collect the terms registered in the body of the `with` statement, without built-in terms. If the body fails, they are removed again."""
    before, places = set(_terms), []

    def new() -> list[Place]:
        return [place for place in _terms if place not in before and place not in _BUILT_IN]

    try:
        yield places
    except BaseException:
        forget(new())
        raise
    places += new()


def forget(places: Iterable[Place]) -> None:
    """Remove terms from the registry."""
    for place in places:
        _terms.pop(place, None)


def replace(place: Place, term: Term) -> None:
    """Replace the term of a registered name."""
    _terms[place] = term


def names(room: Room) -> tuple[str, ...]:
    """Return all names of a room, sorted."""
    return tuple(sorted({name for r, name in [*_BUILT_IN, *_terms] if r == room}))


def own_names(room: Room) -> tuple[str, ...]:
    """Return the names of a room that are not built in, sorted."""
    return tuple(sorted(name for r, name in _terms if r == room and (r, name) not in _BUILT_IN))


def notes(places: Iterable[Place]) -> Iterator[str]:
    """Yield the notes of these terms; most have none."""
    for room, name in dict.fromkeys(places):
        note = find(room, name).note
        if note:
            yield f"{name}: {note}"


def find(room: Room, name: str) -> Term:
    """Return the term of that name.

    Raises:
        InputError: there is none. The message gives the nearest known name, and says how a user's own term is loaded.
    """
    if (room, name) not in _terms and (room, name) in _BUILT_IN:
        import_module(_BUILT_IN[room, name])
    if (room, name) not in _terms:
        known = nearest(name, names(room))
        raise InputError(f"{room} '{name}' does not exist; {known}{'' if known.endswith('?') else '.'} {OWN}")
    return _terms[room, name]
