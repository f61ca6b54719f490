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

# Dimensions of the figures of Markov chains that are not one figure a chain.
MARKOV_DIMS: Mapping[str, tuple[str, ...]] = {"ess": ("dof",), "length": ()}


@dataclass(frozen=True)
class Variable:
    """One array of the tree.

    Attributes:
        group: `posterior`, `sample_stats` or `filter`.
        name: in its group.
        dims: its dimensions, `frame` among them.
        of: takes its values from a frame's result; they have all dimensions but `frame`.
    """

    group: str
    name: str
    dims: tuple[str, ...]
    of: Callable[[FrameResult], Any]

    @property
    def frame_axis(self) -> int:
        """Which of the dimensions is `frame`."""
        return self.dims.index("frame")

    def stack(self, frames: Sequence[FrameResult]) -> NDArray[Any]:
        """Its values in some frames, with the axis `frame` in its place."""
        return np.stack([np.asarray(self.of(frame)) for frame in frames], axis=self.frame_axis)


def variables(draws: Draws) -> list[Variable]:
    """All arrays of the tree."""
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
    """The dimensions of one draw of a state's variable."""
    return ("dof",) if name == "pose" else tuple(f"{name}_dim_{axis}" for axis in range(values.ndim - 2))


def _state(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.states[name]


def _info(field: str) -> Callable[[FrameResult], Any]:
    return lambda frame: getattr(frame.info, field)


def _markov(name: str) -> Callable[[FrameResult], Any]:
    return lambda frame: frame.info.markov[name]


def sizes(draws: Draws) -> dict[str, int]:
    """The size of every dimension."""
    found = {"frame": len(draws.frames)}
    for variable in variables(draws):
        without = [dim for dim in variable.dims if dim != "frame"]
        found |= dict(zip(without, np.shape(variable.of(draws.frames[0])), strict=True))
    return found


def coordinates(draws: Draws, dims: Sequence[str]) -> dict[str, tuple[str, NDArray[Any] | list[str]]]:
    """The labels of each dimension, by name: (dimension, values); `unit` is the unit of each dof."""
    topology, lengths = draws.model.body.skeleton.topology, sizes(draws)
    labels: Mapping[str, list[str]] = {"dof": list(topology.dof_names), "camera": list(draws.cameras)}
    found: dict[str, tuple[str, NDArray[Any] | list[str]]] = {dim: (dim, labels.get(dim, np.arange(lengths[dim]))) for dim in dims}
    return found | ({"unit": ("dof", list(topology.dof_units))} if "dof" in dims else {})


def groups(draws: Draws) -> dict[str, list[Variable]]:
    """The variables by group."""
    found: dict[str, list[Variable]] = {}
    for variable in variables(draws):
        found.setdefault(variable.group, []).append(variable)
    return found


def dims_of(members: Sequence[Variable]) -> list[str]:
    """The dimensions of a group, each once."""
    return list(dict.fromkeys(dim for variable in members for dim in variable.dims))


def attributes_of(draws: Draws, attributes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Attributes of the whole tree."""
    return {"model": draws.model.definition.name, **(attributes or {})}
