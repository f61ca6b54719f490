"""Build a model from a definition and a session: arrays in metres and radians, and one density for every frame."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.geometry.camera import Camera, stack, turning_radius
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import find
from bayes_body.base.shapes import Configuration, Key, Pose
from bayes_body.density.density import Density
from bayes_body.density.factor import Data, Factor, Particles, State, Transition, variables
from bayes_body.density.graph import Mixture
from bayes_body.density.kernel import NamedKernel
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.placed_body import loosened, placed_markers
from bayes_body.model.body.placement import PARTS
from bayes_body.model.body.solids import Body
from bayes_body.model.definition import Definition, evidence_of, load_body, load_definition
from bayes_body.model.first import First, first_of
from bayes_body.model.kernel_options import check_options, few_cameras, kernel_of, kernel_options
from bayes_body.model.unknown_terms import check_read, unknowns_of
from bayes_body.model.unknowns.apply import factor_with, settled_factor, transition_with, with_changes
from bayes_body.model.unknowns.lengths import OVERALL
from bayes_body.model.unknowns.unknown import SIDES, Setting, Unknown
from bayes_body.recording.session.session import CameraSpec, Session, Subject

# Beginnings of the names of the tables of a subject that are measures of the body.
MEASURES = ("lengths_", "radii_", "sections", "outline_radii_", "keypoint_offsets_")
# Seconds after which the pose of a person who was seen is as uncertain as one that was found in pictures.
FOUND_S = 0.25


@dataclass(frozen=True)
class Model:
    """A definition applied to one session.

    Attributes:
        definition: the definition that it was built from.
        body: the body of the session's subject.
        rig: the session's cameras, stacked.
        transition: the motion prior at the session's frame rate.
        after_found: the motion prior of the first frame after a pose that was found in pictures: the same one over FOUND_S seconds, if it is a random
            walk. Such a pose is about as uncertain as that of a person who was seen so long ago.
        factors: all other terms.
        first: the distribution of the state before the first frame.
        observers: for each factor that uses images, a function from a frame's images to the factor's arrays (on the host).
        cameras: number of the session's cameras that have what the likelihoods read.
        unknowns: what is not known exactly: variables of the state that change the factors' bodies and cameras.
        corrected: of a settled model, what its state does to the session's cameras; None if that is nothing.
    """

    definition: Definition
    body: Body
    rig: Camera
    transition: Transition
    after_found: Transition
    factors: tuple[Factor, ...]
    first: First
    observers: Mapping[str, Callable[[Any], Any]]
    cameras: int = 1
    unknowns: tuple[Unknown, ...] = ()
    corrected: Callable[[Camera], Camera] | None = None

    @property
    def reads(self) -> list[str]:
        """What its likelihoods compare the body with (`definition.evidence_of`)."""
        return sorted(evidence_of(self.definition))

    @property
    def reads_pictures(self) -> bool:
        """Whether a likelihood compares the body with more than keypoints, or detectors look for it.

        Only then are pictures decoded to learn which cameras see a frame.
        """
        return self.reads != ["keypoints"] or bool(self.definition.detectors)

    @property
    def reads_before(self) -> bool:
        """Whether a factor reads the frame before, so that frames are to be read with it (`read_frame`)."""
        return any(factor.reads_previous for factor in self.factors)

    def observe(self, frame: Any) -> Data:
        """Convert a frame's images (`observation.frames.Frame`) to the arrays that the factors need, by factor name."""
        return {name: observer(frame) for name, observer in self.observers.items()}

    def density(self, observation: Data, previous: Particles | None = None, proposals: tuple[Mixture, ...] = ()) -> Density:
        """Return the posterior of a frame as a log-density of the state.

        Args:
            observation: the result of `observe`.
            previous: the particles of the previous frame; by default one particle, the initial state.
            proposals: where to look for the parts of the body (`Density.proposals`).
        """
        last = Particles(jax.tree.map(lambda leaf: leaf[None], dict(self.initial)), self._equal(1)) if previous is None else previous
        return Density(self.transition, self.factors, jax.tree.map(jnp.asarray, observation), last, proposals)

    def kernel(self, kind: str | None = None, /, **changes: Any) -> NamedKernel:
        """Return the kernel of the definition, or the one that replaces it for a single camera, with single options changed.

        Args:
            kind: another kernel's name, such as `sir`, which then has its own defaults; by default the definition's.
            changes: options that replace those of the definition, such as `particles=500`.

        Raises:
            InputError: there is no such kernel, it has no such option, or an option's value is not allowed.
        """
        few = few_cameras(self.definition.kernel.kind, self.cameras)
        check_options(kind or (few.kernel if few else self.definition.kernel.kind), changes)
        kind, options = kernel_options(self.definition, kind, changes, cameras=self.cameras)
        return kernel_of(kind, options)

    def at(self, cameras: Sequence[CameraSpec]) -> "Model":
        """Return the same model with other camera positions, for a frame of moving cameras. Shapes do not change, so nothing is compiled again."""
        rig = stack([_camera(spec) for spec in cameras])
        rig = rig if self.corrected is None else self.corrected(rig)

        def placed(node: Any) -> Any:
            return rig if isinstance(node, Camera) else node

        factors = jax.tree.map(placed, self.factors, is_leaf=lambda node: isinstance(node, Camera))
        return replace(self, rig=rig, factors=factors)

    def beginning_at(self, pose: Pose, draws: Float[Array, "draw dof"] | None = None) -> "Model":
        """Return the same model with another first pose, or with several equally likely ones of which `pose` is the main one."""
        dtype = self.body.lengths.dtype
        return replace(self, first=self.first.centred_on(jnp.asarray(pose, dtype), None if draws is None else jnp.asarray(draws, dtype)))

    @property
    def first_pose(self) -> Pose:
        """The most likely joint angles before the first frame, radians and metres."""
        return self.first.pose

    @property
    def initial(self) -> State:
        """The state of the most likely first pose."""
        return self.first.mode

    def start(self, count: int, key: Key | None = None) -> Particles:
        """Return `count` equal particles of the state before the first frame, whose transition spreads them further.

        Args:
            count: number of particles.
            key: random key, needed only if the first pose is uncertain (`Model.first`); by default that of seed 0.
        """
        key = jax.random.key(0) if key is None else key
        states = _start_evenly(self.first, key, count) if self.unknowns else self.first.start(key, count)
        return Particles(states, self._equal(count))

    def _equal(self, count: int) -> Float[Array, " particle"]:
        return device_array(np.full(count, -math.log(count)), self.body.lengths.dtype)

    @property
    def placing(self) -> tuple[str, ...]:
        """The variables that say where the body's markers are: that which places the body, and unknowns that change the body."""
        return (self.body.variable, *(term.name for term in self._body_terms))

    @property
    def _body_terms(self) -> tuple[Unknown, ...]:
        return tuple(term for term in self.unknowns if term.node is Body and term.sides == SIDES)

    def body_in(self, state: State) -> Body:
        """Return the body of a state: that of the subject, changed by what the state says of its lengths and widths."""
        return with_changes(tuple(term for term in self._body_terms if term.name in state), self.body, variables(state))

    def rig_in(self, state: State) -> Camera:
        """Return the cameras of a state: those of the session, moved by what the state says of them."""
        return self._corrected(state, self.rig)

    def _corrected(self, state: State, rig: Camera) -> Camera:
        return with_changes(tuple(term for term in self.unknowns if term.node is Camera and term.name in state), rig, variables(state))

    def settled(self, state: State) -> "Model":
        """Return the model with the body and the cameras of a state, such as a mean, for pictures and for the fit to a frame. It has no unknowns."""
        if not self.unknowns:
            return self
        factors = tuple(settled_factor(factor, state) for factor in self.factors)
        corrected = partial(self._corrected, state)
        return replace(self, body=self.body_in(state), rig=corrected(self.rig), factors=factors, unknowns=(), corrected=corrected)

    def markers(self, configuration: Configuration) -> Float[Array, "marker 3"]:
        """Return the world positions of the body's virtual markers, metres. `configuration` is a state's variable `body.variable`, such as `pose`."""
        return _markers(self.body, configuration)


