"""The diagnostic figures of a run, and the limits beyond which a reader is warned."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.posterior.mixing import Mixing

if TYPE_CHECKING:
    import xarray as xr

# Frames back to which ancestors are counted.
LAGS = (1, 5, 10)


@dataclass(frozen=True)
class Thresholds:
    """Limits beyond which a figure becomes a warning.

    Attributes:
        ess_share: least effective particles of a frame, as a share of the particles...
        ess: ...and as a number: below either, means and quantiles rest on too few. With 50 the mean is known to 1/7 of the posterior's sd.
        pareto_k: largest k of a frame's weights (Vehtari et al. 2024).
        ancestors: least particles of the frame before that have descendants.
        rhat: largest R-hat. Vehtari et al. (2021) ask for 1.01 of long chains; the runs of a filter are short.
        evidence_sd: largest standard deviation over the runs of the log-evidence, nats: a Bayes factor below e² is not seen through it.
        markov_rhat: largest R-hat over the Markov chains of a frame, which are shorter still.
        divergent_share: largest share of a frame's trajectories that may diverge.
        energy_fraction: least E-BFMI of a frame's chains, the mean of them (Betancourt 2016).
        acceptance: least and largest acceptance rate of a frame's Markov moves, mean over runs and layers.
    """

    markov_rhat: float = 1.1
    divergent_share: float = 0.01
    energy_fraction: float = 0.3
    ess_share: float = 0.02
    ess: float = 50.0
    pareto_k: float = 0.7
    ancestors: float = 10.0
    rhat: float = 1.05
    evidence_sd: float = 2.0
    acceptance: tuple[float, float] = (0.15, 0.98)


@dataclass(frozen=True)
class Diagnosis:
    """Figures of a run, frame by frame. What does not exist is NaN.

    Attributes:
        kernel: the kernel's name; empty where the tree does not say.
        particles: a run.
        dofs: names.
        ess: effective sample size of the weights, particles; of Markov chains by their autocorrelation, the least of all dofs.
        pareto_k: tail shape of the weights; -∞ where the largest weights are all the same.
        ancestors: by lag, how many particles of `lags` frames before have descendants.
        lags: frames back.
        acceptance_rate: share of a layer's Markov moves that were accepted.
        rhat: rank-normalised R-hat over the runs.
        independent_draws: how many independent draws a run is worth, from the variance of the runs' means.
        log_evidence: of each frame given those before, nats, up to the likelihood's constant.
        lost: frames that no particle explained.
        seen: whether a camera's image was of use; None where the run does not say.
        cameras: names, or numbers where the run has no names.
        mixing: of the Markov chains of each frame; None where the kernel runs none.
    """

    kernel: str
    particles: int
    dofs: tuple[str, ...]
    ess: Float[np.ndarray, "run frame"]
    pareto_k: Float[np.ndarray, "run frame"]
    ancestors: Float[np.ndarray, "lag run frame"]
    lags: tuple[int, ...]
    acceptance_rate: Float[np.ndarray, "run frame layer"]
    rhat: Float[np.ndarray, "frame dof"]
    independent_draws: Float[np.ndarray, " frame"]
    log_evidence: Float[np.ndarray, "run frame"]
    lost: Bool[np.ndarray, "run frame"]
    seen: Bool[np.ndarray, "frame camera"] | None
    cameras: tuple[str, ...]
    mixing: Mixing | None = None

    @property
    def mode_seeker(self) -> bool:
        """Whether the kernel is a mode seeker (`is_mode_seeker`)."""
        return bool(np.isnan(self.log_evidence).all())

    @property
    def evidence_by_run(self) -> Float[np.ndarray, " run"]:
        """The log-evidence of the whole recording, nats; NaN or -∞ where a frame has none."""
        return self.log_evidence.sum(axis=1)

    @property
    def evidence_sd(self) -> float:
        """Standard deviation of that over the runs, nats; NaN with a single run, or where a run has none."""
        return float(_sd(self.evidence_by_run[:, None])[0])

    @property
    def evidence_sd_frames(self) -> Float[np.ndarray, " frame"]:
        """The same, frame by frame."""
        return _sd(self.log_evidence)


def is_mode_seeker(tree: "xr.DataTree") -> bool:
    """Whether the kernel of a posterior's tree estimates no evidence: its particles are then no sample of the posterior."""
    return bool(np.isnan(np.asarray(tree["filter"]["log_evidence"], float)).all())


def _sd(values: Float[np.ndarray, "run k"]) -> Float[np.ndarray, " k"]:
    out = np.full(values.shape[1], np.nan)
    if values.shape[0] > 1:
        known = np.isfinite(values).all(axis=0)
        out[known] = values[:, known].std(axis=0, ddof=1)
    return out
