"""A run loaded from its folder: settings, model and session as they were when it was made, and the posterior, opened lazily.

The model is built from the text in `run.toml`, not from the user's file, which may have changed since. The same holds for the session: its numbers
are those that the run used. Its images are read from their original place.
"""

import json
import shlex
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from bayes_body.body.space import configuration_space, pose_space
from bayes_body.density.spaces import Space
from bayes_body.errors import InputError, input_error
from bayes_body.initial import apply_first_pose, restored
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import parse_definition
from bayes_body.posterior.diagnosis import is_mode_seeker
from bayes_body.posterior.stored_spaces import SPACE, stored_spaces
from bayes_body.session.read import load_session, parse_session
from bayes_body.session.session import Session
from bayes_body.storage.names import FRAMES_FOLDER, POSTERIOR_FILE, RUN_FILE, SUMMARY_FILE
from bayes_body.storage.run_file import check_plugins, kept_plugins
from bayes_body.toml.read import parse_toml, read_toml

if TYPE_CHECKING:
    import xarray as xr

GROUPS = ("posterior", "sample_stats", "filter")
AGAIN = "make the run again with `bayes-body track`"


@dataclass(frozen=True, eq=False)
class SavedRun:
    """The files of a run. `with load_run(folder) as run:` closes the posterior's file at the end, and so does `run.close()`.

    Attributes:
        folder: the run's folder.
        settings: the table `[run]` of `run.toml`: session, model, runs, seed, and frames if it was given.
        kernel: the kernel's `kind` and every option.
        versions: versions of Python and of the packages, by name.
        texts: texts of the definition (`title`, `text`, `body_text`) and of the `session`, if the run stores them.
        tree: `posterior.nc`, in the form that `posterior.to_datatree` describes; arrays are read on demand.
        summary: the content of `summary.json`; empty if there is none.
        first_pose: the pose and the lengths that were fitted to the session's markers or keypoints; empty if nothing was fitted.
        plugins: the texts of the user's plugins that registered terms of this run, by file name.
    """

    folder: Path
    settings: Mapping[str, Any]
    kernel: Mapping[str, Any]
    versions: Mapping[str, str]
    texts: Mapping[str, str]
    tree: "xr.DataTree"
    summary: Mapping[str, Any]
    first_pose: Mapping[str, Any] = field(default_factory=dict)
    plugins: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def session(self) -> Session:
        """The session that the run used; if the run does not store its text, the present `session.toml`.

        Raises:
            InputError: the run does not store the text, and there is no `session.toml`.
        """
        folder = Path(self.settings["session"])
        if "session" not in self.texts:
            return load_session(folder)
        where = f"{self.folder / RUN_FILE}: the session's text"
        return parse_session(parse_toml(self.texts["session"], where), folder, where)

    @cached_property
    def model(self) -> Model:
        """The model of the definition and the session that are stored in `run.toml`.

        Raises:
            InputError: they cannot be used, the posterior belongs to another body, or a plugin of the run is not loaded.
        """
        check_plugins(self.folder, self.plugins)
        name, where = Path(str(self.settings["model"])).stem, f"{self.folder / RUN_FILE}: the definition's text"
        model = build_model(parse_definition(name, self.texts["text"], self.texts.get("body_text"), where), self.session)
        first = configuration_space(model.body).axes[0]
        posterior = self.tree["posterior"].to_dataset()
        stored = np.asarray(posterior[first.name]).astype(str).tolist() if first.name in posterior.coords else []
        if stored != list(first.labels):
            raise input_error(
                self.folder / POSTERIOR_FILE, f"{first.name}s {', '.join(stored)}", f"those of {RUN_FILE}: {', '.join(first.labels)}", AGAIN
            )
        if not self.first_pose:
            return model
        return apply_first_pose(model, self.session, restored(model, self.first_pose, f"{self.folder / RUN_FILE}: first_pose"))

    @cached_property
    def spaces(self) -> dict[str, Space]:
        """Where the variables of the posterior live (`stored_spaces`). For a run of an older version, the pose's space is that of the run's body.

        Raises:
            InputError: a space cannot be read.
        """
        found = stored_spaces(self.tree)
        if "pose" in found and SPACE not in self.tree["posterior"]["pose"].attrs:
            # If the body can no longer be built, a pose has plain numbers.
            with suppress(InputError):
                found["pose"] = pose_space(self.model.body)
        return found

    @property
    def mode_seeker(self) -> bool:
        """Whether the kernel estimates no evidence. Its particles are then not a sample of the posterior, and no intervals are computed from them."""
        return is_mode_seeker(self.tree)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.tree["posterior"].sizes["frame"]

    @property
    def fps(self) -> float:
        """The session's frames a second."""
        return self.session.fps

    def close(self) -> None:
        """Close the posterior's file."""
        self.tree.close()

    def __enter__(self) -> Self:
        """Return the run itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the posterior's file."""
        self.close()


