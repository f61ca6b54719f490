r"""C3D, the binary format of motion laboratories (c3d.org), written with ezc3d: millimetres, 32-bit floats.

The points are the markers' means. A point's residual, which usually measures the agreement of the cameras, is the posterior's standard deviation: the
root of the mean variance of the three axes, $\sqrt{(s_x^2 + s_y^2 + s_z^2)/3}$. A C3D residual has seven bits, in steps of POINT:SCALE mm. On
request, the moments of each axis are stored in full precision as further points, with `_sd`, `_q05` and `_q95` after the marker's name. The file of a
mode seeker's run has the means only, and its residuals are 0.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes_body.errors import input_error
from bayes_body.export.motion import Motion
from bayes_body.files.atomic import replacing
from bayes_body.posterior.moments import Moments

MILLIMETRES = 1000.0
# Largest number of steps (seven bits), and the smallest useful step, mm.
LARGEST_STEP, FINEST = 127, 0.01
# The format counts frames in 16 bits.
MOST_FRAMES = 65535
MODE_SEEKER_MEANING = "mean of a mode seeker's particles, without uncertainty"
MEANINGS = {
    "mean": "posterior mean; residual: posterior sd, root mean square of the axes",
    "sd": "posterior standard deviation of each axis, not a position",
    "q05": "5 % quantile of each axis",
    "q95": "95 % quantile of each axis",
}


def write_c3d(motion: Motion, path: Path, spread: bool = False) -> None:
    """Write the file.

    Args:
        motion: the motion of a run.
        path: the file.
        spread: whether to write standard deviation and quantiles of each axis as further points.

    Raises:
        InputError: there are more frames than the format can count, or the file system does not accept the file.
    """
    if motion.frames > MOST_FRAMES:
        raise input_error("--to c3d", f"{motion.frames} frames", f"at most {MOST_FRAMES}, the format's limit", "choose npz, csv or trc")
    with replacing(path) as partial:
        _document(motion, motion.moments if spread else ("mean",)).write(str(partial))


def _document(motion: Motion, moments: Sequence[str]) -> Any:
    import ezc3d

    c3d = ezc3d.c3d()
    residuals, step = _residuals(motion, len(moments))
    points = c3d["parameters"]["POINT"]
    points["UNITS"]["value"] = ["mm"]
    points["RATE"]["value"] = [motion.fps]
    points["SCALE"]["value"] = [-step]
    points["LABELS"]["value"] = [f"{marker}{'' if name == 'mean' else f'_{name}'}" for name in moments for marker in motion.marker_names]
    points["DESCRIPTIONS"]["value"] = [_meaning(name, motion) for name in moments for _ in motion.marker_names]
    c3d["data"]["points"] = _points(motion.markers, moments)
    c3d["data"]["meta_points"]["residuals"] = residuals
    c3d.add_parameter("POINT", "X_SCREEN", ["+Y" if motion.up == "x" else "+X"])
    c3d.add_parameter("POINT", "Y_SCREEN", [f"+{motion.up.upper()}"])
    return c3d


def _meaning(name: str, motion: Motion) -> str:
    return MEANINGS[name] if motion.has_intervals else MODE_SEEKER_MEANING


def _points(markers: Moments, moments: Sequence[str]) -> Float[np.ndarray, "4 point frame"]:
    sets = np.concatenate([getattr(markers, name) for name in moments], axis=1)
    points = np.ones((4, sets.shape[1], sets.shape[0]))
    points[:3] = MILLIMETRES * sets.transpose(2, 1, 0)
    return points


def _residuals(motion: Motion, sets: int) -> tuple[Float[np.ndarray, "1 point frame"], float]:
    """Return the residuals, millimetres, and the smallest possible step to which the format rounds them.

    There are `sets` points for each marker; only the first, the mean, has a residual that is not 0.
    """
    sd = MILLIMETRES * np.sqrt((motion.markers.sd**2).mean(axis=-1)).T * motion.has_intervals
    step = max(math.ceil(sd.max() / (LARGEST_STEP - 1) / FINEST) * FINEST, FINEST)
    out = np.zeros((1, sets * sd.shape[0], sd.shape[1]))
    # ezc3d truncates to whole steps: adding half a step makes it round. Zero stays zero.
    out[0, : sd.shape[0]] = np.where(sd > 0, np.round(sd / step) * step + step / 2, 0.0)
    return out, step
