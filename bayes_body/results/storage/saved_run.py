"""A run loaded from its folder: settings, model and session as they were when it was made, and the posterior, opened lazily.

The model is built from the text in `run.toml`, not from the user's file, which may have changed since. The same holds for the session: its numbers
are those that the run used. Its images are read from their original place.
"""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import jax.numpy as jnp
import numpy as np

from bayes_body.base.errors import escaped, input_error
from bayes_body.base.files.read import parse_json, read_text
from bayes_body.base.toml.read import parse_toml
from bayes_body.density.spaces import Space
from bayes_body.initial import apply_first_pose, restored
from bayes_body.model.body.solids import configuration_space
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import parse_definition
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.read import parse_session
from bayes_body.recording.session.session import Session
from bayes_body.results.posterior.blocks import stored_spaces
from bayes_body.results.posterior.diagnosis import first_frame_of, is_mode_seeker
from bayes_body.results.storage.manifest import AGAIN as MANIFEST_AGAIN
from bayes_body.results.storage.manifest import Manifest, check_result, input_digests, read_manifest
from bayes_body.results.storage.names import FRAMES_FOLDER, MANIFEST_FILE, POSTERIOR_FILE, RUN_FILE, SUMMARY_FILE
from bayes_body.results.storage.posterior_file import open_posterior
from bayes_body.results.storage.run_changes import check_plugins, kept_plugins
from bayes_body.results.storage.run_file import AGAIN, read_record, refuse_links

if TYPE_CHECKING:
    import xarray as xr


# It lists frames: some millions of them.
LARGEST_SUMMARY_BYTES = 200_000_000


