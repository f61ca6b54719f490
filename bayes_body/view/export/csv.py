"""Export to CSV and NPZ.

CSV has one row for each frame; the columns' names end in their units. NPZ, for NumPy, has arrays in full precision, with names that end in their
units.
"""

import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.files.atomic import replacing
from bayes_body.base.geometry import rigid
from bayes_body.view.export.motion import LongMotion, Motion, Parts
from bayes_body.view.export.world import AXES, dof_axes, stated_axes

# Up to this size, bytes, an array of an npz stays in memory until it is written.
ARRAY_IN_MEMORY = 2**21


def write_csv(motion: Motion | LongMotion, path: Path) -> None:
    """Write the file: `frame`, `time_s`, `lost` (0 or 1), then moments of markers, dofs or parts, and clinical angles; six decimals.

    A frame has its number in the recording; time begins at the first one. The dofs are followed by the axis of each angle of the root, a unit vector
    in the file's axes (`root_yaw_axis_x_1` and so on), the same in every row.

    A part of a loose-limbed body has its origin, the mean unit quaternion (unit 1), and the spread of the rotation about the part's own axes.

    Raises:
        InputError: the file system does not accept the file.
    """
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
        for block in motion.blocks():
            names, columns = zip(*_columns(block), strict=True)
            if not block.skipped:
                file.write(",".join(["frame", "time_s", "lost", *names]) + "\n")
            values = np.column_stack([block.numbers, block.seconds, block.lost, *columns])
            np.savetxt(file, values, fmt=["%d", "%.6f", "%d", *["%.6f"] * len(names)], delimiter=",")


def _columns(motion: Motion) -> Iterator[tuple[str, Float[np.ndarray, " frame"]]]:
    for m, marker in enumerate(motion.marker_names):
        for a, axis in enumerate(AXES):
            for name in motion.moments:
                yield f"{marker}_{axis}_{name}_m", getattr(motion.markers, name)[:, m, a]
    for d, (dof, unit) in enumerate(zip(motion.dof_names, motion.dof_units, strict=True)):
        for name in motion.moments:
            yield f"{dof}_{name}_{unit}", getattr(motion.dofs, name)[:, d]
    if motion.dof_names:
        yield from _axis_columns(motion)
    for k, angle in enumerate(motion.clinical.names):
        for name in motion.moments:
            yield f"{angle}_{name}_deg", getattr(motion.clinical.moments, name)[:, k]
    if motion.parts is not None:
        yield from _part_columns(motion.parts, motion.moments)


def _axis_columns(motion: Motion) -> Iterator[tuple[str, Float[np.ndarray, " frame"]]]:
    for d, vector in stated_axes(motion.body):
        for axis, entry in zip(AXES, vector, strict=True):
            yield f"{motion.dof_names[d]}_axis_{axis}_1", np.full(motion.frames, entry)


def _part_columns(parts: Parts, moments: Sequence[str]) -> Iterator[tuple[str, Float[np.ndarray, " frame"]]]:
    # The prefix keeps the part `head` apart from the marker `head`.
    for p, part in enumerate(parts.names):
        for a, axis in enumerate(AXES):
            for name in moments:
                yield f"part_{part}_{axis}_{name}_m", getattr(parts.origins, name)[:, p, a]
        for k, entry in enumerate(rigid.NAMES[3:]):
            yield f"part_{part}_{entry}_mean_1", parts.mean[:, p, 3 + k]
        for a, axis in enumerate(AXES):
            for name in moments[1:]:
                yield f"part_{part}_r{axis}_{name}_deg", getattr(parts.turns, name)[:, p, a]


