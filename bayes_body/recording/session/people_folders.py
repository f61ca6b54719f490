"""Where the sessions of a recording's people are: RECORDING/people/person_N. Nothing here loads NumPy."""

from pathlib import Path

FOLDER = "people"
SESSION_FILE = "session.toml"
PREFIX = "person_"


def recording_folder(folder: Path) -> Path | None:
    """Return the folder of the recording of a person's session; None for a session of another kind."""
    recording = folder.parent.parent
    return recording if folder.parent.name == FOLDER and (recording / SESSION_FILE).is_file() else None


def people_numbers(recording: Path) -> list[int]:
    """Return the numbers of the people who have a session in a recording's folder."""
    endings = (path.parent.name.removeprefix(PREFIX) for path in (recording / FOLDER).glob(f"{PREFIX}*/{SESSION_FILE}"))
    return sorted(int(ending) for ending in endings if ending.isdecimal())
