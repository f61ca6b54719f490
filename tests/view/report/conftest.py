"""A run's folder made by hand: particles that no filter made, and an overlay whose frames tell their number by their brightness."""

import dataclasses
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomlkit
import xarray as xr
from sealed import seal

from bayes_body.model.definition import load_definition
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.results.posterior.message_passing import DIMS as MESSAGES
from bayes_body.results.storage.manifest import input_digests
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.report.inspection import Inspection

DOFS = ("root_x", "l_hip_y", "l_knee", "r_elbow", "head_z")
UNITS = ("m", "rad", "rad", "rad", "rad")


@pytest.fixture(scope="session")
def make_run(textured_session, tmp_path_factory):
    """`make_run(runs=2, frames=5, truth=..., pose=..., log_weight=...)`: the folder of a run, arrays as (chain, draw, frame, ...).

    A `recording` is copied with its files.
    """

    def call(runs=2, draws=60, frames=5, dofs=DOFS, units=UNITS, title=None, truth=None, recording=None, model="arm", **arrays) -> Path:
        base = tmp_path_factory.mktemp("report")
        session = dataclasses.replace(recording or textured_session, folder=base / "session", **({"title": title} if title else {}))
        if recording is not None:
            shutil.copytree(recording.folder, session.folder)
        if truth is not None:
            session = dataclasses.replace(session, frames=frames, truth="truth.npz")
            session.folder.mkdir(exist_ok=True)
            np.savez(session.folder / "truth.npz", markers=truth, names=np.array(MARKERS))
        save_session(session)
        folder = base / "run"
        folder.mkdir()
        _tree(runs, draws, frames, dofs, units, arrays).to_netcdf(folder / "posterior.nc", engine="h5netcdf")
        _run_file(folder, session.folder, runs, draws, title, model)
        figures = {"frames": frames, "frames_lost": 0, "cameras": 2, "runs": runs, "iou_median": None, "seconds_per_frame": 0.25}
        (folder / "summary.json").write_text(json.dumps(figures), encoding="utf-8")
        seal(folder, frames)
        return folder

    return call


def _tree(runs, draws, frames, dofs, units, arrays) -> xr.DataTree:
    rng = np.random.default_rng(3)
    by_layer = np.full((runs, frames, 3), 0.5)
    given = {
        "pose": 0.1 * rng.normal(size=(runs, draws, frames, len(dofs))),
        "log_weight": np.full((runs, draws, frames), -np.log(draws)),
        "ancestor": np.tile(np.arange(draws)[None, :, None], (runs, 1, frames)),
        "ess": np.full((runs, frames), float(draws)),
        "log_evidence": rng.normal(size=(runs, frames)) - 5,
        "lost": np.zeros((runs, frames), bool),
        "survival_rate": by_layer,
        "inverse_temperature": by_layer * [0.5, 1, 2],
        "acceptance_rate": by_layer,
        "seen": np.ones((frames, 2), bool),
    } | arrays
    dims = {"seen": ("frame", "camera"), "markov_ess": ("chain", "frame", "dof"), "markov_length": ("chain", "frame")}
    dims |= {name: ("chain", "frame", "markov_chain") for name in given if name.startswith("markov_") and name not in dims}
    dims |= {name: ("chain", "frame", *own) for name, own in MESSAGES.items()}
    dims |= dict.fromkeys(("survival_rate", "inverse_temperature", "acceptance_rate"), ("chain", "frame", "layer"))
    filters = {name: (dims.get(name, ("chain", "frame")), values) for name, values in given.items() if name not in ("pose", "log_weight", "ancestor")}
    stats = {name: (("chain", "draw", "frame"), given[name]) for name in ("log_weight", "ancestor")}
    labels = {"dof": list(dofs), "unit": ("dof", list(units))}
    tree = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({"pose": (("chain", "draw", "frame", "dof"), given["pose"].astype(np.float32))}, labels),
            "sample_stats": xr.Dataset(stats),
            "filter": xr.Dataset(filters, {"camera": ["left", "right"]}),
        }
    )
    tree.attrs["kernel"] = "sir"
    return tree


def _run_file(folder, session, runs, draws, title, model) -> None:
    definition = load_definition(model)
    document = {
        "run": {"session": str(session), "model": model, "runs": runs, "seed": 7},
        "kernel": {"kind": "sir", "particles": draws, "resampling": "systematic"},
        "versions": {"python": "3.12", "bayes-body": "0.0.9"},
        "machine": {"platform": "an abacus", "devices": ["bead:0"]},
        "definition": {"title": title or definition.title, "text": definition.text + f"\n# {title}", "body_text": definition.body_text},
        "session": {"text": (session / "session.toml").read_text(encoding="utf-8")},
        "inputs": input_digests(load_session(session)),
    }
    (folder / "run.toml").write_text(tomlkit.dumps(document), encoding="utf-8")


@pytest.fixture(scope="session")
def draw_pictures():
    """`draw_pictures(folder, frames)`: a video and two stills; frame k is grey of level 25 k, modulo 250, or noise."""

    def call(folder: Path, frames: int, size=(64, 48), fps=50.0, noise=False) -> None:
        rng = np.random.default_rng(0)
        (folder / "overlay").mkdir()
        video = cv2.VideoWriter(str(folder / "overlay.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
        for frame in range(frames):
            picture = np.full((size[1], size[0], 3), 25 * frame % 250, np.uint8)
            if noise:
                picture = rng.integers(0, 255, picture.shape, dtype=np.uint8)
            video.write(picture)
            if frame in (0, frames - 1):
                cv2.imwrite(str(folder / "overlay" / f"frame_{frame:06d}.png"), picture)
        video.release()

    return call


@pytest.fixture(scope="module")
def inspect(make_run):
    """`inspect(runs=..., pose=...)`: the run that `make_run` makes, under inspection."""
    opened = []

    def call(**arrays) -> Inspection:
        opened.append(load_run(make_run(**arrays)))
        return Inspection(opened[-1])

    yield call
    for run in opened:
        run.close()


class Page(HTMLParser):
    """What a browser would find: tags that nest, their attributes, and the text.

    Attributes:
        tags: (name, attributes), in order.
        text: all text outside of tags, styles left out.
    """

    VOID = ("meta", "img", "source")

    def __init__(self, html: str):
        super().__init__()
        self.tags, self.open, self.text, self.styles = [], [], "", ""
        self.feed(html)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            self.styles += data
        else:
            # Numbers and units are held together by spaces that do not break.
            self.text += data.replace("\u00a0", " ")

    def of(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]


@pytest.fixture(scope="session")
def parse():
    """A page read as a browser would; it fails where tags do not nest."""
    return Page
