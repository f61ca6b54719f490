"""NPZ, for NumPy: arrays in full precision, with names that end in their units."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.files.atomic import replacing
from bayes_body.view.export.motion import Motion, Parts


def write_npz(motion: Motion, path: Path) -> None:
    """Write the file.

    Arrays: `frame` (numbers in the recording), `time_s` (from the first one), `lost`, `fps`, `up`; `marker_names` and `marker_mean_m`,
    `marker_sd_m`, `marker_q05_m`, `marker_q95_m` (frame, marker, 3); `angle_names` and `angle_mean_deg`, ... (frame, angle); `shift_names` and
    `shift_mean_m`, ... (frame, shift). A loose-limbed body has no angles and no shifts, but `part_names`, `part_mean_m`, ... (frame, part, 3),
    `part_quaternion_mean` (frame, part, 4), and `part_rotation_sd_deg`, ... (frame, part, 3) about the part's own axes. Every body with anatomical
    axes has `clinical_names` and `clinical_mean_deg`, ... (frame, angle). The file of a mode seeker's run has the means only.

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