def write_npz(motion: Motion | LongMotion, path: Path) -> None:
    """Write the file.

    Arrays: `frame` (numbers in the recording), `time_s` (from the first one), `lost`, `fps`, `up`; `marker_names` and `marker_mean_m`,
    `marker_sd_m`, `marker_q05_m`, `marker_q95_m` (frame, marker, 3); `angle_names` and `angle_mean_deg`, ... (frame, angle); `shift_names` and
    `shift_mean_m`, ... (frame, shift); `angle_axes` and `shift_axes`, the axes in the zero pose, unit vectors in the file's axes. A loose-limbed
    body has no angles and no shifts, but `part_names`, `part_mean_m`, ... (frame, part, 3), `part_quaternion_mean` (frame, part, 4), and
    `part_rotation_sd_deg`, ... (frame, part, 3) about the part's own axes. Every body with anatomical axes has `clinical_names` and
    `clinical_mean_deg`, ... (frame, angle). The file of a mode seeker's run has the means only.

    Raises:
        InputError: the file system does not accept the file.
    """
    with replacing(path) as partial, ExitStack() as stack:
        by_frame, constant = dict[str, _GrowingArray](), dict[str, NDArray[Any]]()
        for block in motion.blocks():
            constant = _constant(block)
            for name, values in _by_frame(block).items():
                if name not in by_frame:
                    by_frame[name] = stack.enter_context(_GrowingArray())
                by_frame[name].append(values)
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, allowZip64=True) as archive:
            for name, values in constant.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, values, allow_pickle=False)
            for name, array in by_frame.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    array.write(member)


class _GrowingArray:
    """An array whose frames come in blocks. A large one is in a temporary file."""

    def __init__(self) -> None:
        self._file, self._frames = tempfile.SpooledTemporaryFile(ARRAY_IN_MEMORY), 0  # noqa: SIM115 (closed in `__exit__`)
        self._dtype, self._shape = np.dtype(float), ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, values: NDArray[Any]) -> None:
        """Add frames, along the first axis."""
        self._dtype, self._shape, self._frames = values.dtype, values.shape[1:], self._frames + len(values)
        self._file.write(np.ascontiguousarray(values).tobytes())

    def write(self, out: Any) -> None:
        """Write the array in NumPy's format into an open file."""
        header = {"descr": np.lib.format.dtype_to_descr(self._dtype), "fortran_order": False, "shape": (self._frames, *self._shape)}
        np.lib.format.write_array_header_1_0(out, header)
        self._file.seek(0)
        shutil.copyfileobj(self._file, out)


def _constant(motion: Motion) -> dict[str, NDArray[Any]]:
    """Return the arrays that do not depend on the frame."""
    units, names = np.array(motion.dof_units, str), np.array(motion.dof_names, str)
    axes = dof_axes(motion.body) if motion.dof_names else np.zeros((0, 3))
    arrays: dict[str, NDArray[Any]] = {
        "fps": np.array(motion.fps),
        "up": np.array(motion.up),
        "marker_names": np.array(motion.marker_names, str),
        "angle_names": names[units == "deg"],
        "shift_names": names[units == "m"],
        "angle_axes": axes[units == "deg"],
        "shift_axes": axes[units == "m"],
    }
    arrays |= {"clinical_names": np.array(motion.clinical.names, str)} if motion.clinical.names else {}
    return arrays | ({} if motion.parts is None else {"part_names": np.array(motion.parts.names, str)})


def _by_frame(motion: Motion) -> dict[str, NDArray[Any]]:
    """Return the arrays (frame, ...)."""
    units = np.array(motion.dof_units, str)
    arrays: dict[str, NDArray[Any]] = {"frame": motion.numbers, "time_s": motion.seconds, "lost": motion.lost}
    for name in motion.moments:
        arrays[f"marker_{name}_m"] = getattr(motion.markers, name)
        values = getattr(motion.dofs, name)
        arrays[f"angle_{name}_deg"] = values[:, units == "deg"]
        arrays[f"shift_{name}_m"] = values[:, units == "m"]
    if motion.clinical.names:
        arrays |= {f"clinical_{name}_deg": getattr(motion.clinical.moments, name) for name in motion.moments}
    return arrays if motion.parts is None else arrays | _of_parts(motion.parts, motion.moments)


def _of_parts(parts: Parts, moments: Sequence[str]) -> dict[str, NDArray[np.generic]]:
    arrays: dict[str, NDArray[np.generic]] = {"part_quaternion_mean": parts.mean[..., 3:]}
    arrays |= {f"part_{name}_m": getattr(parts.origins, name) for name in moments}
    # The mean rotation vector is 0: it starts from the mean quaternion.
    return arrays | {f"part_rotation_{name}_deg": getattr(parts.turns, name) for name in moments[1:]}