def load_run(folder: Path | str) -> SavedRun:
    """Return the run that `bayes-body track` wrote into a folder.

    Raises:
        InputError: the folder does not exist, it has no run or an unfinished one, or a file in it cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise input_error(folder, "a file" if folder.exists() else "no such folder", "the folder of a run", "check the path")
    if not (folder / RUN_FILE).exists():
        raise input_error(folder, f"no {RUN_FILE} in it", "the folder of a run", "check the path, or make a run with `bayes-body track`")
    tables = read_toml(folder / RUN_FILE)
    settings, kernel, versions, definition = (_table(folder, tables, name) for name in ("run", "kernel", "versions", "definition"))
    _check_keys(folder, {"run": (settings, ("session", "model")), "kernel": (kernel, ("kind",)), "definition": (definition, ("text",))})
    session = tables.get("session")
    if isinstance(session, dict) and isinstance(session.get("text"), str):
        definition = definition | {"session": session["text"]}
    first_pose = tables.get("first_pose")
    kept = first_pose if isinstance(first_pose, dict) else {}
    tree, summary = _open_posterior(folder, settings), _summary(folder)
    return SavedRun(folder, settings, kernel, versions, definition, tree, summary, kept, kept_plugins(tables))


def _table(folder: Path, tables: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = tables.get(name)
    if not isinstance(table, dict):
        raise input_error(f"{folder / RUN_FILE}: {name}", "missing" if table is None else "not a table", f"a table [{name}]", AGAIN)
    return table


def _check_keys(folder: Path, wanted: Mapping[str, tuple[Mapping[str, Any], tuple[str, ...]]]) -> None:
    for name, (table, keys) in wanted.items():
        for key in keys:
            if not isinstance(table.get(key), str):
                raise input_error(f"{folder / RUN_FILE}: {name}.{key}", "missing" if key not in table else f"{table[key]}", "a string", AGAIN)


def _open_posterior(folder: Path, settings: Mapping[str, Any]) -> "xr.DataTree":
    import xarray as xr

    path = folder / POSTERIOR_FILE
    if not path.exists():
        raise _unfinished(folder, settings)
    try:
        tree = xr.open_datatree(path, engine="h5netcdf")
    # A damaged file can raise any exception in the reader, from OSError to KeyError.
    except Exception as error:
        raise input_error(
            path, f"cannot be read ({str(error).splitlines()[0] if str(error) else type(error).__name__})", "a posterior", AGAIN
        ) from None
    missing = [name for name in GROUPS if name not in tree.children]
    if missing:
        tree.close()
        raise input_error(path, f"no group {', '.join(missing)} in it", f"the groups {', '.join(GROUPS)}", AGAIN)
    return tree


def _unfinished(folder: Path, settings: Mapping[str, Any]) -> Exception:
    if any((folder / FRAMES_FOLDER).glob("*.npz")):
        command = shlex.join(["bayes-body", "track", str(settings["session"]), "--out", str(folder), "--resume"])
        return input_error(folder, f"holds frames but no {POSTERIOR_FILE}", "a finished run", f"continue it with `{command}`")
    return input_error(folder, f"holds no {POSTERIOR_FILE}", "a finished run", AGAIN)


def _summary(folder: Path) -> dict[str, Any]:
    path = folder / SUMMARY_FILE
    if not path.exists():
        return {}
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise input_error(path, f"cannot be read ({error})", "the figures of a run, as JSON", f"remove it, or {AGAIN}") from None
    if not isinstance(summary, dict):
        raise input_error(path, type(summary).__name__, "the figures of a run, as JSON", f"remove it, or {AGAIN}")
    return summary
