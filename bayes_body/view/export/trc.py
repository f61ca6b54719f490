"""TRC, the marker format of OpenSim and Pose2Sim: text, tab-separated, millimetres, frames counted from 1.

The format cannot store uncertainty. The mean is one file, and the standard deviation and the quantiles are further files of the same form. A mode
seeker's run has the mean only.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.motion import LongMotion, Motion

MILLIMETRES = 1000.0


def trc_files(path: Path, moments: Sequence[str] = Moments._fields) -> dict[str, Path]:
    """Return the file of each moment: `path` for the mean, `walk_sd.trc` and so on for the others."""
    return {name: path if name == "mean" else path.with_stem(f"{path.stem}_{name}") for name in moments}


def write_trc(motion: Motion | LongMotion, path: Path) -> None:
    """Write a file for each moment; the last digit is 1 µm.

    Raises:
        InputError: the file system does not accept a file.
    """
    markers = len(motion.marker_names)
    with ExitStack() as stack:
        files = {}
        for moment, file in trc_files(path, motion.moments).items():
            files[moment] = stack.enter_context(stack.enter_context(replacing(file)).open("w", encoding="utf-8", newline="\n"))
            files[moment].write("\n".join(_header(file.name, motion)) + "\n")
        for block in motion.blocks():
            rows = block.skipped + np.arange(1, block.frames + 1)
            for moment, file in files.items():
                columns = np.column_stack([rows, block.seconds, MILLIMETRES * getattr(block.markers, moment).reshape(block.frames, -1)])
                np.savetxt(file, columns, fmt=["%d", "%.6f", *["%.3f"] * (3 * markers)], delimiter="\t")


def _header(name: str, motion: Motion | LongMotion) -> list[str]:
    count, markers = motion.frames, len(motion.marker_names)
    rate = f"{motion.fps:.10g}"
    return [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{markers}\tmm\t{rate}\t{motion.first_frame + 1}\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(motion.marker_names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, markers + 1) for axis in "XYZ"),
        "",
    ]
