"""The layout of a posterior's tree: its variables by group, with their dimensions and their source in a frame's result.

A chain is an independent run of the filter, a draw is a particle. Both the tree in memory and the file follow this layout.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.density.spaces import Axis, Flat, Plate, Space, space_to_text
from bayes_body.results.posterior.blocks import SPACE
from bayes_body.results.posterior.diagnosis import MODES, SAMPLES_POSTERIOR
from bayes_body.results.posterior.joint import JOINT
from bayes_body.results.posterior.message_passing import DIMS, NODE, PARTS
from bayes_body.results.posterior.mixing import PREFIX
from bayes_body.results.posterior.thinning import INDEPENDENT, MARKOV_RHAT, MEAN, OF_ALL, RHAT
from bayes_body.tracking.draws import Draws, FrameResult

# Fields of a kernel's diagnostics that have another name in the tree.
RENAMED = {"inverse_temperatures": "inverse_temperature"}
# Name and text of the attribute of a tree whose draws have weights.
WEIGHTS = "weights"
WEIGHTED = "the draws have weights (sample_stats/log_weight): use bayes_body.equal_weight(tree) before az.summary, which ignores them"


@dataclass(frozen=True)
class Variable:
    """One array of the tree.

    Attributes:
        group: `posterior`, `sample_stats` or `filter`.
        name: its name in the group.
        dims: its dimensions, including `frame`.
        read: function that takes its values from a frame's result; they have all dimensions except `frame`.
        attributes: what is stored beside it, such as the space of a state's variable.
    """

    group: str
    name: str
    dims: tuple[str, ...]
    read: Callable[[FrameResult], Any]
    attributes: Mapping[str, str] = field(default_factory=dict)

    @property
    def frame_axis(self) -> int:
        """Index of the dimension `frame`."""
        return self.dims.index("frame")

    def stack(self, frames: Sequence[FrameResult]) -> NDArray[Any]:
        """Return its values in several frames, with the axis `frame` at `frame_axis`."""
        return np.stack([np.asarray(self.read(frame)) for frame in frames], axis=self.frame_axis)


def variables(draws: Draws) -> list[Variable]:
    """Return all arrays of the tree."""
    by_draw, by_frame, markov = ("chain", "draw", "frame"), ("chain", "frame"), draws.frames[0].info.markov
    messages = draws.frames[0].info.messages
    spaces = _spaces(draws)
    info = {"ess": "ess", "log_evidence": "log_evidence", "lost": "lost", "evaluations": "evaluations"}
    layers = {RENAMED.get(field, field): field for field in ("survival_rate", "inverse_temperatures", "acceptance_rate")}
    return [
        *(
            Variable("posterior", name, (*by_draw, *space_dims(name, space)), _state(name), {SPACE: space_to_text(space)})
            for name, space in spaces.items()
        ),
        Variable("sample_stats", "log_weight", by_draw, lambda frame: frame.log_weights),
        Variable("sample_stats", "ancestor", by_draw, lambda frame: frame.info.ancestors),
        *(Variable("filter", name, by_frame, _info(field)) for name, field in info.items()),
        *(Variable("filter", name, (*by_frame, "layer"), _info(field)) for name, field in layers.items()),
        *(
            Variable("filter", PREFIX + name, (*by_frame, *_markov_dims(name, np.shape(values), spaces)), _markov(name))
            for name, values in markov.items()
        ),
        *(
            Variable("filter", name, (*by_frame, *(_node(spaces) if dim == NODE else dim for dim in dims)), _message(name))
            for name, dims in DIMS.items()
            if name in messages
        ),
        *(Variable("filter", MODES + name, by_frame, _modes(name)) for name in draws.frames[0].info.modes),
        *(
            Variable("filter", JOINT + name, (*by_frame, *(_entry_dims(draws, spaces) if np.ndim(values) > 1 else ())), _joint(name))
            for name, values in draws.frames[0].info.joint.items()
        ),
        Variable("filter", "seen", ("frame", "camera"), lambda frame: frame.seen),
        *(Variable("filter", OF_ALL + name, _figure_dims(name, spaces), _figure(name)) for name in draws.frames[0].figures),
    ]


def place_in_tree(name: str) -> str:
    """Return the group and the name in the tree of an array of a frame (`storage.frame_arrays`), such as `filter/ess`; empty if the tree lacks it."""
    kind, _, key = name.partition(".")
    places = {
        "states": f"posterior/{key}",
        "log_weights": "sample_stats/log_weight",
        "info": "sample_stats/ancestor" if key == "ancestors" else f"filter/{RENAMED.get(key, key)}",
        "markov": f"filter/{PREFIX}{key}",
        "messages": f"filter/{key}" if key in DIMS else "",
        "modes": f"filter/{MODES}{key}",
        "joint": f"filter/{JOINT}{key}",
        "figures": f"filter/{OF_ALL}{key}",
        "seen": "filter/seen",
    }
    return places.get(kind, "")


def frame_axis_of(name: str) -> int:
    """Return the axis of the frames in the tree of an array of a frame."""
    kind, _, key = name.partition(".")
    if kind in ("states", "log_weights") or name == "info.ancestors":
        return 2
    return 0 if kind == "seen" or (kind == "figures" and not _is_by_run(key)) else 1


def _is_by_run(figure: str) -> bool:
    """Whether a figure of all particles is one of each run."""
    return figure != INDEPENDENT and not figure.startswith(RHAT)


def _figure_dims(name: str, spaces: Mapping[str, Space]) -> tuple[str, ...]:
    """Return the dimensions of a figure of all particles."""
    dims = ("chain", "frame") if _is_by_run(name) else ("frame",)
    for variable, space in spaces.items():
        if name == MEAN + variable:
            return (*dims, *space_dims(variable, space))
        if name in (RHAT + variable, MARKOV_RHAT + variable):
            return (*dims, f"{variable}_coordinate")
    return dims


def _figure(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.figures[name]


def _spaces(draws: Draws) -> dict[str, Space]:
    """Return where each variable of a state lives."""
    return {name: draws.model.transition.space(name, values.shape[2:]) for name, values in draws.frames[0].states.items()}


def space_dims(name: str, space: Space) -> tuple[str, ...]:
    """Return the dimensions of one draw of a state's variable."""
    return tuple(axis.name or f"{name}_dim_{place}" for place, axis in enumerate(space.axes))


