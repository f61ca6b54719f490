"""A run's folder made by hand: particles that no filter made, of a session of two cameras."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import tomlkit
import xarray as xr

from bayes_body.definition import load_definition
from bayes_body.session_file import save_session

DOFS = ("shoulder_x", "shoulder_y", "shoulder_z", "elbow")


@pytest.fixture
def make_run(textured_session, tmp_path):
    """`make_run(frames=5, pose=..., log_weight=..., lost=...)`: the folder of a run of the model `arm`, arrays as (chain, draw, frame, ...)."""

    def call(name="run", model="arm", up="z", runs=2, draws=30, frames=5, **arrays) -> Path:
        session = dataclasses.replace(textured_session, folder=tmp_path / "session", up=up)
        save_session(session)
        rng = np.random.default_rng(1)
        pose = arrays.get("pose", rng.uniform(-1, 0, size=(runs, draws, frames, 4)))
        log_weight = arrays.get("log_weight", rng.normal(size=(runs, draws, frames)))
        lost = arrays.get("lost", np.zeros((runs, frames), bool))
        nothing = np.zeros((runs, frames))
        tree = xr.DataTree.from_dict(
            {
                "posterior": xr.Dataset({"pose": (("chain", "draw", "frame", "dof"), pose)}, {"dof": list(DOFS), "unit": ("dof", ["rad"] * 4)}),
                "sample_stats": xr.Dataset({"log_weight": (("chain", "draw", "frame"), log_weight)}),
                "filter": xr.Dataset({"lost": (("chain", "frame"), lost), "log_evidence": (("chain", "frame"), nothing)}),
            }
        )
        folder = tmp_path / name
        folder.mkdir()
        tree.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
        definition = load_definition(model)
        document = {
            "run": {"session": str(session.folder), "model": str(model), "runs": runs, "seed": 0},
            "kernel": {"kind": "sir", "particles": draws},
            "versions": {"python": "3.12"},
            "definition": {"title": definition.title, "text": definition.text, "body_text": definition.body_text},
            "session": {"text": (session.folder / "session.toml").read_text(encoding="utf-8")},
        }
        (folder / "run.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
        (folder / "summary.json").write_text('{"rhat_max": 1.5}', encoding="utf-8")
        return folder

    return call