_markers = jax.jit(placed_markers)
_start_evenly = jax.jit(First.start_evenly, static_argnames="count")


def build_model(name: str | Path | Definition, session: Session) -> Model:
    """Build the model of that name (or path) for a session. It starts from the angles that the session gives; nothing is fitted.

    `initial.load_model` does more: it also fits the first pose, and refuses a session without one.

    Raises:
        InputError: the definition or the session's subject cannot be used.
    """
    definition = name if isinstance(name, Definition) else load_definition(name)
    cameras, subject = _cameras(definition, session), _measures(session.subject, definition)
    body = body_of(definition, Shape(subject.height_m, subject.lengths_m, subject.radii_m, subject.sections, subject.outline_radii_m))
    rig = stack([_camera(view.camera) for view in session.views])
    factors, observers = _likelihoods(definition, body, rig)
    for index, term in enumerate(definition.constraints):
        name = f"{term.kind}_{index + 1}" if index else term.kind
        factors.append(find("potential", term.kind).build(name=name, options=term.options, body=body))
    names = tuple(view.camera.name for view in session.views)
    uncertainties = tuple(view.uncertainty for view in session.views)
    has_height, measured = subject.height_m is not None, frozenset(subject.lengths_m)
    setting = Setting(body, definition.body, rig, names, session.fps, has_height, measured, subject, uncertainties)
    unknowns = unknowns_of(definition, setting, cameras)
    gaps = (1.0, max(1.0, FOUND_S * session.fps))
    transition, after_found = (transition_with(_transition(definition, body, session, gap), unknowns) for gap in gaps)
    first = first_of(definition.first, body, _initial_pose(session, body, definition), transition)
    _check_derived(transition, first.mode)
    check_read(unknowns, factors, first.mode)
    changed = tuple(factor_with(factor, unknowns) for factor in factors)
    return Model(definition, body, rig, transition, after_found, changed, first, observers, cameras, unknowns)


