r"""C3D, the binary format of motion laboratories (c3d.org), by ezc3d: millimetres, 32-bit floats.

The first points are the markers' means. Their residual, which elsewhere tells how well cameras agree, is the posterior's standard deviation, the root
of the mean variance of the three axes $\sqrt{(s_x^2 + s_y^2 + s_z^2)/3}$. A C3D residual is seven bits, in steps of POINT:SCALE mm. On demand the
moments are further points, in full precision and axis by axis: `_sd`, `_q05` and `_q95` after a marker's name.
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
# Seven bits; and the finest step that is worth having, mm.
LARGEST_STEP, FINEST = 127, 0.01
# The format counts frames in 16 bits.
MOST_FRAMES = 65535
MEANINGS = {
    "mean": "posterior mean; residual: posterior sd, root mean square of the axes",
    "sd": "posterior standard deviation of each axis, no position",
    "q05": "5 % quantile of each axis",
    "q95": "95 % quantile of each axis",
}


def write_c3d(motion: Motion, path: Path, intervals: bool = False) -> None:
    """Write the file.

    Args:
        motion: of a run.
        path: the file.
        intervals: whether standard deviations and quantiles are further points.

    Raises:
        InputError: more frames than the format can count, or the file system refuses it.
    """
    if motion.frames > MOST_FRAMES:
        raise input_error("--to c3d", f"{motion.frames} frames", f"at most {MOST_FRAMES}, which is what the format can count", "take npz, csv or trc")
    with replacing(path) as partial:
        # ezc3d alone would say of a folder that is not there no more than "iostream error".
        partial.touch()
        _document(motion, tuple(MEANINGS) if intervals else ("mean",)).write(str(partial))


def _document(motion: Motion, sets: Sequence[str]) -> Any:
    import ezc3d

    c3d = ezc3d.c3d()
    residuals, step = _residuals(motion.markers, len(sets))
    points = c3d["parameters"]["POINT"]
    points["UNITS"]["value"] = ["mm"]
    points["RATE"]["value"] = [motion.fps]
    points["SCALE"]["value"] = [-step]
    points["LABELS"]["value"] = [f"{marker}{'' if name == 'mean' else f'_{name}'}" for name in sets for marker in motion.marker_names]
    points["DESCRIPTIONS"]["value"] = [MEANINGS[name] for name in sets for _ in motion.marker_names]
    c3d["data"]["points"] = _points(motion.markers, sets)
    c3d["data"]["meta_points"]["residuals"] = residuals
    c3d.add_parameter("POINT", "X_SCREEN", ["+Y" if motion.up == "x" else "+X"])
    c3d.add_parameter("POINT", "Y_SCREEN", [f"+{motion.up.upper()}"])
    return c3d


def _points(markers: Moments, sets: Sequence[str]) -> Float[np.ndarray, "4 point frame"]:
    values = np.concatenate([getattr(markers, name) for name in sets], axis=1)
    points = np.ones((4, values.shape[1], values.shape[0]))
    points[:3] = MILLIMETRES * values.transpose(2, 1, 0)
    return points


def _residuals(markers: Moments, sets: int) -> tuple[Float[np.ndarray, "1 point frame"], float]:
    """Millimetres, of the means; 0 of the other points. And the step that the format rounds them to, as fine as the largest lets it be."""
    sd = MILLIMETRES * np.sqrt((markers.sd**2).mean(axis=-1)).T
    step = max(math.ceil(sd.max() / (LARGEST_STEP - 1) / FINEST) * FINEST, FINEST)
    out = np.zeros((1, sets * sd.shape[0], sd.shape[1]))
    # ezc3d cuts off what is below a step: half of one makes a rounding of it.
    out[0, : sd.shape[0]] = np.round(sd / step) * step + step / 2
    return out, step