@dataclass(frozen=True, eq=False)
class SavedRun:
    """The files of a run. `with load_run(folder) as run:` closes the posterior's file at the end, and so does `run.close()`.

    Attributes:
        folder: the run's folder.
        settings: the table `[run]` of `run.toml`: session, model, runs, seed, and first_frame and frames if they were given.
        kernel: the kernel's `kind` and every option.
        versions: versions of Python and of the packages, by name.
        texts: texts of the definition (`title`, `text`, `body_text`) and of the `session`.
        tree: `posterior.nc`, in the form that `posterior.to_datatree` describes; arrays are read on demand.
        summary: the content of `summary.json`; empty if there is none.
        inputs: digests of the recording's files.
        first_pose: the pose and the lengths that were fitted to the session's markers or keypoints; empty if nothing was fitted.
        plugins: the texts of the user's plugins that registered terms of this run, by file name.
        id: the run's id.
        smoothing: the run whose frames were smoothed, and the options; empty for the run of a filter.
        chains: the runs that were put together as the chains of this one (`ChainsTable`); empty for any other run.
    """

    folder: Path
    settings: Mapping[str, Any]
    kernel: Mapping[str, Any]
    versions: Mapping[str, str]
    texts: Mapping[str, str]
    tree: "xr.DataTree"
    summary: Mapping[str, Any]
    inputs: Mapping[str, str] = field(default_factory=dict)
    first_pose: Mapping[str, Any] = field(default_factory=dict)
    plugins: Mapping[str, str] = field(default_factory=dict)
    id: str = ""
    smoothing: Mapping[str, Any] = field(default_factory=dict)
    chains: Mapping[str, Any] = field(default_factory=dict)

    @property
    def smoothed(self) -> bool:
        """Whether draw d is one path through all frames, given all images. The particles of a filter's frame know only the images up to it."""
        return bool(self.smoothing)

    @property
    def kept(self) -> int | None:
        """Number of draws of a frame and run that are stored, if the run is thinned; None if all particles are."""
        return self.settings.get("keep")

    @cached_property
    def session(self) -> Session:
        """The session that the run used, from the run's first frame on.

        Raises:
            InputError: its text cannot be used, or it does not have the run's first frame.
        """
        folder = Path(self.settings["session"])
        subject = f"{self.folder / RUN_FILE}: the session's text"
        return excerpt(parse_session(parse_toml(self.texts["session"], subject), folder, subject), self.settings.get("first_frame"))

    @cached_property
    def changed_inputs(self) -> frozenset[str]:
        """The files of the recording, as `input_digests` names them, that are not those from which the run was made, or are gone.

        A stranger's run may name any file of this machine. Only files that are not among these may be shown.

        Raises:
            InputError: the session cannot be used, or a file cannot be read.
        """
        digests = input_digests(self.session)
        return frozenset(name for name in digests if digests[name] != self.inputs.get(name))

    @cached_property
    def model(self) -> Model:
        """The model of the definition and the session that are stored in `run.toml`.

        Raises:
            InputError: they cannot be used, the posterior belongs to another body, or a plugin of the run is not loaded.
        """
        check_plugins(self.folder, self.plugins)
        name, subject = Path(str(self.settings["model"])).stem, f"{self.folder / RUN_FILE}: the definition's text"
        model = build_model(parse_definition(name, self.texts["text"], self.texts.get("body_text"), subject), self.session)
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
    def settled_model(self) -> Model:
        """The model with the body and the cameras at their posterior mean in the last frame, which knows all images of a filter; for pictures.

        Raises:
            InputError: as for `model`.
        """
        group, weights = self.tree["posterior"], np.exp(np.asarray(self.tree["sample_stats"]["log_weight"].isel(frame=-1), float))
        weights = weights / weights.sum()
        means = {
            term.name: np.tensordot(weights, np.asarray(group[term.name].isel(frame=-1), float), 2)
            for term in self.model.unknowns
            if term.name in group
        }
        return self.model.settled({name: jnp.asarray(mean, self.model.body.lengths.dtype) for name, mean in means.items()})

    @cached_property
    def spaces(self) -> dict[str, Space]:
        """Where the variables of the posterior live (`stored_spaces`).

        Raises:
            InputError: a space cannot be read.
        """
        return stored_spaces(self.tree)

    @property
    def mode_seeker(self) -> bool:
        """Whether the kernel estimates no evidence. Its particles are then not a sample of the posterior, and no intervals are computed from them."""
        return is_mode_seeker(self.tree)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.tree["posterior"].sizes["frame"]

    @property
    def first_frame(self) -> int:
        """Number of the first frame in the recording (`Session.frame_number`)."""
        return first_frame_of(self.tree)

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
    """Return the run that `bayes-body track` wrote into a folder. The folder may come from a stranger: nothing in it is executed.

    Raises:
        InputError: the folder does not exist, it has no run or an unfinished one, or a file in it cannot be read or was changed.
        FaultyFileError: `run.toml` has faults; one sentence for each.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise input_error(folder, "a file" if folder.exists() else "no such folder", "the folder of a run", "check the path")
    if not (folder / RUN_FILE).exists():
        raise input_error(folder, f"no {RUN_FILE} in it", "the folder of a run", f"check the path, or {AGAIN}")
    refuse_links(folder)
    record = read_record(folder)
    if not (folder / POSTERIOR_FILE).exists():
        raise _unfinished(folder, record)
    manifest = read_manifest(folder)
    if manifest.run != record["check"]["run"]:
        problem, expected = f"belongs to another run ('{manifest.run}')", f"the results of this run ('{record['check']['run']}')"
        raise input_error(folder / MANIFEST_FILE, problem, expected, MANIFEST_AGAIN)
    summary, tree = _summary(folder, manifest), open_posterior(folder, manifest)
    return SavedRun(
        folder=folder,
        settings=record["run"],
        kernel=record["kernel"],
        versions=record["versions"],
        texts=record["definition"] | {"session": record["session"]["text"]},
        tree=tree,
        summary=summary,
        inputs=record.get("inputs", {}),
        first_pose=record.get("first_pose", {}),
        plugins=kept_plugins(record),
        id=record["check"]["run"],
        smoothing=record.get("smoothing", {}),
        chains=record.get("chains", {}),
    )


def _unfinished(folder: Path, record: Mapping[str, Any]) -> Exception:
    if any((folder / FRAMES_FOLDER).glob("*.npz")):
        verb, source = ("smooth", record["smoothing"]["folder"]) if record.get("smoothing") else ("track", record["run"]["session"])
        command = shlex.join(["bayes-body", verb, str(source), "--out", str(folder), "--resume"])
        return input_error(folder, f"holds frames but no {POSTERIOR_FILE}", "a finished run", f"continue it with `{escaped(command)}`")
    return input_error(folder, f"holds no {POSTERIOR_FILE}", "a finished run", AGAIN)


def _summary(folder: Path, manifest: Manifest) -> dict[str, Any]:
    """Return the content of `summary.json`; empty if there is none."""
    if not (folder / SUMMARY_FILE).exists():
        return {}
    check_result(folder, manifest, SUMMARY_FILE)
    path, kind = folder / SUMMARY_FILE, "the figures of a run, as JSON"
    summary = parse_json(read_text(path, kind, LARGEST_SUMMARY_BYTES), path, kind, MANIFEST_AGAIN)
    if not isinstance(summary, dict):
        raise input_error(path, type(summary).__name__, kind, MANIFEST_AGAIN)
    return summary
