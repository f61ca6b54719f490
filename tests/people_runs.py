"""Runs of several people of one recording, made of the run of one person: copies that are moved, turned, and begin later or end earlier."""

import json
import tomllib
from pathlib import Path

import numpy as np
import tomlkit
import xarray as xr
from sealed import seal

from bayes_body.recording.session.read import parse_session
from bayes_body.results.storage.manifest import input_digests

# Keys of a camera that name files beside the session.
FILES = ("images", "masks", "video", "background", "keypoints")


def person_run(run: Path, parent: Path, number: int, frames: range, shifts=None, first: int = 0) -> Path:
    """The folder of a run of person `number`, with some frames of a run of the recording, as `track --person all` names its folders.

    Args:
        run: a run of all frames of a recording.
        parent: the folder of the people's runs.
        number: the person.
        frames: the frames, counted from 0.
        shifts: what is added to dofs, by their names, radians and metres.
        first: the number of the recording's first frame.
    """
    folder = parent / f"walk_person_{number}" / "run_1"
    document = tomllib.loads((run / "run.toml").read_text(encoding="utf-8"))
    recording = Path(document["run"]["session"])
    home = recording / "people" / f"person_{number}"
    home.mkdir(parents=True)
    session = tomllib.loads(document["session"]["text"])
    session |= {"title": f"{session['title']}, person {number}", "first_frame": first + frames.start, "frames": len(frames)}
    session.pop("truth", None)
    for camera in session["camera"]:
        camera |= {key: str(Path("../..") / camera[key]) for key in FILES if key in camera}
    document["run"]["session"], document["session"]["text"] = str(home), tomlkit.dumps(session)
    document["inputs"] = input_digests(parse_session(session, home, "session"))
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
    with xr.open_datatree(run / "posterior.nc", engine="h5netcdf") as stored:
        tree = stored.load().copy(deep=True)
    groups = {}
    for name, group in tree.children.items():
        dataset = group.to_dataset().isel(frame=slice(frames.start, frames.stop))
        groups[name] = dataset.assign_coords(frame=np.arange(first + frames.start, first + frames.stop)) if name == "posterior" else dataset
    for dof, shift in (shifts or {}).items():
        groups["posterior"]["pose"].loc[{"dof": dof}] += shift
    copy = xr.DataTree.from_dict(groups)
    copy.attrs.update(tree.attrs)
    copy.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    (folder / "summary.json").write_text(json.dumps(summary | {"frames": len(frames), "first_frame": first + frames.start}), encoding="utf-8")
    seal(folder, len(frames))
    return folder
