"""Calibrations of Pose2Sim, Anipose (aniposelib), FreeMoCap and Caliscope: a TOML table for each camera.

`name`, `size`, `matrix` (3, 3), `distortions` (4 or 5), `rotation` (Rodrigues vector, or a 3 x 3 matrix by rows) and `translation`,
$X_{camera} = R X_{world} + T$. Pose2Sim's translations are in metres; Anipose's are in the unit of its calibration board. Caliscope writes the tables
below `[cameras]`, under the number of the camera, whose videos it names `cam_N`. Its `rotation_count` waits for the pictures (`upright`).

The programs write further tables and numbers beside the cameras, such as `[metadata]` or `[charuco]`. What has none of a camera's keys is no camera.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.base.toml.schema import Finite
from bayes_body.recording.readers.calibration.calibrated import Calibrated, calibrated
from bayes_body.recording.readers.faults import Faults, unnoted

Triple = tuple[Finite, Finite, Finite]
NESTED = "cameras"
# A table with one of these is a camera's.
KEYS = frozenset({"matrix", "distortions", "rotation", "translation"})
# What is beside the cameras in every file of Pose2Sim, and is not worth a word.
USUAL = frozenset({"metadata"})
POSE = ("rotation", "translation")


class _Camera(BaseModel):
    """One camera's table. All programs add further keys."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    name: Annotated[str, Field(strict=True)] | None = None
    size: tuple[Finite, Finite]
    matrix: tuple[Triple, Triple, Triple]
    distortions: list[Finite]
    rotation: Triple
    translation: Triple
    fisheye: Annotated[bool, Field(strict=True)] = False
    # Quarter turns of the pictures, clockwise, to show people upright. Caliscope calibrates on the unturned ones.
    rotation_count: Annotated[int, Field(strict=True, ge=-3, le=3)] = 0


class _CameraWithMatrix(_Camera):
    rotation: tuple[Triple, Triple, Triple]  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]


def read_calibration_toml(path: Path, unit_m: float = 1.0, note: Callable[[str], None] = unnoted) -> list[Calibrated]:
    """The cameras of a file, in its order. Cameras without a place in the world are left out, if others have one.

    Args:
        path: the file.
        unit_m: metres in the file's unit of length.
        note: receives sentences about what was left out.

    Raises:
        InputError: not TOML, no camera in it, or none with a place in the world.
        FaultyFileError: one sentence for each fault.
    """
    tables = read_toml(path)
    cameras = dict(camera_tables(tables))
    if not cameras:
        raise input_error(path, "no camera in it", "a table for each camera, such as [cam_01]", "name the file that the calibration program wrote")
    unread = [key for key in tables if key not in cameras and key != NESTED and key not in USUAL]
    if unread:
        note(f"{path.name}: {', '.join(unread)}: not cameras, and not read.")
    faults, placed = Faults(), []
    for header, table in _placed(path, cameras, note).items():
        with faults.collect():
            placed.append(_camera(f"{path}: [{header}]", header, table, unit_m))
    faults.raise_any()
    return placed


def is_calibration(path: Path) -> bool:
    """Whether a file has cameras. Projects have other TOML files too, such as Pose2Sim's Config.toml; a file of another kind is not looked into."""
    try:
        return path.suffix.lower() != ".toml" or any(camera_tables(read_toml(path)))
    except InputError:
        return False


def camera_tables(tables: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the header and the content of each camera's table."""
    for key, table in tables.items():
        if not isinstance(table, dict):
            continue
        if table.keys() & KEYS:
            yield key, table
        elif key == NESTED:
            yield from ((f"{key}.{name}", camera) for name, camera in table.items() if isinstance(camera, dict) and camera.keys() & KEYS)


def _placed(path: Path, cameras: Mapping[str, Mapping[str, Any]], note: Callable[[str], None]) -> dict[str, Mapping[str, Any]]:
    """Return the cameras that have a place in the world."""
    unplaced = [header for header, table in cameras.items() if not table.keys() & set(POSE)]
    if len(unplaced) == len(cameras):
        problem = "no camera has a rotation and a translation: these are intrinsics only"
        raise input_error(path, problem, "cameras with their places in one world", "calibrate the extrinsics too, and name that file")
    if unplaced:
        named = ", ".join(f"[{header}]" for header in unplaced)
        note(f"{path.name}: {named}: no rotation and translation, so {'this camera is' if len(unplaced) == 1 else 'these cameras are'} left out.")
    return {header: table for header, table in cameras.items() if header not in unplaced}


def _camera(entry: str, header: str, table: Mapping[str, Any], unit_m: float) -> Calibrated:
    rotation = table.get("rotation")
    is_matrix = isinstance(rotation, list) and bool(rotation) and isinstance(rotation[0], list)
    camera = validate(_CameraWithMatrix if is_matrix else _Camera, table, entry)
    if camera.fisheye:
        raise input_error(
            f"{entry}.fisheye", "true", "a plain lens (k1, k2, p1, p2, k3)", "calibrate again without the fisheye model, or undistort the images"
        )
    translation_m = [unit_m * value for value in camera.translation]
    name = camera_name(header, camera.name)
    record = calibrated(entry, name, camera.size, camera.matrix, camera.distortions, camera.rotation, translation_m)
    return record._replace(quarter_turns=camera.rotation_count % 4)


def camera_name(header: str, stated_name: str | None) -> str:
    """Return the name of a camera: the stated one, else that of its table."""
    if stated_name is not None:
        return str(stated_name)
    key = header.rpartition(f"{NESTED}.")[2]
    return f"cam_{key}" if header != key and key.isdigit() else key
