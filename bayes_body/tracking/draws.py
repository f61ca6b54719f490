"""What filters leave behind, on the host: a value for each frame, held in memory or read from the disk when it is asked for."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.density.kernel import FilterInfo
from bayes_body.model.build import Model


@dataclass(frozen=True, eq=False)
class FrameResult:
    """One frame of all runs.

    Attributes:
        states: by variable, (run, particle, ...).
        log_weights: normalised over the particles of a run.
        info: each field with leading (run,).
        seen: whether each camera saw the frame.
        seconds: wall-clock time that the frame took, all runs together, without `seconds_ready`.
        seconds_ready: before it, until the program of a frame was ready; 0 but for the first frame that a process works on.
    """

    states: dict[str, NDArray[Any]]
    log_weights: Float[np.ndarray, "run particle"]
    info: FilterInfo
    seen: Bool[np.ndarray, " camera"]
    seconds: float
    seconds_ready: float = 0.0

    @property
    def lost(self) -> bool:
        """Whether at least one run could not explain it."""
        return bool(np.asarray(self.info.lost).any())


@runtime_checkable
class Frames(Protocol):
    """Frames in order: a list, or files."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> FrameResult: ...

    def __iter__(self) -> Iterator[FrameResult]: ...


@runtime_checkable
class FrameStore(Frames, Protocol):
    """Frames that take one more."""

    def append(self, result: FrameResult, /) -> None:
        """Keep the next frame."""
        ...


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds: all of it, and therein until the program of a frame was ready (traced, and compiled or loaded from the cache)."""

    total: float
    compile: float


@dataclass(frozen=True, eq=False)
class Draws:
    """What was tracked.

    Attributes:
        model: what was tracked with.
        frames: what the filters made of each frame.
        timing: seconds, of all processes that worked on these frames.
        cameras: the cameras' names.
    """

    model: Model
    frames: Frames
    timing: Timing
    cameras: tuple[str, ...]

    @property
    def runs(self) -> int:
        """Independent filters."""
        return self.frames[0].log_weights.shape[0]

    @property
    def particles(self) -> int:
        """Particles a run."""
        return self.frames[0].log_weights.shape[1]

    @property
    def states(self) -> dict[str, NDArray[Any]]:
        """By variable, (run, frame, particle, ...): all in memory at once."""
        return {name: np.stack([frame.states[name] for frame in self.frames], axis=1) for name in self.frames[0].states}

    @property
    def log_weights(self) -> Float[np.ndarray, "run frame particle"]:
        """Normalised over the particles: all in memory at once."""
        return np.stack([frame.log_weights for frame in self.frames], axis=1)

    @property
    def info(self) -> FilterInfo:
        """Each field with leading (run, frame): all in memory at once."""
        return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *[frame.info for frame in self.frames])

    @property
    def frames_lost(self) -> list[int]:
        """Frames that at least one run could not explain, or that no camera saw."""
        return [index for index, frame in enumerate(self.frames) if frame.lost]

    @property
    def frames_unseen(self) -> dict[str, list[int]]:
        """By camera, the frames that it did not see."""
        unseen: dict[str, list[int]] = {name: [] for name in self.cameras}
        for index, frame in enumerate(self.frames):
            for name, seen in zip(self.cameras, frame.seen, strict=True):
                if not seen:
                    unseen[name].append(index)
        return unseen


def timing_of(frames: Frames) -> Timing:
    """The seconds that the frames tell of."""
    total = ready = 0.0
    for frame in frames:
        total, ready = total + frame.seconds + frame.seconds_ready, ready + frame.seconds_ready
    return Timing(total, ready)
