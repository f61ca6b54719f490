"""Figures of a kernel that passes messages between the nodes of a graph, such as the parts of a body: from the tree's group `filter`.

kernels/messages/messages.py has their formulas.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    import xarray as xr

# Stands for the dimension of the nodes, which has the name of the variable's first axis, such as `part`.
NODE = "node"
# The figures of `FilterInfo.messages` and their dimensions after (chain, frame).
DIMS: dict[str, tuple[str, ...]] = {
    "samples": (),
    "belief_ess": (NODE,),
    "message_ess": (),
    "message_change": ("iteration", NODE),
    "belief_sd": ("iteration", NODE, "tangent"),
    "oscillation": (NODE,),
    "joint_ess": (),
    "proposal_shares": (NODE, "proposal"),
}
# The entries of `proposal`.
PARTS = ("messages", "prior", "detections", "fit")


class MessagePassing(NamedTuple):
    """The figures in every frame.

    Attributes:
        nodes: names of the nodes, or numbers if they have none.
        units: units of the tangent coordinates; empty if they are unknown.
        samples: number of particles of a node.
        belief_ess: effective sample size of every belief after the last iteration.
        message_ess: the smallest of all messages, after the last iteration.
        change: how far the mean of every belief moved in each iteration, in its standard deviations.
        sd: standard deviations of every belief after each iteration, metres and radians.
        oscillation: how far the mean of every belief jumped back in the last iteration, in its standard deviations.
        joint_ess: effective sample size of the joint draws.
        proposal_shares: share of each part of the proposal (`PARTS`) in the weight of the particles of every node.
    """

    nodes: tuple[str, ...]
    units: tuple[str, ...]
    samples: int
    belief_ess: Float[np.ndarray, "run frame node"]
    message_ess: Float[np.ndarray, "run frame"]
    change: Float[np.ndarray, "run frame iteration node"]
    sd: Float[np.ndarray, "run frame iteration node tangent"]
    oscillation: Float[np.ndarray, "run frame node"]
    joint_ess: Float[np.ndarray, "run frame"]
    proposal_shares: Float[np.ndarray, "run frame node part"]

    @property
    def last_change(self) -> Float[np.ndarray, "run frame node"]:
        """How far the mean of every belief moved in the last iteration."""
        return self.change[:, :, -1]


def message_passing_of(tree: "xr.DataTree") -> MessagePassing | None:
    """Return the figures of a posterior's tree; None if its kernel passes no messages."""
    group: Any = tree["filter"]
    if any(name not in group for name in DIMS):
        return None
    figures = {name: np.asarray(group[name], float) for name in DIMS}
    node = group["belief_ess"].dims[-1]
    nodes = group[node] if node in group.coords else np.arange(figures["belief_ess"].shape[-1])
    units = tuple(np.asarray(group["tangent_unit"]).astype(str).tolist()) if "tangent_unit" in group.coords else ()
    return MessagePassing(
        nodes=tuple(np.asarray(nodes).astype(str).tolist()),
        units=units or ("",) * figures["belief_sd"].shape[-1],
        samples=int(figures["samples"].max()),
        belief_ess=figures["belief_ess"],
        message_ess=figures["message_ess"],
        change=figures["message_change"],
        sd=figures["belief_sd"],
        oscillation=figures["oscillation"],
        joint_ess=figures["joint_ess"],
        proposal_shares=figures["proposal_shares"],
    )


def worst_of_messages(figures: MessagePassing) -> dict[str, float]:
    """Return the worst figure of each kind over runs, frames and nodes; NaN for one that does not exist."""
    return {
        "belief_ess_min": _least(figures.belief_ess),
        "message_ess_min": _least(figures.message_ess),
        "message_change_last": -_least(-figures.last_change),
        "oscillation_max": -_least(-figures.oscillation),
        "joint_ess_min": _least(figures.joint_ess),
    }


def _least(values: np.ndarray) -> float:
    finite_values = values[np.isfinite(values)]
    return float(finite_values.min()) if finite_values.size else float("nan")