def _markov_dims(name: str, shape: tuple[int, ...], spaces: Mapping[str, Space]) -> tuple[str, ...]:
    """Return the dimensions of a figure of Markov chains. Effective draws are those of the pose, or of sampled entries that have no names."""
    if name == "ess":
        return ("dof",) if "pose" in spaces and spaces["pose"].shape == shape[1:] else ("sampled",)
    return () if name == "length" else ("markov_chain",)


def _node(spaces: Mapping[str, Space]) -> str:
    """Return the dimension of the nodes of a graph: the first one of the plated variable."""
    return next((space_dims(name, space)[0] for name, space in spaces.items() if isinstance(space, Plate)), NODE)


def _state(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.states[name]


def _info(field: str) -> Callable[[FrameResult], Any]:
    return lambda frame: getattr(frame.info, field)


def _markov(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.info.markov[name]


def _message(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.info.messages[name]


def _entry_dims(draws: Draws, spaces: Mapping[str, Space]) -> tuple[str, ...]:
    """Return the dimensions of the variable that places the body."""
    variable = draws.model.body.variable
    return space_dims(variable, spaces[variable])


def _joint(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.info.joint[name]


def _modes(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.info.modes[name]


def sizes(draws: Draws) -> dict[str, int]:
    """Return the size of every dimension."""
    lengths = {"frame": len(draws.frames)}
    for variable in variables(draws):
        without = [dim for dim in variable.dims if dim != "frame"]
        lengths |= dict(zip(without, np.shape(variable.read(draws.frames[0])), strict=True))
    return lengths


def coordinates(draws: Draws, dims: Sequence[str]) -> dict[str, tuple[str, NDArray[Any] | list[str]]]:
    """Return the coordinates by name, each as (dimension, values); those of `unit_name` are the units of a dimension's entries."""
    lengths, axes = sizes(draws), _axes(draws)
    labels: dict[str, Any] = {dim: list(axis.labels) for dim, axis in axes.items() if axis.labels} | {"camera": list(draws.cameras)}
    labels |= {"frame": draws.first_frame + np.arange(lengths["frame"])}
    if "iteration" in lengths:
        labels |= {"iteration": np.arange(1, lengths["iteration"] + 1)}
    by_name: dict[str, tuple[str, NDArray[Any] | list[str]]] = {dim: (dim, labels.get(dim, np.arange(lengths[dim]))) for dim in dims}
    return by_name | {unit_name(dim): (dim, list(axes[dim].units)) for dim in dims if dim in axes and any(axes[dim].units)}


def unit_name(dim: str) -> str:
    """Return the name of the coordinate with the units of a dimension's entries."""
    return "unit" if dim == "dof" else f"{dim}_unit"


def _axes(draws: Draws) -> dict[str, Axis]:
    """Return the axes of the state's variables by dimension, and those of message passing.

    Raises:
        ValueError: two variables name the same dimension and label it differently.
    """
    axes: dict[str, Axis] = {}
    spaces = _spaces(draws)
    for name, space in spaces.items():
        for dim, axis in zip(space_dims(name, space), space.axes, strict=True):
            if axes.setdefault(dim, axis) != axis:
                raise ValueError(f"the axis '{dim}' of the variable '{name}' has other labels than that of another variable")
        if isinstance(space, Plate) and draws.frames[0].info.messages:
            # A number for each part, such as its log-length, belongs to the part's node (density/sized_nodes.py).
            sizes = tuple(name for name, flat in spaces.items() if isinstance(flat, Flat) and flat.labels == space.names)
            units = (*space.space.tangent_units, *[""] * len(sizes))
            axes["tangent"] = Axis("tangent", (*space.space.tangent_labels, *sizes), units)
            axes["proposal"] = Axis("proposal", PARTS)
    return axes


def groups(draws: Draws) -> dict[str, list[Variable]]:
    """Return the variables by group."""
    by_group: dict[str, list[Variable]] = {}
    for variable in variables(draws):
        by_group.setdefault(variable.group, []).append(variable)
    return by_group


def dims_of(members: Sequence[Variable]) -> list[str]:
    """Return the dimensions of a group, without repetition."""
    return list(dict.fromkeys(dim for variable in members for dim in variable.dims))


def attributes_of(draws: Draws, attributes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the attributes of the whole tree."""
    smoothed = {"smoothed": 1} if draws.smoothed else {}
    named = {"model": draws.model.definition.name, **({"kernel": draws.kernel} if draws.kernel else {}), **smoothed, **(attributes or {})}
    thinned = {"thinned_from": draws.particles} if draws.frames[0].figures else {}
    # A path of a smoother and a draw of a Markov chain have equal weights.
    weighted = not named.get("smoothed") and not draws.frames[0].info.markov
    declared = {} if draws.declared_sample is None else {SAMPLES_POSTERIOR: int(draws.declared_sample)}
    return named | declared | thinned | ({WEIGHTS: WEIGHTED} if weighted else {})
