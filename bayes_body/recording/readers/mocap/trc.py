"""TRC, the marker format of OpenSim and Pose2Sim: tab-separated text; a header with rate and unit, names, then one row per frame."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.mocap.capture import Capture, known_unit
from bayes_body.recording.readers.mocap.text import numbers, read_text, table

KIND = "a TRC file (PathFileType, then DataRate, NumFrames, NumMarkers, Units)"
RESTORE = "restore the file, or export it again"
NEEDED = ("DataRate", "NumFrames", "NumMarkers", "Units")
# Columns before the first marker: frame and time.
FIRST = 2
# PathFileType; the header's names and values; the marker names; their axes.
HEADER_LINES = 5


def read_trc(path: Path) -> Capture:
    """Read the markers. An empty cell is an unknown position. The format does not state the up axis; y is usual.

    Raises:
        InputError: the file cannot be read, has another format or ragged rows, or its frames and markers differ from the header's counts.
    """
    lines = read_text(path, KIND).splitlines()
    if len(lines) < HEADER_LINES or not lines[0].startswith("PathFileType"):
        raise input_error(path, f"'{lines[0].strip()[:40] if lines else ''}' and {len(lines)} lines", KIND, "name another file, or restore this one")
    header = _header(path, lines[1], lines[2])
    names = _names(path, lines[3], header["NumMarkers"])
    positions = _rows(path, lines, len(names))
    if len(positions) != int(header["NumFrames"]):
        cut = "cut off: " if len(positions) < int(header["NumFrames"]) else ""
        raise input_error(path, f"{cut}{len(positions)} rows where NumFrames says {header['NumFrames']}", "the same number", RESTORE)
    rate = float(numbers(f"{path}: line 3: DataRate", [header["DataRate"]])[0])
    return Capture(rate, names, (-1,) * len(names), positions, known_unit(f"{path}: line 3: Units", header["Units"]), "y")


def _header(path: Path, names: str, values: str) -> dict[str, str]:
    header = dict(zip(names.split(), values.split(), strict=False))
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise input_error(f"{path}: lines 2 and 3", f"no {', '.join(missing)}", KIND, RESTORE)
    for name in ("NumFrames", "NumMarkers"):
        if not (header[name].isascii() and header[name].isdigit() and len(header[name]) < 10 and int(header[name])):
            raise input_error(f"{path}: line 3: {name}", f"'{header[name][:40]}'", "a whole number above 0", RESTORE)
    return header


def _names(path: Path, line: str, count: str) -> tuple[str, ...]:
    cells = line.rstrip().split("\t")[FIRST:]
    names = tuple(cell.strip() for cell in cells[::3])
    if len(names) != int(count) or "" in names or any(cell.strip() for k in (1, 2) for cell in cells[k::3]):
        problem = f"{len(names)} names, three columns apart: {', '.join(names)[:120]}"
        raise input_error(f"{path}: line 4", problem, f"{int(count)}, as NumMarkers says", RESTORE)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise input_error(f"{path}: line 4", f"'{twice[:40]}' {names.count(twice)} times", "unique names", "rename them")
    return names


def _rows(path: Path, lines: list[str], markers: int) -> Float[np.ndarray, "frame marker 3"]:
    width = FIRST + 3 * markers
    filled = [(number, line) for number, line in enumerate(lines[HEADER_LINES:], HEADER_LINES + 1) if line.strip()]
    rows, gaps = [], []
    for number, line in filled:
        cells = [cell.strip() for cell in line.split("\t")]
        if len(cells) < width or any(cells[width:]):
            raise input_error(f"{path}: line {number}", f"a ragged row of {len(cells)} cells", f"{width}: frame, time and {markers} markers", RESTORE)
        gaps.append([cell.lower() in ("", "nan") for cell in cells[FIRST:width]])
        rows.append(["0" if gap else cell for cell, gap in zip(cells[FIRST:width], gaps[-1], strict=True)])
    if not rows:
        return np.zeros((0, markers, 3))
    positions = table(str(path), rows, [number for number, _ in filled]).reshape(-1, markers, 3)
    positions[np.array(gaps).reshape(-1, markers, 3).any(axis=-1)] = np.nan
    return positions
