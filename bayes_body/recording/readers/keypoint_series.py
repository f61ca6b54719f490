"""The subject's keypoints in all frames of one camera: an .npz beside a session, with

- `keypoints` (frame, keypoint, 3): column, row (pixels; NaN where not found) and confidence, between 0 and 1,
- `names` of the keypoints: those of `keypoint_layouts`, of the fifteen markers (recording/evidence/markers.py), or others, which are ignored,
- `first`, the number of the first row's frame in the camera's numbering; 0 if missing.
"""

from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.recording.readers.keypoints import FARTHEST_PX, MOST_KEYPOINTS

KIND = "an .npz with `keypoints` (frame, keypoint, 3), pixels and confidence, and `names` of the keypoints"
REMEDY = "import the keypoints again, or write it with numpy.savez(path, keypoints=..., names=...)"
# Names that detectors use for joint centres of a body.
MARKERS = {"neck": "thorax", "mid_hip": "pelvis"}
KEPT = 64


class KeypointSeries(NamedTuple):
    """The content of such a file (see the module)."""

    keypoints: Float[np.ndarray, "frame keypoint 3"]
    names: tuple[str, ...]
    first: int

    def frame(self, number: int) -> dict[str, tuple[float, float, float]]:
        """The keypoints found in a frame (camera's numbering), under the marker's name where the keypoint is a marker."""
        row = number - self.first
        if not 0 <= row < len(self.keypoints):
            return {}
        keypoints = self.keypoints[row]
        valid = np.isfinite(keypoints).all(axis=1) & (keypoints[:, 2] > 0)
        points = zip(self.names, keypoints.tolist(), valid.tolist(), strict=True)
        return {MARKERS.get(name, name): (column, line, confidence) for name, (column, line, confidence), is_valid in points if is_valid}


def write_series(path: Path, series: KeypointSeries) -> None:
    """Write the file; its folder is created if needed.

    Raises:
        InputError: it cannot be written.
    """
    make_folder(path.parent)
    with replacing(path) as partial:
        np.savez_compressed(partial, keypoints=series.keypoints.astype(np.float32), names=np.array(series.names), first=np.array(series.first))


def read_series(path: Path) -> KeypointSeries:
    """The keypoints of a file. The most recently read files are cached in memory.

    Raises:
        InputError: no such file, or malformed.
    """
    try:
        state = path.stat().st_mtime_ns, path.stat().st_size
    except OSError:
        state = 0, 0
    return _read(path, state)


@lru_cache(maxsize=KEPT)
def _read(path: Path, state: tuple[int, int]) -> KeypointSeries:
    del state
    arrays = read_arrays(path, ("keypoints", "names", "first"), KIND, REMEDY)
    for key in ("keypoints", "names"):
        if key not in arrays:
            raise input_error(path, f"no `{key}`", KIND, REMEDY)
    names = _names(path, arrays["names"])
    return KeypointSeries(_points(path, arrays["keypoints"], len(names)), names, _first(path, arrays.get("first", np.array(0))))


def _names(path: Path, names: NDArray[np.generic]) -> tuple[str, ...]:
    keypoint_names = tuple(str(name) for name in names.ravel()) if names.dtype.kind == "U" and names.ndim == 1 else ()
    mapped = [MARKERS.get(name, name) for name in keypoint_names]
    if not 0 < len(keypoint_names) <= MOST_KEYPOINTS or len(set(mapped)) < len(mapped):
        twice = next((name for name, count in Counter(mapped).items() if count > 1), None)
        what = f"'{twice[:40]}' twice" if twice is not None else f"{names.dtype} of shape {names.shape}"
        raise input_error(f"{path}: names", what, "unique names of the keypoints", REMEDY)
    return keypoint_names


def _points(path: Path, points: NDArray[np.generic], count: int) -> Float[np.ndarray, "frame keypoint 3"]:
    where = f"{path}: keypoints"
    if points.ndim != 3 or points.shape[1:] != (count, 3) or points.dtype.kind not in "fiu":
        raise input_error(where, f"{points.dtype} of shape {points.shape}", f"numbers of shape (frame, {count}, 3)", REMEDY)
    points = points.astype(np.float64)
    confidence = points[..., 2][np.isfinite(points[..., 2])]
    if confidence.size and (confidence.min() < 0 or confidence.max() > 1):
        raise input_error(where, f"a confidence of {max(confidence.max(), -confidence.min()):g}", "0 to 1", "divide by the largest possible")
    pixels = np.abs(points[..., :2])
    if (pixels[~np.isnan(pixels)] > FARTHEST_PX).any():
        raise input_error(where, "a keypoint far outside any image", "pixels, or NaN where not found", REMEDY)
    return points


def _first(path: Path, first: NDArray[np.generic]) -> int:
    if first.dtype.kind not in "iu" or first.size != 1:
        raise input_error(f"{path}: first", f"{first.dtype} of shape {first.shape}", "a whole number, the number of the first frame", REMEDY)
    return int(first.ravel()[0])
