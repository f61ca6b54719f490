"""True marker positions beside a session: an .npz with `markers` (frame, marker, 3), metres in the session's world, and `names` of the markers.

The markers are the fifteen with which errors are measured; unknown positions are NaN.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.recording.evidence.markers import MARKERS

KIND = "an .npz with `markers` (frame, 15, 3), metres, and `names`, the 15 markers' names"
REMEDY = "write it with numpy.savez(path, markers=..., names=...)"
# As for a session's positions: a larger number is assumed to be in millimetres.
FARTHEST_M = 1000.0


def read_truth(path: Path, frames: int, skipped: int = 0) -> Float[np.ndarray, "frame 15 3"]:
    """The true markers of a session's frames, in the order of `MARKERS`, metres; NaN where unknown.

    Args:
        path: the file; it may contain more frames.
        frames: the session's number of frames.
        skipped: number of the recording's frames before the session's first one.

    Raises:
        InputError: no such file, malformed, too few frames, or not in metres.
    """
    arrays = read_arrays(path, ("markers", "names"), KIND, REMEDY)
    markers, names = (_array(path, arrays, key) for key in ("markers", "names"))
    order = _order(path, names)
    if markers.ndim != 3 or markers.shape[1:] != (len(order), 3) or markers.dtype.kind not in "fiu":
        raise input_error(f"{path}: markers", f"{markers.dtype} of shape {markers.shape}", f"numbers of shape (frame, {len(order)}, 3)", REMEDY)
    if len(markers) < skipped + frames:
        remedy = "add the missing frames (NaN where unknown), or lower frames in session.toml"
        expected = f"{skipped + frames}, as the session has{' with those before it' if skipped else ''}"
        raise input_error(f"{path}: markers", f"{len(markers)} frames", expected, remedy)
    positions = markers[skipped : skipped + frames, order].astype(np.float64)
    if np.isinf(positions).any():
        raise input_error(f"{path}: markers", "an infinite position", "metres, or NaN where unknown", "correct it")
    farthest = float(np.nanmax(np.abs(positions), initial=0.0))
    if farthest > FARTHEST_M:
        raise input_error(
            f"{path}: markers", f"a position of {farthest:g}", f"metres, at most {FARTHEST_M:g}", "it looks like millimetres, divide by 1000"
        )
    return positions


def _order(path: Path, names: NDArray[np.generic]) -> list[int]:
    """The index of each of `MARKERS` in the file."""
    file_names = [str(name) for name in names.ravel()] if names.dtype.kind == "U" else []
    if names.ndim != 1 or sorted(file_names) != sorted(MARKERS):
        missing, surplus = [name for name in MARKERS if name not in file_names], [name[:40] for name in file_names[:50] if name not in MARKERS]
        problem = f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(surplus) or 'none'}" if file_names else "not a list of strings"
        raise input_error(f"{path}: names", f"{problem} ({len(file_names)} names)", f"each of {', '.join(MARKERS)} once", REMEDY)
    return [file_names.index(name) for name in MARKERS]


def _array(path: Path, arrays: Mapping[str, NDArray[np.generic]], key: str) -> NDArray[np.generic]:
    if key not in arrays:
        raise input_error(path, f"no `{key}`", KIND, REMEDY)
    return arrays[key]
