"""MOT, OpenSim's motion file: the coordinates of its models as text, degrees and metres, y up, with the header that OpenSim 4 writes.

The format cannot store uncertainty. Standard deviations and the 5 %, 50 % and 95 % quantiles are further files of the same form, OpenSim's storage
files (`walk_sd.sto`, `walk_q05.sto`, `walk_q50.sto` and `walk_q95.sto` beside `walk.mot`). A mode seeker's run has the means only.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import replacing
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.motion import LongMotion, Motion

# The lines between `inDegrees` and `endheader`, as OpenSim's inverse kinematics writes them.
UNITS = "Units are S.I. units (second, meters, Newtons, ...)"
SPREAD = ("sd", "q05", "q50", "q95")
DEGREES = "If the header above contains a line with 'inDegrees', this indicates whether rotational values are in degrees (yes) or radians (no)."


def mot_files(path: Path, moments: Sequence[str] = Moments._fields) -> dict[str, Path]:
    """Return the file of each moment: `path` for the mean, `walk_sd.sto` and so on for the others, and `walk_q50.sto` for the median."""
    spread = SPREAD if "sd" in moments else ()
    return {"mean": path} | {name: path.with_stem(f"{path.stem}_{name}").with_suffix(".sto") for name in spread}


def write_mot(motion: Motion | LongMotion, path: Path) -> None:
    """Write the files; eight decimals, as OpenSim does.

    Raises:
        InputError: y is not up, or the file system does not accept a file.
    """
    if motion.up != "y":
        raise input_error("--up", f"{motion.up} with --to mot", "y, as OpenSim's models stand", "leave it out")
    with ExitStack() as stack:
        files = {}
        for moment, file in mot_files(path, motion.moments).items():
            files[moment] = stack.enter_context(stack.enter_context(replacing(file)).open("w", encoding="utf-8", newline="\n"))
        for block in motion.blocks():
            for moment, file in files.items():
                if not block.skipped:
                    file.write("\n".join(_header(motion.frames, block.clinical.names)) + "\n")
                # Adding 0 turns -0 into 0.
                values = np.round(np.column_stack([block.seconds, getattr(block.clinical.moments, moment)]), 8) + 0.0
                np.savetxt(file, values, fmt="%16.8f", delimiter="\t")


def _header(frames: int, coordinates: Sequence[str]) -> list[str]:
    names = ["time", *coordinates]
    return [
        "Coordinates",
        "version=1",
        f"nRows={frames}",
        f"nColumns={len(names)}",
        "inDegrees=yes",
        "",
        UNITS,
        DEGREES,
        "",
        "endheader",
        "\t".join(names),
    ]