def _cameras(definition: Definition, session: Session) -> int:
    """Return how many cameras have what the likelihoods read."""
    if evidence_of(definition) != ["keypoints"]:
        return len(session.views)
    return sum(session.keypoints_path(view) is not None for view in session.views)


def with_likelihoods(model: Model, name: str | Path | Definition) -> Model:
    """Return the model with the likelihoods of another definition, on the same body and with the same constraints.

    Raises:
        InputError: there is no such definition, or a likelihood does not fit the body's placement.
    """
    definition = name if isinstance(name, Definition) else load_definition(name)
    likelihoods, observers = _likelihoods(definition, model.body, model.rig)
    factors = [factor_with(factor, model.unknowns) for factor in likelihoods]
    prior_factors = [factor for factor in model.factors if factor.side != "likelihood"]
    return replace(model, factors=(*factors, *prior_factors), observers=observers)


def _transition(definition: Definition, body: Body, session: Session, gap: float) -> Transition:
    """Return the motion prior over a number of frames, which only random walks heed."""
    dynamics, subject_sd = definition.dynamics, _motion_sd(session.subject, definition)
    return find("dynamics", dynamics.kind).build(options=dynamics.options, body=body, fps=session.fps, subject_sd=subject_sd, gap=gap)


def body_of(definition: Definition, shape: Shape = Shape()) -> Body:
    """Return the body of a definition for a subject's shape, placed as the definition says.

    Raises:
        InputError: the shape or the placement does not fit the body.
    """
    body = build_body(definition.body_name, definition.body, shape)
    return loosened(body) if definition.placement == PARTS else body


def _likelihoods(definition: Definition, body: Body, rig: Camera) -> tuple[list[Factor], dict[str, Callable[[Any], Any]]]:
    factors, observers = [], {}
    for index, term in enumerate(definition.likelihoods):
        name = f"{term.kind}_{index + 1}" if index else term.kind
        factors.append(find("likelihood", term.kind).build(name=name, options=term.options, body=body, rig=rig))
        observers[name] = find("observation", term.kind).build(options=term.observation, likelihood=term.options, markers=body.markers.names)
    return factors, observers


