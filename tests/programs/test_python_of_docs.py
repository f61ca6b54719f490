"""The Python of README and documentation: every block compiles and names what exists, and runs on one small session and its run."""

import ast
import builtins
import dataclasses
import importlib
import inspect
import re
import types
from pathlib import Path

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from programs.pages import README, blocks, python_blocks, sections

import bayes_body as bb
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.results.posterior import markers, mean_pose
from bayes_body.results.storage import FrameFiles
from bayes_body.tracking.draws import Draws, timing_of

BLOCKS = python_blocks()
# Packages that a page is about, and that nobody needs for this one.
EXTERNAL = {"Pose2Sim"}
# What the text above a block names, such as a session.
GIVEN = {
    "docs/guide/accuracy.md #0": {"session", "draws"},
    "docs/internals/terms.md #0": {"weights", "points"},
}
# Blocks with tests of their own (the plugins: test_plugins_guide.py), and a fragment.
ELSEWHERE = {"README.md #0", "docs/guide/sources.md #0", *(name for name in BLOCKS if name.startswith("docs/guide/plugins.md"))}
# Less work than a reader's.
SMALLER = {
    "README.md #1": ("model, runs=2)", "model, particles=50, runs=2)"),
    "docs/guide/first_run.md #3": ("model, runs=2)", "model, particles=50, runs=2)"),
    "docs/guide/message_passing.md #0": ("samples=100, iterations=10", "samples=50, iterations=2"),
    "docs/gallery.md #0": ("range(0, 120, 3)", "range(0, 9, 3)"),
}
# These search for a person, fit a motion, or compile messages.
LONG = {"docs/internals/initial.md #1", "docs/guide/mocap.md #0", "docs/guide/mocap.md #2", "docs/guide/message_passing.md #0"}
RUN = [pytest.param(name, marks=pytest.mark.long if name in LONG else pytest.mark.slow) for name in BLOCKS if name not in ELSEWHERE]


def test_every_name_of_a_list_here_is_a_block():
    assert ELSEWHERE | LONG | set(GIVEN) | set(SMALLER) <= set(BLOCKS) and len(BLOCKS) > 20


def imported(tree: ast.Module) -> dict[str, object]:
    """What the imports of a block bind; each must exist."""
    bound = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for name in node.names:
                module = importlib.import_module(name.name)
                bound[name.asname or name.name.split(".")[0]] = module if name.asname else importlib.import_module(name.name.split(".")[0])
        elif isinstance(node, ast.ImportFrom):
            if node.module in EXTERNAL:
                bound |= {name.asname or name.name: None for name in node.names}
                continue
            module = importlib.import_module(node.module)
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")
                bound[name.asname or name.name] = getattr(module, name.name)
    return bound


def meaning(node: ast.expr, bound: dict[str, object]) -> object:
    """What a name or a path of attributes stands for, as long as it leads through modules and classes; None beyond."""
    if isinstance(node, ast.Name):
        return bound.get(node.id)
    if isinstance(node, ast.Attribute):
        owner = meaning(node.value, bound)
        if isinstance(owner, types.ModuleType | type):
            assert hasattr(owner, node.attr), f"line {node.lineno}: {ast.unparse(node)} does not exist"
            return getattr(owner, node.attr)
    return None


def unknown_names(tree: ast.Module) -> set[str]:
    """Names that a block reads and nowhere makes."""
    names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    made = {node.id for node in names if not isinstance(node.ctx, ast.Load)}
    made |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    made |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return {node.id for node in names if isinstance(node.ctx, ast.Load)} - made - set(dir(builtins))


@pytest.mark.parametrize("name", BLOCKS)
def test_a_block_compiles_and_names_what_exists(name):
    tree = ast.parse(BLOCKS[name])
    compile(tree, name, "exec")
    bound = imported(tree)
    assert unknown_names(tree) - set(bound) == GIVEN.get(name, set())
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            meaning(node, bound)
        if isinstance(node, ast.Call):
            check_arguments(node, meaning(node.func, bound))


def check_arguments(call: ast.Call, function: object) -> None:
    """A function of this package takes these arguments today."""
    whole = not any(isinstance(each, ast.Starred) or ast.unparse(each) == "..." for each in call.args)
    # An exception without an `__init__` of its own has no signature.
    is_exception = isinstance(function, type) and issubclass(function, Exception)
    if whole and not is_exception and (getattr(function, "__module__", None) or "").startswith("bayes_body"):
        inspect.signature(function).bind(*call.args, **{each.arg: each.value for each in call.keywords if each.arg})


