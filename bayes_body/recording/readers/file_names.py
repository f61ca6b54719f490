"""Names are compared in Unicode's composed form (NFC): macOS stores `é` as two characters, and calibration programs write it as one."""

import unicodedata
from pathlib import Path


def composed(name: str) -> str:
    """The name in the form in which names are compared."""
    return unicodedata.normalize("NFC", name)


def child(folder: Path, name: str) -> Path:
    """The entry of a folder with this name, in whichever form; `folder / name` if there is none."""
    path = folder / name
    if path.exists() or not folder.is_dir():
        return path
    return next((entry for entry in folder.iterdir() if composed(entry.name) == composed(name)), path)
