"""Export to CSV and NPZ.

CSV has one row for each frame; the columns' names end in their units. NPZ, for NumPy, has arrays in full precision, with names that end in their
units.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.files.atomic import replacing
from bayes_body.base.geometry import rigid
from bayes_body.view.export.motion import Motion, Parts
from bayes_body.view.export.world import AXES, dof_axes, stated_axes


def write_csv(motion: Motion, path: Path) -> None:
    """Write the file: `frame`, `time_s`, `lost` (0 or 1), then moments of markers, dofs or parts, and clinical angles; six decimals.

    A frame has its number in the recording; time begins at the first one. The dofs are followed by the axis of each angle of the root, a unit vector
    in the file's axes (`root_yaw_axis_x_1` and so on), the same in every row.

    A part of a loose-limbed body has its origin, the mean unit quaternion (unit 1), and the spread of the rotation about the part's own axes.

    Raises:
        InputError: the file system does not accept the file.
    """
    names, columns = zip(*_columns(motion), strict=True)
    values = np.column_stack([motion.first_frame + np.arange(motion.frames), motion.seconds, motion.lost, *columns])
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(["frame", "time_s", "lost", *names]) + "\n")
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


def write_npz(motion: Motion, path: Path) -> None:
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
    units, names = np.array(motion.dof_units, str), np.array(motion.dof_names, str)
    arrays = {
        "frame": motion.first_frame + np.arange(motion.frames),
        "time_s": motion.seconds,
        "lost": motion.lost,
        "fps": np.array(motion.fps),
        "up": np.array(motion.up),
        "marker_names": np.array(motion.marker_names, str),
        "angle_names": names[units == "deg"],
        "shift_names": names[units == "m"],
    }
    axes = dof_axes(motion.body) if motion.dof_names else np.zeros((0, 3))
    arrays |= {"angle_axes": axes[units == "deg"], "shift_axes": axes[units == "m"]}
    for name in motion.moments:
        arrays[f"marker_{name}_m"] = getattr(motion.markers, name)
        values = getattr(motion.dofs, name)
        arrays[f"angle_{name}_deg"] = values[:, units == "deg"]
        arrays[f"shift_{name}_m"] = values[:, units == "m"]
    if motion.clinical.names:
        arrays["clinical_names"] = np.array(motion.clinical.names, str)
        arrays |= {f"clinical_{name}_deg": getattr(motion.clinical.moments, name) for name in motion.moments}
    if motion.parts is not None:
        arrays |= _of_parts(motion.parts, motion.moments)
    # The file is opened here, because NumPy would append an ending to a name.
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _of_parts(parts: Parts, moments: Sequence[str]) -> dict[str, NDArray[np.generic]]:
    arrays: dict[str, NDArray[np.generic]] = {"part_names": np.array(parts.names, str), "part_quaternion_mean": parts.mean[..., 3:]}
    arrays |= {f"part_{name}_m": getattr(parts.origins, name) for name in moments}
    # The mean rotation vector is 0: it starts from the mean quaternion.
    return arrays | {f"part_rotation_{name}_deg": getattr(parts.turns, name) for name in moments[1:]}
