"""Import a recording of Qualisys Track Manager's video cameras: one `*.qca.txt` (or xml), and a video of each camera."""

from pathlib import Path

from bayes_body.recording.readers.laboratory import QUALISYS, import_laboratory
from bayes_body.recording.readers.options import Options
from bayes_body.recording.session.session import Session


def import_qualisys(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a recording, and return it with remarks (`laboratory.import_laboratory`)."""
    return import_laboratory(QUALISYS, source, folder, options or Options())
