"""Calibrations of Pose2Sim and Anipose (aniposelib): a TOML table for each camera.

`name`, `size`, `matrix` (3, 3), `distortions` (4 or 5), `rotation` (Rodrigues vector) and `translation`, $X_{camera} = R X_{world} + T$. The table
`[metadata]` is not a camera. Pose2Sim's translations are in metres; Anipose's are in the unit of its calibration board.
"""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from bayes_body.base.errors import input_error
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.base.toml.schema import Finite
from bayes_body.recording.readers.calibration import Calibrated, calibrated
from bayes_body.recording.readers.faults import Faults

Triple = tuple[Finite, Finite, Finite]


class _Camera(BaseModel):
    """One camera's table. Both programs add further keys."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    name: Annotated[str, Field(strict=True)] | None = None
    size: tuple[Finite, Finite]
    matrix: tuple[Triple, Triple, Triple]
    distortions: list[Finite]
    rotation: Triple
    translation: Triple
    fisheye: Annotated[bool, Field(strict=True)] = False


def read_calibration_toml(path: Path, unit_m: float = 1.0) -> list[Calibrated]:
    """The cameras of a file, in its order.

    Args:
        path: the file.
        unit_m: metres in the file's unit of length.

    Raises:
        InputError: not TOML, or no camera in it.
        FaultyFileError: one sentence for each fault.
    """
    tables = {key: table for key, table in read_toml(path).items() if key != "metadata"}
    if not tables:
        raise input_error(path, "no camera in it", "a table for each camera, such as [cam_01]", "name the file that the calibration program wrote")
    faults, cameras = Faults(), []
    for key, table in tables.items():
        with faults.collect():
            cameras.append(_camera(f"{path}: [{key}]", key, table, unit_m))
    faults.raise_any()
    return cameras


def _camera(entry: str, key: str, table: Any, unit_m: float) -> Calibrated:
    if not isinstance(table, dict):
        raise input_error(entry, "not a table", "a camera's table", "remove it, or write a header in brackets above the camera's keys")
    camera = validate(_Camera, table, entry)
    if camera.fisheye:
        raise input_error(
            f"{entry}.fisheye", "true", "a plain lens (k1, k2, p1, p2, k3)", "calibrate again without the fisheye model, or undistort the images"
        )
    translation_m = [unit_m * value for value in camera.translation]
    name = key if camera.name is None else camera.name
    return calibrated(entry, name, camera.size, camera.matrix, camera.distortions, camera.rotation, translation_m)
