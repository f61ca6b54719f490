"""TRC, the marker format of OpenSim and Pose2Sim: text, tab-separated, millimetres, frames counted from 1.

The format cannot store uncertainty. The mean is one file, and the standard deviation and the quantiles are further files of the same form. A mode
seeker's run has the mean only.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import replacing
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.motion import Motion

MILLIMETRES = 1000.0


def trc_files(path: Path, moments: Sequence[str] = Moments._fields) -> dict[str, Path]:
    """Return the file of each moment: `path` for the mean, `walk_sd.trc` and so on for the others."""
    return {name: path if name == "mean" else path.with_stem(f"{path.stem}_{name}") for name in moments}


def write_trc(motion: Motion, path: Path) -> None:
    """Write a file for each moment; the last digit is 1 µm.

    Raises:
        InputError: the file system does not accept a file.
    """
    for name, file in trc_files(path, motion.moments).items():
        with replacing(file) as partial:
            _write(partial, file.name, motion, getattr(motion.markers, name))


def _write(path: Path, name: str, motion: Motion, positions: Float[np.ndarray, "frame marker 3"]) -> None:
    count, markers = motion.frames, len(motion.marker_names)
    rate = f"{motion.fps:.10g}"
    header = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{markers}\tmm\t{rate}\t{motion.first_frame + 1}\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(motion.marker_names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, markers + 1) for axis in "XYZ"),
        "",
    ]
    columns = np.column_stack([np.arange(1, count + 1), motion.seconds, MILLIMETRES * positions.reshape(count, -1)])
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n")
        np.savetxt(file, columns, fmt=["%d", "%.6f", *["%.3f"] * (3 * markers)], delimiter="\t")
