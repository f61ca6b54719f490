"""CSV: one row for each frame; the columns' names end in their units."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.export.motion import AXES, Motion
from bayes_body.files.atomic import replacing


def write_csv(motion: Motion, path: Path) -> None:
    """Write the file: `frame` (from 0), `time_s`, `lost` (0 or 1), then the moments of each marker's axes and of each dof; six decimals.

    Raises:
        InputError: the file system does not accept the file.
    """
    names, columns = zip(*_columns(motion), strict=True)
    values = np.column_stack([np.arange(motion.frames), motion.seconds, motion.lost, *columns])
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
