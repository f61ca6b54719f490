"""Import a recording of Vicon's video cameras: one `*.xcp`, and a video of each camera."""

from pathlib import Path

from bayes_body.recording.readers.laboratory import VICON, import_laboratory
from bayes_body.recording.readers.options import Options
from bayes_body.recording.session.session import Session


def import_vicon(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a recording, and return it with remarks (`laboratory.import_laboratory`)."""
    return import_laboratory(VICON, source, folder, options or Options())
