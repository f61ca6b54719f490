"""What every test stands on: shape checks, the real recordings where they are, and small sessions and runs."""

import dataclasses
import gc
import os
import runpy
import shutil
import sys
import types
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import NamedTuple

import beartype
import cv2
import hypothesis
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import tomlkit
import xarray as xr
from beartype.roar import BeartypeDecorHintException
from browser import browser, tab  # noqa: F401


def _check_shapes(function):
    """Beartype, except where a value may rightly not have its annotated shape or beartype does not know the annotation.

    A dataclass is rebuilt by every `vmap` and `tree.map`, with batched leaves: its `__init__` is left alone, functions that take it are not.
    """
    if function.__name__ == "__init__":
        return function
    try:
        return _nested_checker(function) if "<locals>" in function.__qualname__ else beartype.beartype(function)
    except BeartypeDecorHintException:
        return function


_nested_checkers: dict[Hashable, Callable] = {}


def _nested_checker(function):
    """Beartype of a nested function, made once: it is defined at each call of the one around it, and its checker takes milliseconds to make.

    What jaxtyping gives to its checker has the signature of the function and nothing of its body, so of two with one signature either will do.
    """
    code = function.__code__
    counts = code.co_posonlyargcount, code.co_argcount, code.co_kwonlyargcount, code.co_flags
    key = function.__module__, function.__qualname__, code.co_varnames, counts, tuple(function.__annotations__.items())
    try:
        hash(key)
    except TypeError:
        # An annotation that holds a list, for example.
        return beartype.beartype(function)
    if key not in _nested_checkers:
        _nested_checkers[key] = beartype.beartype(function)
    return _nested_checkers[key]


# jaxtyping takes its checker as the name of something importable.
_checks = types.ModuleType("bayes_body_shape_checks")
_checks.check = _check_shapes
sys.modules[_checks.__name__] = _checks
jaxtyping.install_import_hook("bayes_body", f"{_checks.__name__}.check")

from sealed import seal  # noqa: E402

from bayes_body.density.spaces import space_to_text  # noqa: E402
from bayes_body.model.body.solids import configuration_space, pose_space  # noqa: E402
from bayes_body.model.build import build_model  # noqa: E402
from bayes_body.model.definition import load_definition, parse_definition  # noqa: E402
from bayes_body.recording.evidence.markers import MARKERS  # noqa: E402
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series  # noqa: E402
from bayes_body.recording.session.read import save_session  # noqa: E402
from bayes_body.recording.session.session import CameraSpec, Session, Subject, View  # noqa: E402
from bayes_body.results.posterior.blocks import SPACE  # noqa: E402


def _mappings() -> int:
    """How many memory mappings this process holds; zero where the system does not say."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


# Tracing makes many small objects that stay: at Python's usual thresholds, looking for garbage among them took two fifths of its time.
gc.freeze()
gc.set_threshold(50_000, 50, 50)

# An example that a busy machine computes slowly is no failure.
hypothesis.settings.register_profile("no deadline", deadline=None)
hypothesis.settings.load_profile("no deadline")

# Linux gives a process 65 530 mappings, and every compiled program holds some: past the end, reading one more is a segmentation fault.
MOST_MAPPINGS = 20_000


def pytest_runtest_teardown(item, nextitem):
    """Between files, let go of compiled programs before there are too many: they come back from the compilation cache."""
    if nextitem is not None and nextitem.path != item.path and _mappings() > MOST_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def optimised():
    """For programs that run longer than they compile: those of this process and of its children are compiled as a user's are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "0")
        before = jax.config.read("jax_disable_most_optimizations")
        # JAX keeps what it compiled whatever this setting was: without clearing, one run would mix both kinds.
        jax.clear_caches()
        jax.config.update("jax_disable_most_optimizations", False)
        yield
        jax.config.update("jax_disable_most_optimizations", before)
        jax.clear_caches()


@pytest.fixture(scope="session")
def data_dir():
    """The folder of a set of real recordings: `data_dir("bodytrack_4cam")`, or a skip that says which set is wanted."""

    def folder(name: str) -> Path:
        root = os.environ.get("BAYES_BODY_DATA")
        if not root or not (Path(root) / name).is_dir():
            pytest.skip(f"set BAYES_BODY_DATA to the folder that holds {name}")
        return Path(root) / name

    return folder


