"""Recordings of any length on disk, and what it takes to compare two posteriors bit for bit."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

from bayes_body.view import overlay

from .looped import link_looped


@pytest.fixture(scope="module", autouse=True)
def small_stills():
    """Pictures as small as the video's: what is tested here is that they are made."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overlay, "STILL_HEIGHT", overlay.TILE_HEIGHT)
        yield


@pytest.fixture(scope="session")
def looped(textured_session, tmp_path_factory):
    """`looped(40)`: the folder of a session of 40 frames."""
    made: dict[int, Path] = {}

    def folder(frames: int) -> Path:
        if frames not in made:
            made[frames] = link_looped(textured_session, tmp_path_factory.mktemp(f"looped{frames}"), frames)
        return made[frames]

    return folder


def contents(path: Path) -> dict[str, bytes]:
    """Every array of a posterior's file, as bytes."""
    with xr.open_datatree(path) as tree:
        return {f"{group.path}/{name}": array.values.tobytes() for group in tree.subtree for name, array in group.data_vars.items()}


def digests(path: Path) -> dict[str, str]:
    """The SHA-256 of each file under a path, or of the file itself. The lock names the last process, and is left out."""
    files = [path] if path.is_file() else sorted(each for each in path.rglob("*") if each.is_file() and each.name != ".lock")
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def command(session: Path, out: Path, *options) -> list[str]:
    """`bayes-body track` with the small model, in a process of its own."""
    return [sys.executable, "-m", "bayes_body.cli.main", "track", str(session), "--model", "arm", "--out", str(out), *map(str, options)]


def track(session: Path, out: Path, *options, **settings) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(session, out, *options), capture_output=True, text=True, check=False, env=os.environ, **settings)