def _check_derived(transition: Transition, initial: State) -> None:
    """Check that no variable is both sampled and derived. Only names matter, so nothing is computed."""
    overlap: list[str] = []
    jax.eval_shape(lambda prior, state: overlap.extend(sorted(set(prior.conditional(state)) & set(prior.derive(state)))), transition, dict(initial))
    if overlap:
        problem, expected = f"the variable '{overlap[0]}' is sampled, and it is derived too", "each variable in one of the two"
        raise input_error(f"dynamics '{transition.name}'", problem, expected, "leave it out of `derive`, or out of `conditional`")


def _measures(subject: Subject, definition: Definition) -> Subject:
    """Return what is said of the subject, as far as it applies to this body."""
    if not definition.takes_measures_of(subject.body):
        # Lengths of another body do not apply here, but a height applies to every body.
        return Subject(height_m=subject.height_m)
    if subject.body is None or subject.body != definition.body.measured_as:
        return subject
    # A smaller body may lack parts of the other body.
    schema = definition.body
    known = {*schema.lengths_of_height, *(part.name for part in schema.parts), *schema.markers, OVERALL}

    def restrict[Value](measures: Mapping[str, Value]) -> dict[str, Value]:
        return {name: value for name, value in measures.items() if name in known}

    tables = [table.name for table in fields(subject) if table.name.startswith(MEASURES)]
    return replace(subject, **{name: restrict(getattr(subject, name)) for name in tables})


def _motion_sd(subject: Subject, definition: Definition) -> Mapping[str, float]:
    return subject.motion_sd if definition.takes_measures_of(subject.body) else {}


def _camera(spec: CameraSpec) -> Camera:
    return Camera(
        rotation=device_array(spec.rotation),
        translation=device_array(spec.translation_m),
        focal=device_array(spec.focal_px),
        centre=device_array(spec.centre_px),
        skew=device_array(spec.skew),
        distortion=device_array(spec.distortion),
        radius_max=device_array(turning_radius(np.asarray(spec.distortion))),
        size=device_array(spec.size_px),
    )


def _initial_pose(session: Session, body: Body, definition: Definition) -> Pose:
    """Return the angles of the session's first pose. A missing dof starts at the middle of its limits, or at 0 if it has none."""
    larger = definition.body.measured_as
    known = [definition.body, *([load_body(larger)] if larger else [])]
    also = {dof.name for schema in known for joint in schema.joints for dof in joint.dofs}
    for name in session.initial:
        # A fixed dof keeps its value. A smaller body may lack dofs of the body whose names the subject uses.
        if name not in body.dof_names and name not in also:
            raise InputError(f"session.toml: initial: '{name}' is not a dof of the body '{body.name}'; {nearest(name, body.dof_names)}")
    low, high = np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(bounded, (np.where(bounded, low, 0) + np.where(bounded, high, 0)) / 2, 0.0)
    values = np.array([session.initial.get(name, default) for name, default in zip(body.dof_names, middle, strict=True)])
    for name, value, least, most in zip(body.dof_names, values, low, high, strict=True):
        if not least <= value <= most:
            # In the units of the session's file.
            unit, factor = ("degrees", 180 / np.pi) if name in _angles(body) else ("m", 1.0)
            quantity, limits = f"{factor * value:.4g} {unit}", f"{factor * least:.4g} and {factor * most:.4g} {unit}"
            expected = f"a value between {limits}, the limits of the body '{body.name}'"
            raise input_error(
                f"session.toml: initial: '{name}'", quantity, expected, "correct the initial pose, or widen the limits in your own body file"
            )
    return jnp.asarray(values, body.lengths.dtype)


def _angles(body: Body) -> set[str]:
    topology = body.skeleton.topology
    return {name for name, angular in zip(topology.dof_names, topology.angular, strict=True) if angular}