@pytest.fixture(scope="session")
def bodytrack(data_dir) -> Path:
    """One man walking, four calibrated grey cameras, four frames with silhouettes."""
    return data_dir("bodytrack_4cam")


@pytest.fixture(scope="session")
def cmu_mocap(data_dir) -> Path:
    """Motion capture: asf and amc."""
    return data_dir("cmu_mocap")


@pytest.fixture(scope="session")
def pose2sim_beam(data_dir) -> Path:
    """One man on a beam, four colour cameras, laid out as a Pose2Sim project."""
    return data_dir("pose2sim_beam")


@pytest.fixture(scope="session")
def sports2d_walk(data_dir) -> Path:
    """One walker seen by one camera."""
    return data_dir("sports2d_walk")


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

    def image(self, name: str) -> Path:
        """The image `name`, such as `FG2/image0001.bmp`, as a file that may be damaged; the others of its folder stay links."""
        path = self.own(name.split("/")[0]) / name.split("/")[1]
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content)
        return path

    def edit(self, name: str, change: Callable[[list[str]], list[str]]) -> Path:
        """Rewrite a text file as `change` of its numbers."""
        path = self.folder / name
        path.write_text("\n".join(change(path.read_text().split())))
        return path


@pytest.fixture
def copy(bodytrack: Path, tmp_path: Path) -> Copy:
    """A damageable copy of the real recording."""
    return Copy(bodytrack, tmp_path / "source")


def _camera(name, azimuth, size):
    """A camera three metres from the z axis, 1.2 m up, looking horizontally at it."""
    forward = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    centre = np.array([3 * np.cos(azimuth), 3 * np.sin(azimuth), 1.2])
    return CameraSpec(name, size, (200.0, 205.0), (size[0] / 2, size[1] / 2), 0.0, (-0.1, 0.02, 0.001, -0.001, 0.0), rotation, -rotation @ centre)


@pytest.fixture(scope="session")
def textured_session(tmp_path_factory):
    """Two cameras of different sizes, five frames of drifting blobs: images and masks that come from no body."""
    folder = tmp_path_factory.mktemp("textured")
    rng = np.random.default_rng(7)
    views = []
    for name, azimuth, size in (("a", 0.3, (160, 120)), ("b", 1.9, (128, 144))):
        (folder / name).mkdir()
        field = cv2.GaussianBlur(rng.normal(size=size[::-1]).astype(np.float32), (0, 0), 9)
        for frame in range(5):
            moved = np.roll(field, 2 * frame, axis=1)
            level = (moved - moved.min()) / (moved.max() - moved.min())
            cv2.imwrite(str(folder / name / f"image{frame:04d}.png"), (level * 255).astype(np.uint8))
            cv2.imwrite(str(folder / name / f"mask{frame:04d}.png"), ((level > 0.5) * 255).astype(np.uint8))
        views.append(View(_camera(name, azimuth, size), f"{name}/image%04d.png", f"{name}/mask%04d.png"))
    return Session(folder, "blobs", "z", 60.0, 5, 0, tuple(views), Subject(height_m=1.7))


@pytest.fixture(scope="session")
def keypoint_session(textured_session):
    """The same with keypoints, which come from no body either."""
    views = []
    for view in textured_session.views:
        points = np.random.default_rng(8).uniform(0, view.camera.size_px, (5, len(MARKERS), 2))
        series = KeypointSeries(np.concatenate([points, np.full((5, len(MARKERS), 1), 0.9)], axis=-1), MARKERS, 0)
        write_series(textured_session.folder / f"{view.camera.name}.npz", series)
        views.append(dataclasses.replace(view, keypoints=f"{view.camera.name}.npz"))
    return dataclasses.replace(textured_session, views=tuple(views))


def loose_limbed(text: str) -> str:
    """The text of a model of the arm, with a body that is placed by its parts."""
    by_angles = 'kind = "diffusion"\nat_fps = 60\n\n[dynamics.sd_deg]\n"shoulder_*" = 3.0\nelbow = 4.0\n'
    body = 'name = "arm_4"\n'
    assert text.count(by_angles) == text.count(body) == 1
    return text.replace(by_angles, 'kind = "rigid_walk"\n').replace(body, f'{body}placement = "parts"\n')