@pytest.fixture(scope="module")
def folder(walked, data_dir):
    """Where the guide's reader is: the session `walk`, its run, and the files that a page's commands made before."""
    (walked / "beam").symlink_to(walked / "walk")
    (walked / "bayes_body_demo").mkdir()
    (walked / "bayes_body_demo" / "run").symlink_to(walked / "walk_run")
    ranks = np.random.default_rng(0).uniform(size=(1, 200, 2))
    rank = xr.Dataset({"rank": (("chain", "draw", "quantity"), ranks)}, {"quantity": ["elbow", "log-likelihood"]})
    xr.DataTree.from_dict({"prior_sbc": rank}).to_netcdf(walked / "sir.ranks.nc", engine="h5netcdf")
    for motion in ("02_01", "39_01"):
        subject = data_dir("cmu_mocap") / motion[:2]
        for name in (f"{motion}.amc", f"{subject.name}.asf"):
            (walked / name).symlink_to(subject / name)
    matplotlib.use("Agg")
    return walked


def accuracy_names(folder: Path) -> dict[str, object]:
    """A tracked session with a truth: the run three times over, and its own mean markers, moved."""
    with bb.load_run(folder / "walk_run") as run:
        frames = list(FrameFiles(run.folder / "frames", run.id)) * 3
        truth = np.full((len(frames), len(MARKERS), 3), np.nan)
        for place, frame in enumerate(frames):
            truth[place, [MARKERS.index(name) for name in run.model.body.markers.names]] = markers(run.model, mean_pose(frame, run.model))[0] + 0.01
        np.savez(folder / "marker_truth.npz", markers=truth, names=np.array(MARKERS))
        session = dataclasses.replace(run.session, frames=len(frames), truth=str(folder / "marker_truth.npz"))
        return {"session": session, "draws": Draws(run.model, frames, timing_of(frames), tuple(view.camera.name for view in session.views))}


def space_names(folder: Path) -> dict[str, object]:
    """Draws of the transforms of two parts."""
    points = np.random.default_rng(0).normal(size=(50, 2, 7))
    points[..., 3:] = [1.0, 0.0, 0.0, 0.0]
    return {"weights": np.full(50, 0.02), "points": points}


NAMES = {"docs/guide/accuracy.md #0": accuracy_names, "docs/internals/terms.md #0": space_names}


@pytest.mark.usefixtures("optimised")
@pytest.mark.filterwarnings("ignore::bayes_body.base.errors.RunWarning")
@pytest.mark.parametrize("name", RUN)
def test_a_block_runs(folder, tmp_path, monkeypatch, name):
    work = tmp_path / "work"
    work.mkdir()
    for path in folder.iterdir():
        (work / path.name).symlink_to(path)
    monkeypatch.chdir(work)
    before, after = SMALLER.get(name, ("", ""))
    assert before in BLOCKS[name]
    exec(compile(BLOCKS[name].replace(before, after, 1) if before else BLOCKS[name], name, "exec"), NAMES.get(name, lambda folder: {})(folder))
    plt.close("all")


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_the_sampler_of_the_readme_runs(walk, monkeypatch):
    monkeypatch.chdir(walk.parent)
    (block,) = blocks(sections(README)["Your own sampler in 20 lines"], "python")
    assert len([line for line in block.splitlines() if line]) <= 20
    few = "chains, warm_up, draws = 2, 10, 10"
    names = {}
    exec(compile(re.sub(r"chains, warm_up, draws = .*", few, block), "README.md", "exec"), names)
    model, pose = names["model"], names["tree"]["posterior"]["pose"]
    assert pose.sizes == {"chain": 2, "draw": 10, "dof": len(model.body.dof_names)}
    low, high = model.body.skeleton.low, model.body.skeleton.high
    assert ((pose.values >= low) & (pose.values <= high)).all()
    # The chains start at different poses near the first one, and move.
    starts = [model.transition.sample(key, model.initial)["pose"] for key in jax.random.split(jax.random.key(0), 2)]
    assert np.abs(starts[0] - starts[1]).max() > 0.01
    assert (pose.std("draw") > 0).all() and abs(pose.sel(dof="root_z").mean() - 0.87) < 0.1
    assert Path("nuts.png").stat().st_size > 1000
