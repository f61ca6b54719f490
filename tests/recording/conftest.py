"""A bodytrack recording that a test may damage."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest


class Copy:
    """A folder like the recording: text files copied, image folders linked until a test asks to own one."""

    def __init__(self, original: Path, folder: Path):
        self.folder = folder
        (folder / "CALIB").mkdir(parents=True)
        for path in [*original.glob("*.txt"), *original.glob("CALIB/*.cal")]:
            shutil.copyfile(path, folder / path.relative_to(original))
        for path in [*original.glob("CAM*"), *original.glob("FG*")]:
            (folder / path.name).symlink_to(path)

    def own(self, name: str) -> Path:
        """The image folder `name`, with images that can be replaced."""
        link = self.folder / name
        original = link.resolve()
        link.unlink()
        link.mkdir()
        for path in original.iterdir():
            (link / path.name).symlink_to(path)
        return link

    def edit(self, name: str, change: Callable[[list[str]], list[str]]) -> Path:
        """Rewrite a text file as `change` of its numbers."""
        path = self.folder / name
        path.write_text("\n".join(change(path.read_text().split())))
        return path


@pytest.fixture
def copy(bodytrack: Path, tmp_path: Path) -> Copy:
    """A damageable copy of the real recording."""
    return Copy(bodytrack, tmp_path / "source")


@pytest.fixture(scope="session")
def deutscher() -> Path:
    """The file of the body that a bodytrack session is for."""
    return Path(__file__).parents[2] / "models" / "bodies" / "deutscher_31.toml"
