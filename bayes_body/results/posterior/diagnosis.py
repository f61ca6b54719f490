"""The diagnostic figures of a run, and the limits beyond which there is a warning."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.results.posterior.joint import JointFit
from bayes_body.results.posterior.message_passing import MessagePassing
from bayes_body.results.posterior.mixing import Mixing

if TYPE_CHECKING:
    import xarray as xr

# Attribute of a tree: whether its kernel declares that its particles are a sample of the posterior.
SAMPLES_POSTERIOR = "samples_posterior"
# Prefix of the names of the figures of the kernel `laplace` in the tree's group `filter`.
MODES = "laplace_"
# Numbers of frames over which ancestors are traced back.
LAGS = (1, 5, 10)


@dataclass(frozen=True)
class Thresholds:
    """Limits beyond which a figure gives a warning.

    Attributes:
        ess_share: smallest number of effective particles of a frame, as a fraction of the particles.
        ess: smallest number of effective particles of a frame. Below either limit, means and quantiles rest on too few particles. With 50, the
            standard error of the mean is 1/7 of the posterior's standard deviation.
        pareto_k: largest k of a frame's weights (Vehtari et al. 2024).
        ancestors: smallest number of particles of the frame before that have descendants.
        rhat: largest R-hat. Vehtari et al. (2021) recommend 1.01 for long chains; the runs of a filter are short. The means of two runs are then half
            a posterior standard deviation apart.
        rhat_share: smallest share of a frame's dofs that must not exceed it. Of many dofs, a few exceed it by chance.
        rhat_single: R-hat of a single dof from which there is a warning whatever the others: the means are further apart than one standard deviation.
        evidence_sd: largest standard deviation over the runs of the log-evidence, nats. At this value, noise hides Bayes factors below e².
        markov_rhat: largest R-hat over the Markov chains of a frame, which are even shorter.
        divergent_share: largest fraction of a frame's trajectories that diverge.
        energy_fraction: smallest E-BFMI of a frame's chains, mean over the chains (Betancourt 2016).
        acceptance: smallest and largest acceptance rate of a frame's Markov moves, mean over runs and layers.
        belief_ess_share: smallest number of effective particles of a belief, as a fraction of the particles of a node.
        message_ess_share: the same for a message.
        message_change: largest change of a belief's mean in the last iteration, standard deviations of the belief.
        oscillation: largest jump back of a belief's mean in the last iteration, likewise.
        joint_ess: smallest number of effective joint draws of message passing.
        near_limit_share: largest share of frames in which a dof of the Gaussian of all frames is near its limit.
    """

    markov_rhat: float = 1.1
    divergent_share: float = 0.01
    energy_fraction: float = 0.3
    ess_share: float = 0.02
    ess: float = 50.0
    pareto_k: float = 0.7
    ancestors: float = 10.0
    rhat: float = 1.05
    rhat_share: float = 0.95
    rhat_single: float = 1.2
    evidence_sd: float = 2.0
    acceptance: tuple[float, float] = (0.15, 0.98)
    belief_ess_share: float = 0.05
    message_ess_share: float = 0.02
    message_change: float = 0.5
    oscillation: float = 1.0
    joint_ess: float = 10.0
    near_limit_share: float = 0.1


@dataclass(frozen=True)
class Diagnosis:
    """Figures of a run in every frame. A figure that does not exist is NaN.

    Attributes:
        kernel: the kernel's name; empty if the tree does not have it.
        particles: number of particles of a run.
        dofs: names of the dofs; if there is no pose, those of the coordinates of the state's variables, such as `torso_x` and `torso_rx`.
        ess: effective sample size of the weights, particles. For Markov chains it is computed from their autocorrelation, as the minimum over dofs.
        pareto_k: tail shape of the weights; -∞ where the largest weights are all the same.
        ancestors: for each lag, the number of particles `lag` frames before that have descendants.
        lags: numbers of frames back.
        acceptance_rate: fraction of a layer's Markov moves that were accepted.
        rhat: rank-normalised R-hat over the runs.
        independent_draws: number of independent draws to which a run is equivalent, from the variance of the runs' means.
        log_evidence: log-evidence of each frame given the frames before it, nats, up to the likelihood's constant.
        lost: frames that no particle explained.
        seen: whether a camera's image was used; None if the run does not record it.
        cameras: names of the cameras, or numbers if the run has no names.
        mixing: figures of the Markov chains of each frame; None if the kernel runs none.
        messages: figures of message passing in each frame; None if the kernel passes no messages.
        smoothed: whether a draw is a path of a smoother, which took its states from a filter with this kernel.
        first_frame: number of the first frame in the recording.
        declared_sample: whether the kernel declares that its particles are a sample of the posterior; None if it does not say.
        attempts: how the kernel `laplace` did a frame at last: 0 at first, 1 again from more starts, 2 by the kernel `tempered`; None for others.
        attempt_k: tail shape of the weights in the last attempt of the kernel `laplace`, also where its draws count equally; None for others.
        joint: figures of the Gaussian of all frames from which the paths are drawn; None if they are not.
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
    messages: MessagePassing | None = None
    smoothed: bool = False
    first_frame: int = 0
    declared_sample: bool | None = None
    attempts: Int[np.ndarray, "run frame"] | None = None
    attempt_k: Float[np.ndarray, "run frame"] | None = None
    joint: JointFit | None = None

    @property
    def redone(self) -> tuple[float, float]:
        """The shares of frames, over all runs, that were done again from more starts and by the kernel `tempered`; NaN for other kernels."""
        if self.attempts is None:
            return float("nan"), float("nan")
        return float((self.attempts == 1).mean()), float((self.attempts == 2).mean())

    def doubtful_share(self, most_k: float) -> float:
        """Return the share of frames, over all runs, that `laplace` did and that no normal distribution fits well: a few weights dominate."""
        if self.attempts is None or self.attempt_k is None:
            return float("nan")
        return float(((self.attempts < 2) & (self.attempt_k > most_k)).mean())

    @property
    def mode_seeker(self) -> bool:
        """Whether the kernel is a mode seeker (`is_mode_seeker`)."""
        return _seeks_modes(self.declared_sample, self.log_evidence)

    @property
    def evidence_by_run(self) -> Float[np.ndarray, " run"]:
        """The log-evidence of the whole recording, nats; NaN or -∞ if a frame has none."""
        return self.log_evidence.sum(axis=1)

    @property
    def evidence_sd(self) -> float:
        """Standard deviation of `evidence_by_run` over the runs, nats; NaN with a single run, or if a run has no evidence."""
        return float(_sd(self.evidence_by_run[:, None])[0])

    @property
    def evidence_sd_frames(self) -> Float[np.ndarray, " frame"]:
        """Standard deviation of each frame's log-evidence over the runs, nats."""
        return _sd(self.log_evidence)


