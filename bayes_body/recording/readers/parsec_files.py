"""The text files of PARSEC's bodytrack: plain numbers in millimetres and radians, converted to metres here.

`CameraC.cal` holds 25 numbers: focal length (2), principal point (2), skew, k1 k2 p1 p2 k3, R by rows (9), T (3), and R again as a Rodrigues
vector (3); $X_{camera} = R X_{world} + T$.
"""

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import LARGEST_BYTES, read_bytes
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.session.schema import rotation_fault

CALIBRATION = "focal length (2), principal point (2), skew, distortion (5), rotation (9), translation (3), Rodrigues vector (3)"
# Between R and its Rodrigues vector. Both have ten digits, so a difference beyond rounding means another camera.
RODRIGUES_TOLERANCE = 1e-3
MM = 1e-3


def read_calibration(path: Path) -> Calibrated:
    """A camera's calibration, named after its file. The format does not state the images' size.

    Raises:
        InputError: not 25 finite numbers.
        FaultyFileError: a focal length that is not positive, a matrix that is not a rotation or contradicts its Rodrigues vector.
    """
    numbers = read_numbers(path, 25, CALIBRATION)
    rotation = numbers[10:19].reshape(3, 3)
    faults = Faults()
    for axis, focal in zip("xy", numbers[:2], strict=True):
        with faults.collect():
            if focal <= 0:
                raise input_error(path, f"focal length {axis} = {focal:g}", "a positive number of pixels", "copy it from the calibration again")
    with faults.collect():
        _check_rotation(path, rotation, numbers[22:])
    faults.raise_any()
    fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = numbers[:10].tolist()
    return Calibrated(path.stem, None, (fx, fy), (cx, cy), skew, (k1, k2, p1, p2, k3), rotation, numbers[19:22] * MM)


def _check_rotation(path: Path, rotation: NDArray[np.float64], vector: NDArray[np.float64]) -> None:
    fault = rotation_fault(rotation)
    if fault:
        raise input_error(f"{path}: numbers 11 to 19", fault.split("; ")[0], "a rotation, by rows", fault.split("; ")[-1])
    off = float(np.linalg.norm(cv2.Rodrigues(vector)[0] - rotation))
    if off > RODRIGUES_TOLERANCE:
        problem = f"the Rodrigues vector (numbers 23 to 25) contradicts the matrix (numbers 11 to 19) by {off:.2g}"
        raise input_error(path, problem, "the same rotation in both", "find out which is right, and compute the other from it")


def read_numbers(path: Path, count: int, layout: str) -> NDArray[np.float64]:
    """The numbers of a text file, (count,), whatever its line breaks.

    Args:
        path: the file.
        count: how many there must be.
        layout: their meaning, for the error message.

    Raises:
        InputError: no file, a word that is not a finite number, or another count.
    """
    remedy = "restore the file from the recording"
    content = read_bytes(path, f"a text file of {count} numbers: {layout}", LARGEST_BYTES)
    lines = content.decode("ascii", errors="replace").splitlines()
    numbers = [_number(path, line, token) for line, text in enumerate(lines, 1) for token in text.split()]
    if len(numbers) != count:
        raise input_error(path, f"{len(numbers)} numbers", f"{count}: {layout}", remedy)
    return np.array(numbers)


def _number(path: Path, line: int, token: str) -> float:
    try:
        value = float(token)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise input_error(f"{path}: line {line}", f"'{token}'", "a finite number", "correct it, or restore the file from the recording")
    return value
