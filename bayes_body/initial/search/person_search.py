"""Find the person of a session in single frames, from the pictures alone: detectors, and a search for a loose-limbed body (initial/search/search.py).

A single frame does not always tell which way a person faces. Both ways are therefore searched, with the same number of draws, and each way gets its
evidence. Frames that are near in time decide together (initial/search/search.py).
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.graph import Mixture
from bayes_body.initial.detection.detect import TRUSTED, Detected, detect
from bayes_body.initial.detection.detections import Detections, chosen
from bayes_body.initial.search.proposals import by_parts, frames_of, proposals_of
from bayes_body.initial.search.search import Way, search, shares_over_time, way_of
from bayes_body.kernels.batching import everywhere
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.solids import Body
from bayes_body.model.build import build_model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session

# The loose-limbed body that is searched for.
LOOSE = "loose_limbed_15"
# Draws belong to one mode if their markers are on average this near, metres. If fewer draws are effective in it, all draws of the way are used.
MODE_M, FEWEST_OF_MODE = 0.12, 5.0
# Number of frames that decide together which way the person faces, and seconds between them.
WINDOW, APART_S = 5, 0.2
# Below this mean resultant length the detected facings have no common axis.
UNDIRECTED = 1e-3


_search = jax.jit(search)


@jax.jit
def _markers(body: Body, parts: Float[Array, "draw part 7"]) -> Float[Array, "draw marker 3"]:
    return jax.lax.map(lambda draw: placed_markers(body, draw), parts)


class Searched(NamedTuple):
    """A frame that was searched.

    Attributes:
        detected: what was detected.
        ways: the draws, by the way they face; none if the detections do not say where the body's first part may be.
        seconds: the time of each detector, and of the search.
    """

    detected: Detected
    ways: tuple[Way, ...]
    seconds: dict[str, float]


class Found(NamedTuple):
    """A person found in a frame.

    Attributes:
        names: names of the markers.
        markers: their weighted mean over the draws of the main mode, metres; over all draws that face this way, if there is no such mode.
        sd_m: root mean square distance of these draws' markers from the mean, metres.
        elsewhere: share of the weight that is not in the main mode.
        turned: share of the weight that faces the other way.
        ess: effective number of draws of the main mode's way.
        log_evidence: log-evidence of the search; it is lower if no person is there.
        draws: markers of all draws, metres.
        weights: their weights, which sum to 1.
        notices: sentences of the detectors.
        seconds: the time of each detector, and of the search.
    """

    names: tuple[str, ...]
    markers: Float[np.ndarray, "marker 3"]
    sd_m: float
    elsewhere: float
    turned: float
    ess: float
    log_evidence: float
    draws: Float[np.ndarray, "draw marker 3"]
    weights: Float[np.ndarray, " draw"]
    notices: tuple[str, ...]
    seconds: dict[str, float]

    @property
    def precision(self) -> str:
        """How well the markers of the main mode are known, as part of a sentence."""
        return f"markers are known to {1000 * self.sd_m:.0f} mm (root mean square)"


class PersonSearch:
    """Searches frames of one session for its person, and keeps the frames that it has searched.

    It compiles at its first frame. Searches of sessions of one form, such as several recordings by one rig, share their programs.
    """

    def __init__(self, session: Session, loose: str = LOOSE, seed: int = 0):
        """Take the session, and the name of the loose-limbed model to draw from; its likelihoods read single parts, and its joints propose."""
        self.session, self.seed = session, seed
        self.model = build_model(loose, session)
        self.names = self.model.body.markers.names
        self.up = "xyz".index(session.up)
        self._frames = frames_of(self.model.body)
        # The motion prior plays no role: any particle will do.
        self._before = self.model.start(1)
        self._searched = dict[int, Searched]()

    def frame(self, index: int) -> Found | Detected:
        """Return the person of a frame, from this frame alone; or the detections, if they do not say where the body's first part may be.

        Args:
            index: the frame, counted from 0.

        Raises:
            InputError: there is no such frame, or a file of the session cannot be used.
        """
        return self._among(index, [index])

    def window(self, index: int) -> Found | Detected:
        """Return the person of a frame like `frame`; but WINDOW frames, APART_S seconds apart, decide which way the person faces.

        Args:
            index: the frame, counted from 0.

        Raises:
            InputError: there is no such frame, or a file of the session cannot be used.
        """
        step = max(1, round(APART_S * self.session.fps))
        frames_before, frames_after = index // step, (self.session.frames - 1 - index) // step
        last = min(frames_after, max(WINDOW // 2, WINDOW - 1 - frames_before))
        return self._among(index, [index + step * k for k in range(-min(frames_before, WINDOW - 1 - last), last + 1)])

    def _among(self, index: int, frames: Sequence[int]) -> Found | Detected:
        searched = {frame: self.searched(frame) for frame in frames}
        frame_search = searched[index]
        if not frame_search.ways:
            return frame_search.detected
        voting_frames = [frame for frame in frames if searched[frame].ways]
        shares = shares_over_time([searched[frame].ways for frame in voting_frames], [frame / self.session.fps for frame in voting_frames], self.up)
        return found_of(self.names, frame_search, shares[voting_frames.index(index)])

    def searched(self, index: int) -> Searched:
        """Return the draws of a frame by the way they face. A frame is searched once."""
        if index not in self._searched:
            self._searched[index] = self._search_frame(index)
        return self._searched[index]

    def _search_frame(self, index: int) -> Searched:
        begun = time.perf_counter()
        frame = read_frame(self.session, index)
        # Only the root is read from the detections. Limbs and head are drawn from the joints' densities.
        detected = detect(self.session, frame, TRUSTED)
        root = by_parts(self.model.body).names[0]
        halves = _by_facing(detected.parts.get(root), self.up)
        ways = list[Way]()
        if halves:
            model = self.model.at(frame.cameras) if self.session.moves else self.model
            density = everywhere(model.density(model.observe(frame), self._before))
            keys = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), index), len(halves))
            for key, (half, share) in zip(keys, halves, strict=True):
                roots = proposals_of(detected._replace(parts={root: half}, landmarks={}), model.body, self._frames)[0]
                ways.append(self._way(key, density, roots, share))
        return Searched(detected, tuple(ways), {**detected.seconds, "search": time.perf_counter() - begun - sum(detected.seconds.values())})

    def _way(self, key: Key, density: Density, roots: Mixture, share: float) -> Way:
        drawn = jax.device_get(_search(everywhere(key), density, everywhere(roots)))
        markers = np.asarray(_markers(self.model.body, jnp.asarray(drawn.parts)), float)
        evidence = float(drawn.log_evidence) + float(np.log(share))
        return way_of(self.names, markers, np.asarray(drawn.log_weights, float), evidence, float(drawn.ess), self.up)


def _by_facing(detections: Detections | None, up: int) -> list[tuple[Detections, float]]:
    """Return the detections of an upright part in two halves that face opposite ways, each with its share; one half if the other has no weight."""
    if detections is None or not len(detections.weights) or detections.rotations is None:
        return []
    level = [k for k in range(3) if k != up]
    forward = detections.rotations[:, :, 0][:, level]
    # Twice the angle is the same for both ways.
    doubled = detections.weights @ np.exp(2j * np.arctan2(forward[:, 1], forward[:, 0]))
    # If all directions are equally likely, any axis will do, but it must be the same on every machine.
    axis = np.angle(doubled) / 2 if abs(doubled) > UNDIRECTED else 0.0
    is_along_axis = forward @ (np.cos(axis), np.sin(axis)) >= 0
    shares = {side: float(detections.weights[is_along_axis == side].sum()) for side in (True, False)}
    return [(chosen(detections, np.flatnonzero(is_along_axis == side)), share) for side, share in shares.items() if share > 0]


def found_of(names: tuple[str, ...], searched: Searched, shares: Float[np.ndarray, " way"]) -> Found:
    """Return the person of a frame, given the share of each way to face."""
    ways = searched.ways
    markers = np.concatenate([way.markers for way in ways])
    weights = np.concatenate([share * np.exp(way.log_weights) for share, way in zip(shares, ways, strict=True)])
    main = ways[int(np.argmax(shares))]
    # The main mode: the draws near a central draw, whose weighted mean distance to all draws of its way is smallest.
    of_way = np.exp(main.log_weights)
    distances = np.stack([np.linalg.norm(main.markers - draw, axis=2).mean(1) for draw in main.markers])
    centre = int(np.argmin(distances @ of_way))
    in_mode = distances[centre] < MODE_M
    if (of_way @ in_mode) ** 2 < FEWEST_OF_MODE * (of_way**2 @ in_mode):
        in_mode[:] = True
    mode_weights = of_way * in_mode / (of_way @ in_mode)
    mean = np.einsum("d,dmk->mk", mode_weights, main.markers)
    sd_m = float(np.sqrt(np.einsum("d,dmk->m", mode_weights, (main.markers - mean) ** 2).mean()))
    hip_axis = markers[:, names.index("l_hip")] - markers[:, names.index("r_hip")]
    turned = float(weights @ (hip_axis @ (mean[names.index("l_hip")] - mean[names.index("r_hip")]) < 0))
    elsewhere = 1 - float(np.max(shares)) * float(of_way @ in_mode)
    evidence = float(np.logaddexp.reduce([way.log_evidence for way in ways]))
    return Found(names, mean, sd_m, elsewhere, turned, main.ess, evidence, markers, weights, searched.detected.notices, searched.seconds)
