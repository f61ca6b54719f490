"""What the tests of the readers share."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def deutscher() -> Path:
    """The file of the body that a bodytrack session is for."""
    return Path(__file__).parents[3] / "models" / "bodies" / "deutscher_31.toml"
