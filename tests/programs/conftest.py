"""The session that programs and the guide's examples work on."""

from pathlib import Path

import pytest

from bayes_body.recording.parsec import import_parsec


@pytest.fixture(scope="session")
def walk(bodytrack, tmp_path_factory) -> Path:
    """The session of the real recording, in a folder `walk` as the guide calls it."""
    folder = tmp_path_factory.mktemp("guide") / "walk"
    import_parsec(bodytrack, folder)
    return folder
