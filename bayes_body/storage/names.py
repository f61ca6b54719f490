"""What the files of a run are called, and a folder's name that is still free."""

from pathlib import Path

RUN_FILE, POSTERIOR_FILE, SUMMARY_FILE, FRAMES_FOLDER = "run.toml", "posterior.nc", "summary.json", "frames"


def free_folder(wanted: Path) -> Path:
    """`wanted`, or `wanted_2`, `wanted_3`, ...: the first that does not exist."""
    number, folder = 1, wanted
    while folder.exists():
        number += 1
        folder = wanted.with_name(f"{wanted.name}_{number}")
    return folder
