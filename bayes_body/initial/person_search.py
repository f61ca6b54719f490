"""Find the person of a session in single frames, from the pictures alone: detectors, and a search for a loose-limbed body (initial/search.py).

A single frame does not always tell where a person faces. Where the other way has a share of the weight, `Found.turned` says so.
"""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.body.placement import placed_markers
from bayes_body.detection.detect import Detected, detect
from bayes_body.initial.proposals import proposals_of
from bayes_body.initial.search import Search, search
from bayes_body.kernels.parts.batching import everywhere
from bayes_body.model.build import build_model
from bayes_body.observation.frames import read_frame
from bayes_body.recording.camera_path import cameras_at
from bayes_body.session.session import Session

# The loose-limbed body that is searched for.
LOOSE = "loose_limbed_15"
# Draws whose markers are on average so near, metres, are of one mode.
MODE_M = 0.12


class Found(NamedTuple):
    """A person found in a frame.

    Attributes:
        names: names of the markers.
        markers: their weighted mean over the draws of the main mode, metres.
        sd_m: root mean square distance of these draws' markers from the mean, metres.
        elsewhere: share of the weight that is not in the main mode.
        turned: share of the weight that faces the other way.
        ess: effective number of draws.
        log_evidence: log-evidence of the search; a person who is not there has a lower one.
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
    notices: tuple[str, ...]
    seconds: dict[str, float]


class PersonSearch:
    """Searches frames of one session for its person. It compiles once, at the first frame."""

    def __init__(self, session: Session, loose: str = LOOSE):
        """Take the session, and the loose-limbed model of which bodies are drawn: its likelihoods read single parts, and its joints propose."""
        self.session = session
        self.model = build_model(loose, session)
        self.search = jax.jit(search)
        self.markers = jax.jit(lambda parts: jax.lax.map(lambda one: placed_markers(self.model.body, one), parts))

    def frame(self, index: int, seed: int = 0) -> Found | Detected:
        """Return the person of a frame; what was detected, if that does not say where the body's first part may be.

        Args:
            index: the frame, counted from 0.
            seed: seed of the draws.

        Raises:
            InputError: there is no such frame, or a file of the session cannot be used.
        """
        detected = detect(self.session, index)
        begun = time.perf_counter()
        model = self.model.at(cameras_at(self.session, index)) if self.session.moves else self.model
        roots = proposals_of(detected, model.body)[0]
        if not bool(roots.exists[0]):
            return detected
        density = model.density(model.observe(read_frame(self.session, index)), model.start(1))
        key = jax.random.fold_in(jax.random.key(seed), index)
        drawn = jax.device_get(self.search(everywhere(key), everywhere(density), everywhere(roots)))
        return self._found(drawn, detected, time.perf_counter() - begun)

    def _found(self, drawn: Search, detected: Detected, seconds: float) -> Found:
        names = self.model.body.markers.names
        markers, weights = np.asarray(self.markers(jnp.asarray(drawn.parts)), float), np.exp(np.asarray(drawn.log_weights, float))
        # The main mode: draws near the one that is nearest to all others by weight.
        apart = np.stack([np.linalg.norm(markers - one, axis=2).mean(1) for one in markers])
        centre = int(np.argmin(apart @ weights))
        near = apart[centre] < MODE_M
        kept = weights * near / (weights @ near)
        mean = np.einsum("d,dmk->mk", kept, markers)
        sd_m = float(np.sqrt(np.einsum("d,dmk->m", kept, (markers - mean) ** 2).mean()))
        left = markers[:, names.index("l_hip")] - markers[:, names.index("r_hip")]
        turned = float(weights @ (left @ left[centre] < 0))
        times = {**detected.seconds, "search": seconds}
        ess, evidence = float(drawn.ess), float(drawn.log_evidence)
        return Found(names, mean, sd_m, float(weights @ ~near), turned, ess, evidence, detected.notices, times)
