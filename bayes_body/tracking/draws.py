"""The results of filters on the host, frame by frame: in memory, or read from disk on demand."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.density.kernel import FilterInfo
from bayes_body.model.build import Model


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The results of all runs for one frame.

    Attributes:
        states: by variable, (run, particle, ...).
        log_weights: normalised over the particles of a run.
        info: the kernel's diagnostics, each field with a leading axis (run,).
        seen: whether each camera saw the frame.
        seconds: wall-clock time of the frame, all runs together, without `seconds_ready`.
        seconds_ready: time until a program was compiled; 0 except for the first frame of a process, and the first that a kernel's fallback does.
        restarted: whether each run was lost before and started anew at this frame; empty if no run did.
        figures: figures of all particles, if only some of them are stored (`posterior.thinning`); else empty.
    """

    states: dict[str, NDArray[Any]]
    log_weights: Float[np.ndarray, "run particle"]
    info: FilterInfo
    seen: Bool[np.ndarray, " camera"]
    seconds: float
    seconds_ready: float = 0.0
    restarted: Bool[np.ndarray, " run"] = field(default_factory=lambda: np.zeros(0, bool))
    figures: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def lost(self) -> bool:
        """Whether at least one run could not explain the frame."""
        return bool(np.asarray(self.info.lost).any())


@runtime_checkable
class Frames(Protocol):
    """Frames in order: a list, or files."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> FrameResult: ...

    def __iter__(self) -> Iterator[FrameResult]: ...


@runtime_checkable
class FrameStore(Frames, Protocol):
    """Frames to which more can be appended."""

    def append(self, result: FrameResult, /) -> None:
        """Store the next frame."""
        ...

    def extend(self, results: Sequence[FrameResult], /) -> None:
        """Store the next frames."""
        ...


@runtime_checkable
class ThinningStore(FrameStore, Protocol):
    """A store that may hold only some particles of a frame, but all of the last one."""

    @property
    def last(self) -> FrameResult:
        """The last frame with all its particles, from which the filters go on."""
        ...


@dataclass(frozen=True)
class Timing:
    """Total wall-clock seconds, and the part of them until the program was ready (traced, and compiled or loaded from the cache)."""

    total: float
    compile: float

    def plus(self, frame: FrameResult) -> "Timing":
        """Return the time with that of one more frame."""
        return Timing(self.total + frame.seconds + frame.seconds_ready, self.compile + frame.seconds_ready)


@dataclass(frozen=True, eq=False)
class Draws:
    """The draws of a tracked session.

    Attributes:
        model: the model that tracked the session.
        frames: the filters' results.
        timing: seconds, over all processes that worked on these frames.
        cameras: the cameras' names.
        kernel: the kernel's name; empty if it has none.
        warnings: the remarks of `bayes_body.track` on the result, which the command line prints at its end.
        first_frame: number of the first frame in the recording (`Session.frame_number`).
        smoothed: whether a draw is a path of a smoother.
        declared_sample: whether the kernel declares that its particles are a sample of the posterior; None for a kernel without a name.
    """

    model: Model
    frames: Frames
    timing: Timing
    cameras: tuple[str, ...]
    first_frame: int = 0
    kernel: str = ""
    warnings: tuple[str, ...] = ()
    declared_sample: bool | None = None
    smoothed: bool = False

    @property
    def samples_posterior(self) -> bool:
        """Whether the particles are a sample of the posterior. A kernel that does not declare it counts as a mode seeker if it has no evidence."""
        if self.declared_sample is not None:
            return self.declared_sample
        return not all(np.isnan(np.asarray(frame.info.log_evidence, float)).all() for frame in self.frames)

    @property
    def runs(self) -> int:
        """Number of independent filters."""
        return self.frames[0].log_weights.shape[0]

    @property
    def particles(self) -> int:
        """Number of particles of a run."""
        first = self.frames[0]
        return int(first.figures["particles"][0]) if first.figures else first.log_weights.shape[1]

    @property
    def states(self) -> dict[str, NDArray[Any]]:
        """The states by variable, (run, frame, particle, ...), all in memory at once."""
        return {name: np.stack([frame.states[name] for frame in self.frames], axis=1) for name in self.frames[0].states}

    @property
    def log_weights(self) -> Float[np.ndarray, "run frame particle"]:
        """The log-weights, normalised over the particles, all in memory at once."""
        return np.stack([frame.log_weights for frame in self.frames], axis=1)

    @property
    def info(self) -> FilterInfo:
        """The kernel's diagnostics, each field with leading axes (run, frame), all in memory at once."""
        return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *[frame.info for frame in self.frames])

    @property
    def frames_lost(self) -> list[int]:
        """Frames that at least one run could not explain, or that no camera saw."""
        return [index for index, frame in enumerate(self.frames) if frame.lost]

    @property
    def frames_restarted(self) -> list[int]:
        """Frames at which at least one run started anew, because it had lost the person."""
        return [index for index, frame in enumerate(self.frames) if frame.restarted.any()]

    @property
    def frames_unseen(self) -> dict[str, list[int]]:
        """For each camera, the frames that it did not see."""
        unseen: dict[str, list[int]] = {name: [] for name in self.cameras}
        for index, frame in enumerate(self.frames):
            for name, is_visible in zip(self.cameras, frame.seen, strict=True):
                if not is_visible:
                    unseen[name].append(index)
        return unseen


def timing_of(frames: Frames) -> Timing:
    """Return the sum of the frames' seconds."""
    timing = Timing(0.0, 0.0)
    for frame in frames:
        timing = timing.plus(frame)
    return timing
