"""Names of the files of a run, and names of folders that do not exist yet."""

import re
from pathlib import Path

RUN_FILE, POSTERIOR_FILE, SUMMARY_FILE, MANIFEST_FILE, FRAMES_FOLDER = "run.toml", "posterior.nc", "summary.json", "manifest.json", "frames"
# In the folder of the frames: the index of those whose draws are in the posterior.
INDEX_FILE = "index.npz"
OVERLAY_FILE, OVERLAY_FOLDER = "overlay.mp4", "overlay"
# Pages of several people of one recording, in the folder that holds their runs; their video there has the name of a run's.
PEOPLE_REPORT_FILE, PEOPLE_VIEW_FILE = "people.html", "people_3d.html"
# The delay of each frame that was tracked while the session was recorded.
DELAYS_FILE = "live.csv"
# Everything that a run writes, except its settings and its lock.
RESULTS = (FRAMES_FOLDER, POSTERIOR_FILE, SUMMARY_FILE, MANIFEST_FILE, OVERLAY_FILE, OVERLAY_FOLDER)


# Folder of a person's session, and end of the name of such a session in a study.
PERSON = re.compile(r"(?:.*_)?person_([1-9]\d{0,5})")


def person_number(name: str) -> int | None:
    """Return the number of the person in a name such as `person_2` or `walk_person_2`; None if there is no person in it."""
    match = PERSON.fullmatch(name)
    return int(match[1]) if match else None


def free_folder(wanted: Path) -> Path:
    """Return the first of `wanted`, `wanted_2`, `wanted_3`, ... that does not exist."""
    number, folder = 1, wanted
    while folder.exists():
        number += 1
        folder = wanted.with_name(f"{wanted.name}_{number}")
    return folder