def is_mode_seeker(tree: "xr.DataTree") -> bool:
    """Return whether the kernel of a posterior's tree is a mode seeker: its particles are not a sample of the posterior.

    The kernel declares it. One that does not say, as in trees of older versions, is a mode seeker if it estimates no evidence.
    """
    return _seeks_modes(declared_sample(tree), np.asarray(tree["filter"]["log_evidence"], float))


def declared_sample(tree: "xr.DataTree") -> bool | None:
    """Return whether the kernel of a posterior's tree declares that its particles are a sample of the posterior; None if it does not say."""
    declared = tree.attrs.get(SAMPLES_POSTERIOR)
    return None if declared is None else bool(declared)


def _seeks_modes(declared: bool | None, log_evidence: Float[np.ndarray, "run frame"]) -> bool:
    return bool(np.isnan(log_evidence).all()) if declared is None else not declared


def first_frame_of(tree: "xr.DataTree") -> int:
    """Return the number of the first frame of a posterior's tree in the recording."""
    coordinates = tree["posterior"].coords
    numbers = np.asarray(coordinates["frame"]) if "frame" in coordinates else np.zeros(0)
    return int(numbers[0]) if numbers.size and numbers.dtype.kind in "iu" else 0


def _sd(values: Float[np.ndarray, "run k"]) -> Float[np.ndarray, " k"]:
    out = np.full(values.shape[1], np.nan)
    if values.shape[0] > 1:
        is_finite = np.isfinite(values).all(axis=0)
        out[is_finite] = values[:, is_finite].std(axis=0, ddof=1)
    return out
