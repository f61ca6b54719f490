r"""Which way a person faces, from several frames: the draws of a frame are kept by the way they face, and frames near in time vote.

Silhouettes tell little about front and back. A body and the same body turned round by 180 degrees may explain one frame about equally well. From
frame to frame the facing turns slowly, and people walk forwards. Let way k of frame t have the evidence $Z_{tk}$ and the facing angle $a_{tk}$. The
ways of all frames form a hidden Markov chain,

$$p(k_{1:T}) \propto \prod_t Z_{t k_t}^{\gamma}\, \exp\{\kappa_t \cos(a_{t k_t} - a_{t-1, k_{t-1}})\}\, m_t(a_{t k_t})^{1/T},$$

where m is the ratio of how often people move in the direction $a$ to how often they move in any direction, and the forward and backward recursions
give the share of each way (Rabiner 1989). The exponent $\gamma$ is below 1, because frames that are near in time misfit the model in the same way.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# How fast people turn, radians a second, and how well a frame's facing is known, radians: standard deviations.
TURN_RAD_S, FACING_RAD = 2.0, 0.35
# Share of the people who walk backwards or sideways, and the speed from which on a movement is a walk, metres a second; how closely walkers face
# where they walk: concentration of a von Mises distribution.
BACKWARDS, WALKS_M_S, STRAIGHT = 0.02, 0.3, 4.0
# γ
TRUST = 0.5


class Way(NamedTuple):
    """The draws of one frame that face one way.

    Attributes:
        markers: the draws' markers, metres.
        log_weights: their normalised log-weights.
        log_evidence: log-evidence of the frame, if the person faces this way.
        ess: effective number of draws.
        facing: horizontal direction to where the mean body faces, of length 1.
        place: the mean body's pelvis, metres.
    """

    markers: Float[np.ndarray, "draw marker 3"]
    log_weights: Float[np.ndarray, " draw"]
    log_evidence: float
    ess: float
    facing: Float[np.ndarray, "3"]
    place: Float[np.ndarray, "3"]


def way_of(names: Sequence[str], markers: np.ndarray, log_weights: np.ndarray, log_evidence: float, ess: float, up: int) -> Way:
    """Return the way that weighted draws of markers face: the mean over the draws of the direction that points left from hip to hip, turned ahead."""
    weights = np.exp(log_weights)
    hip_axis = markers[:, names.index("l_hip")] - markers[:, names.index("r_hip")]
    ahead = np.cross(hip_axis, np.eye(3)[up])
    ahead = weights @ (ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9))
    facing = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    return Way(markers, log_weights, log_evidence, ess, facing, weights @ markers[:, names.index("pelvis")])


def shares_over_time(frames: Sequence[Sequence[Way]], seconds: Sequence[float], up: int) -> list[Float[np.ndarray, " way"]]:
    """Return the share of each way of each frame, given all frames.

    Args:
        frames: the ways of each frame, in order of time; one or more a frame.
        seconds: when each frame was taken.
        up: index of the world's axis that points up.
    """
    log_potentials = [TRUST * np.array([way.log_evidence for way in ways]) for ways in frames]
    for frame, moved in enumerate(_movements(frames, seconds, up)):
        log_potentials[frame] = log_potentials[frame] + np.array([_log_forwards(way.facing, moved) for way in frames[frame]]) / len(frames)
    links = [_log_turns(frames[k], frames[k + 1], seconds[k + 1] - seconds[k]) for k in range(len(frames) - 1)]
    forward, backward = [log_potentials[0]], [np.zeros_like(log_potentials[-1])]
    for link, log_potential in zip(links, log_potentials[1:], strict=True):
        forward.append(log_potential + np.logaddexp.reduce(forward[-1][:, None] + link, axis=0))
    for link, later in zip(links[::-1], log_potentials[:0:-1], strict=True):
        backward.append(np.logaddexp.reduce(link + (later + backward[-1])[None], axis=1))
    both = [before + after for before, after in zip(forward, backward[::-1], strict=True)]
    return [np.exp(log_marginal - np.logaddexp.reduce(log_marginal)) for log_marginal in both]


def _log_turns(before: Sequence[Way], after: Sequence[Way], seconds: float) -> Float[np.ndarray, "before after"]:
    """Log-density, but for a constant, of the turns between two frames."""
    concentration = 1 / (FACING_RAD**2 + (TURN_RAD_S * seconds) ** 2)
    return concentration * np.array([[earlier_way.facing @ later_way.facing for later_way in after] for earlier_way in before])


def _movements(frames: Sequence[Sequence[Way]], seconds: Sequence[float], up: int) -> Float[np.ndarray, "frame 3"]:
    """Horizontal velocity of the person in each frame, metres a second; the ways of a frame are at about the same place."""
    if len(frames) < 2:
        return np.zeros((len(frames), 3))
    places = np.stack([np.mean([way.place for way in ways], axis=0) for ways in frames])
    places[:, up] = 0
    return np.gradient(places, np.asarray(seconds, float), axis=0)


def _log_forwards(facing: Float[np.ndarray, "3"], moved: Float[np.ndarray, "3"]) -> float:
    """Log of how many times likelier than any other direction it is that someone who faces so moves so."""
    speed = float(np.linalg.norm(moved))
    if speed < WALKS_M_S:
        return 0.0
    straight = np.exp(STRAIGHT * float(facing @ moved) / speed) / np.i0(STRAIGHT)
    return float(np.log((1 - BACKWARDS) * straight + BACKWARDS))
