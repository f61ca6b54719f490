"""The layout of a posterior's tree: its variables by group, with their dimensions and their source in a frame's result.

A chain is an independent run of the filter, a draw is a particle. Both the tree in memory and the file follow this layout.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.posterior.mixing import PREFIX
from bayes_body.tracking.draws import Draws, FrameResult

# Dimensions of those figures of Markov chains that do not have one value for each chain.
MARKOV_DIMS: Mapping[str, tuple[str, ...]] = {"ess": ("dof",), "length": ()}


@dataclass(frozen=True)
class Variable:
    """One array of the tree.

    Attributes:
        group: `posterior`, `sample_stats` or `filter`.
        name: its name in the group.
        dims: its dimensions, including `frame`.
        of: function that takes its values from a frame's result; they have all dimensions except `frame`.
    """

    group: str
    name: str
    dims: tuple[str, ...]
    of: Callable[[FrameResult], Any]

    @property
    def frame_axis(self) -> int:
        """Index of the dimension `frame`."""
        return self.dims.index("frame")

    def stack(self, frames: Sequence[FrameResult]) -> NDArray[Any]:
        """Return its values in several frames, with the axis `frame` at `frame_axis`."""
        return np.stack([np.asarray(self.of(frame)) for frame in frames], axis=self.frame_axis)


def variables(draws: Draws) -> list[Variable]:
    """Return all arrays of the tree."""
    by_draw, by_frame, markov = ("chain", "draw", "frame"), ("chain", "frame"), draws.frames[0].info.markov
    info = {"ess": "ess", "log_evidence": "log_evidence", "lost": "lost", "evaluations": "evaluations"}
    layers = {"survival_rate": "survival_rate", "inverse_temperature": "inverse_temperatures", "acceptance_rate": "acceptance_rate"}
    return [
        *(Variable("posterior", name, (*by_draw, *_dims(name, values)), _state(name)) for name, values in draws.frames[0].states.items()),
        Variable("sample_stats", "log_weight", by_draw, lambda frame: frame.log_weights),
        Variable("sample_stats", "ancestor", by_draw, lambda frame: frame.info.ancestors),
        *(Variable("filter", name, by_frame, _info(field)) for name, field in info.items()),
        *(Variable("filter", name, (*by_frame, "layer"), _info(field)) for name, field in layers.items()),
        *(Variable("filter", PREFIX + name, (*by_frame, *MARKOV_DIMS.get(name, ("markov_chain",))), _markov(name)) for name in markov),
        Variable("filter", "seen", ("frame", "camera"), lambda frame: frame.seen),
    ]


def _dims(name: str, values: NDArray[Any]) -> tuple[str, ...]:
    """Return the dimensions of one draw of a state's variable."""
    return ("dof",) if name == "pose" else tuple(f"{name}_dim_{axis}" for axis in range(values.ndim - 2))


def _state(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.states[name]


def _info(field: str) -> Callable[[FrameResult], Any]:
    return lambda frame: getattr(frame.info, field)


def _markov(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.info.markov[name]


def sizes(draws: Draws) -> dict[str, int]:
    """Return the size of every dimension."""
    found = {"frame": len(draws.frames)}
    for variable in variables(draws):
        without = [dim for dim in variable.dims if dim != "frame"]
        found |= dict(zip(without, np.shape(variable.of(draws.frames[0])), strict=True))
    return found


def coordinates(draws: Draws, dims: Sequence[str]) -> dict[str, tuple[str, NDArray[Any] | list[str]]]:
    """Return the coordinates by name, each as (dimension, values); `unit` is the unit of each dof."""
    topology, lengths = draws.model.body.skeleton.topology, sizes(draws)
    labels: Mapping[str, list[str]] = {"dof": list(topology.dof_names), "camera": list(draws.cameras)}
    found: dict[str, tuple[str, NDArray[Any] | list[str]]] = {dim: (dim, labels.get(dim, np.arange(lengths[dim]))) for dim in dims}
    return found | ({"unit": ("dof", list(topology.dof_units))} if "dof" in dims else {})


def groups(draws: Draws) -> dict[str, list[Variable]]:
    """Return the variables by group."""
    found: dict[str, list[Variable]] = {}
    for variable in variables(draws):
        found.setdefault(variable.group, []).append(variable)
    return found


def dims_of(members: Sequence[Variable]) -> list[str]:
    """Return the dimensions of a group, without repetition."""
    return list(dict.fromkeys(dim for variable in members for dim in variable.dims))


def attributes_of(draws: Draws, attributes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the attributes of the whole tree."""
    return {"model": draws.model.definition.name, **(attributes or {})}
