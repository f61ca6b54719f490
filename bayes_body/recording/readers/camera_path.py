"""The path of a moving camera: an .npz beside a session, with `rotation` (frame, 3, 3) and `translation_m` (frame, 3).

`X_camera = rotation @ X_world + translation_m`, metres. Row k belongs to the recording's frame k, counted from 0: where a session has only a
range of the frames, to a frame before it, or in it, or after it.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.recording.session.schema import FARTHEST_M, MOST_FRAMES, rotation_fault
from bayes_body.recording.session.session import CameraSpec, Session

KIND = "an .npz with `rotation` (frame, 3, 3) and `translation_m` (frame, 3)"
REMEDY = "write it with numpy.savez(path, rotation=..., translation_m=...), one row for each frame of the session"
KEPT = 64

type Extrinsics = tuple[Float[np.ndarray, "frame 3 3"], Float[np.ndarray, "frame 3"]]


def cameras_at(session: Session, index: int) -> tuple[CameraSpec, ...]:
    """The cameras with their extrinsics in one frame.

    Raises:
        InputError: a moving camera's file is missing, malformed or too short.
    """
    paths = [session.camera_path(view) for view in session.views]
    row = session.skipped + index
    return tuple(view.camera if path is None else _placed(view.camera, path, row) for view, path in zip(session.views, paths, strict=True))


def _placed(camera: CameraSpec, path: Path, index: int) -> CameraSpec:
    rotations, translations = read_camera_path(path, index + 1)
    return replace(camera, rotation=rotations[index], translation_m=translations[index])


def read_camera_path(path: Path, frames: int) -> Extrinsics:
    """Rotations and translations (metres) of at least `frames` frames. The most recently read files are cached in memory.

    Raises:
        InputError: no such file, malformed, too short, a matrix that is not a rotation, or a translation that is not plausible.
    """
    try:
        state = path.stat().st_mtime_ns, path.stat().st_size
    except OSError:
        state = 0, 0
    extrinsics = _read(path, state)
    if len(extrinsics[0]) < frames:
        raise input_error(
            path, f"{len(extrinsics[0])} frames", f"{frames}, as the session has", "add the missing ones, or lower frames in session.toml"
        )
    return extrinsics


@lru_cache(maxsize=KEPT)
def _read(path: Path, state: tuple[int, int]) -> Extrinsics:
    del state
    arrays = read_arrays(path, ("rotation", "translation_m"), KIND, REMEDY)
    for key, form in (("rotation", (3, 3)), ("translation_m", (3,))):
        if key not in arrays:
            raise input_error(path, f"no `{key}`", KIND, REMEDY)
        if arrays[key].shape[1:] != form or arrays[key].dtype.kind not in "fiu":
            raise input_error(f"{path}: {key}", f"{arrays[key].dtype} of shape {arrays[key].shape}", KIND, REMEDY)
    rotations, translations = (arrays[key].astype(np.float64) for key in ("rotation", "translation_m"))
    if len(rotations) != len(translations):
        raise input_error(path, f"{len(rotations)} rotations and {len(translations)} translations", "equal numbers of both", REMEDY)
    if len(rotations) > MOST_FRAMES:
        raise input_error(path, f"{len(rotations)} frames", f"at most {MOST_FRAMES}", REMEDY)
    for frame, (R, t) in enumerate(zip(rotations, translations, strict=True)):
        fault = rotation_fault(R)
        if fault:
            raise input_error(f"{path}: rotation of frame {frame}", fault, "orthonormal rows", "write it with more digits")
        if not np.abs(t).max() <= FARTHEST_M:
            raise input_error(
                f"{path}: translation_m of frame {frame}", f"{t.tolist()}", f"metres, at most {FARTHEST_M:g}", "divide millimetres by 1000"
            )
    return rotations, translations