@jax.jit
def _placed(body, poses):
    return jax.vmap(lambda pose: body.placement.configuration(body.skeleton, pose))(poses)


def _parts(body, pose):
    """The posterior of a body that is placed by its parts, from poses."""
    space = configuration_space(body)
    parts = _placed(body, jnp.asarray(pose.reshape(-1, pose.shape[-1])))
    names, entries = space.axes
    values = (
        ("chain", "draw", "frame", names.name, entries.name),
        np.asarray(parts).reshape(*pose.shape[:-1], *space.shape),
        {SPACE: space_to_text(space)},
    )
    return xr.Dataset({"parts": values}, {names.name: list(names.labels), entries.name: list(entries.labels)})


@pytest.fixture(scope="session")
def body_of():
    """`body_of(definition, session)`: its body, built once for each text and axis."""
    bodies = {}

    def call(definition, session):
        key = (definition.text, definition.body_text, session.up)
        if key not in bodies:
            bodies[key] = build_model(definition, session).body
        return bodies[key]

    return call


@pytest.fixture
def make_run(textured_session, body_of, tmp_path):
    """`make_run(frames=5, pose=..., log_weight=..., lost=...)`: the folder of a run of a model, arrays as (chain, draw, frame, ...).

    With `parts=True` the body is placed by its parts, which are where the poses place them.
    """

    def call(name="run", model="arm", up="z", runs=2, draws=30, frames=5, parts=False, **arrays) -> Path:
        session = dataclasses.replace(textured_session, folder=tmp_path / "session", up=up)
        save_session(session)
        rng = np.random.default_rng(1)
        pose = arrays.get("pose", rng.uniform(-1, 0, size=(runs, draws, frames, 4)))
        log_weight = arrays.get("log_weight", rng.normal(size=(runs, draws, frames)))
        lost = arrays.get("lost", np.zeros((runs, frames), bool))
        log_evidence = arrays.get("log_evidence", np.zeros((runs, frames)))
        definition = load_definition(model)
        body = body_of(definition, session)
        labels = {"dof": list(body.dof_names), "unit": ("dof", list(body.skeleton.topology.dof_units))}
        posterior = xr.Dataset({"pose": (("chain", "draw", "frame", "dof"), pose, {SPACE: space_to_text(pose_space(body))})}, labels)
        if parts:
            definition = parse_definition(model, loose_limbed(definition.text), definition.body_text)
            posterior = _parts(body_of(definition, session), pose)
        tree = xr.DataTree.from_dict(
            {
                "posterior": posterior,
                "sample_stats": xr.Dataset({"log_weight": (("chain", "draw", "frame"), log_weight)}),
                "filter": xr.Dataset({"lost": (("chain", "frame"), lost), "log_evidence": (("chain", "frame"), log_evidence)}),
            }
        )
        tree.attrs.update(arrays.get("attributes", {}))
        folder = tmp_path / name
        folder.mkdir()
        tree.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
        document = {
            "run": {"session": str(session.folder), "model": str(model), "runs": runs, "seed": 0},
            "kernel": {"kind": "sir", "particles": draws},
            "versions": {"python": "3.12"},
            "definition": {"title": definition.title, "text": definition.text, "body_text": definition.body_text},
            "session": {"text": (session.folder / "session.toml").read_text(encoding="utf-8")},
        }
        (folder / "run.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
        (folder / "summary.json").write_text('{"rhat_max": 1.5}', encoding="utf-8")
        seal(folder, frames)
        return folder

    return call


class Outcome(NamedTuple):
    """How a program ended: exit status, and what it wrote."""

    status: int
    out: str
    err: str


@pytest.fixture
def program_runner(capsys, monkeypatch):
    """`program_runner(path, "--quick")`: what a program does, run in this process as `python path --quick`; an uncaught error fails."""

    def call(program: Path, *arguments: object) -> Outcome:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", [str(program), *map(str, arguments)])
        status = 0
        try:
            runpy.run_path(str(program), run_name="__main__")
        except SystemExit as stopped:
            status = stopped.code
        return Outcome(status, *capsys.readouterr())

    return call
