"""A frame as named arrays, without Python objects, and the digest of them.

The names are `states.NAME`, `log_weights`, `info.FIELD`, `markov.NAME`, `messages.NAME`, `figures.NAME`, `seen`, `seconds`, `seconds_ready`,
`restarted`; and the frame's place: `run`, `number` and `before`. The digest is of all of them.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.density.kernel import FilterInfo
from bayes_body.tracking.draws import FrameResult

# Fields of a kernel's diagnostics that are mappings.
MAPPINGS = ("markov", "messages")


class Place(NamedTuple):
    """Where a frame belongs: the run's id, the frame's number, and the digest of the frame before it (empty for the first one)."""

    run: str
    number: int
    before: str


class Stored(NamedTuple):
    """A frame that was read, where it belongs, and its digest."""

    result: FrameResult
    place: Place
    digest: str


def arrays_of(result: FrameResult, place: Place) -> dict[str, NDArray[Any]]:
    """Return the arrays of a frame."""
    arrays: dict[str, Any] = {f"states.{name}": values for name, values in result.states.items()}
    arrays |= {f"info.{name}": values for name, values in result.info._asdict().items() if name not in MAPPINGS}
    for mapping in MAPPINGS:
        arrays |= {f"{mapping}.{name}": values for name, values in getattr(result.info, mapping).items()}
    arrays |= {f"figures.{name}": values for name, values in result.figures.items()}
    arrays |= {name: getattr(result, name) for name in ("log_weights", "seen", "seconds", "seconds_ready", "restarted")}
    return {name: np.asarray(values) for name, values in (arrays | place._asdict()).items()}


def place_of(arrays: Mapping[str, NDArray[Any]]) -> Place:
    """Return where a frame belongs.

    Raises:
        KeyError, TypeError, ValueError: the arrays are not those of a frame.
    """
    return Place(str(arrays["run"]), int(arrays["number"]), str(arrays["before"]))


def result_of(arrays: Mapping[str, NDArray[Any]]) -> FrameResult:
    """Return the frame of its arrays.

    Raises:
        KeyError, TypeError, ValueError: the arrays are not those of a frame.
    """
    info: dict[str, Any] = {name: arrays[f"info.{name}"] for name in FilterInfo._fields if name not in MAPPINGS}
    info |= {mapping: _under(f"{mapping}.", arrays) for mapping in MAPPINGS}
    return FrameResult(
        states=_under("states.", arrays),
        log_weights=arrays["log_weights"],
        info=FilterInfo(**info),
        seen=arrays["seen"],
        seconds=float(arrays["seconds"]),
        seconds_ready=float(arrays["seconds_ready"]),
        restarted=arrays["restarted"],
        figures=_under("figures.", arrays),
    )


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the arrays: names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = arrays[name]
        digest.update(f"{name!r} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
