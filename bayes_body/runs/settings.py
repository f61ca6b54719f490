"""The settings of a run: the user's, those of a run that is continued, and the defaults.

Choose the model for a session if the user names none; it depends on the data of the session.

The range of a recording's frames that a run tracks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.initial import Show
from bayes_body.initial.fitting.report import Source
from bayes_body.model.build import Model
from bayes_body.recording.observation.silhouettes import has_silhouettes
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.recording.session.session import Session
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.names import FRAMES_FOLDER, RESULTS, RUN_FILE
from bayes_body.results.storage.run_file import read_record, read_run_file, refuse_links

# Where the first pose comes from: from the session, or from the pictures where the session gives none; or from the pictures in any case.
GIVEN, AUTO = "given", "auto"
DEFAULTS = {"runs": 1, "seed": 0, "init": GIVEN}

COMBINE_AGAIN = "continue these runs, and put them together again with `bayes-body combine`"

type Record = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class LiveSettings:
    """Where the frames of a session come from while it is recorded.

    Attributes:
        folder: has a folder CAMERA_json of keypoint files for each camera.
        wait_s: seconds without a new file after which the recording has ended.
        port: the port of the page that shows the last second; 0 for a free one.
    """

    folder: Path
    wait_s: float
    port: int = 0


@dataclass(frozen=True)
class Settings:
    """The settings that the user gives. A value of None is replaced by that of the continued run, or else of the model, the session or DEFAULTS.

    Attributes:
        session: folder of the session.
        out: folder of the run.
        model: a definition's name or path; None chooses one by the session's data (`choose_model`).
        kernel: a kernel's name; None means the model's own.
        overrides: options of the kernel that differ from the definition's.
        runs: number of independent filters.
        first_frame: number of the first frame that is tracked, as in the file names; None for the session's first.
        frames: number of frames; None for all.
        seed: seed of everything random.
        init: where the first pose comes from, GIVEN or AUTO.
        recover: whether a run that lost the person starts anew where detectors find it; None means: for the kernel `particle_bp`.
        resume: whether to continue the run in the folder.
        keep: number of draws of a frame and run that are stored; None for all particles.
        pictures: whether to draw the video and the stills.
        live: where later frames come from; None if the session has them all.
    """

    session: Path
    out: Path
    model: str | None = None
    kernel: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    runs: int | None = None
    first_frame: int | None = None
    frames: int | None = None
    seed: int | None = None
    init: str | None = None
    recover: bool | None = None
    resume: bool = False
    keep: int | None = None
    pictures: bool = True
    live: LiveSettings | None = None


class Chosen(NamedTuple):
    """Settings with their defaults.

    None means: for `model`, chosen by the session's data; for `kernel`, the model's own; for `first_frame`, the session's; for `frames`, all; for
    `recover`, by the kernel; for `keep`, all particles. `live` says whether frames came while the session was recorded, in this process or before.
    """

    model: str | None
    kernel: str | None
    runs: int
    first_frame: int | None
    frames: int | None
    seed: int
    init: str
    recover: bool | None
    keep: int | None
    live: bool


def choose(settings: Settings, stored: Mapping[str, Mapping[str, Any]] | None) -> Chosen:
    """Return each setting: the user's value, or else the value of the run that is continued, or else the default."""
    defaults = DEFAULTS if stored is None else {**stored["run"], "kernel": stored["kernel"]["kind"]}
    values: dict[str, Any] = {name: getattr(settings, name) for name in Chosen._fields}
    chosen: dict[str, Any] = {name: defaults.get(name) if value is None else value for name, value in values.items()}
    # A run that ended may go on live: its number of frames is then no limit.
    limit = settings.frames if settings.live else chosen["frames"]
    return Chosen(**{**chosen, "frames": limit, "live": bool(chosen["live"])})


def check_live(model: Model, session: Session, source: Source, recover: bool) -> None:
    """Check that a run needs only keypoints, of cameras that stand still, and no search in pictures.

    Args:
        model: the model of the run.
        session: the recording.
        source: where the first pose comes from.
        recover: whether a lost run looks for the person again.

    Raises:
        InputError: it needs more.
    """
    if model.reads_pictures or model.reads_before:
        reads = [*model.reads, *["the frame before"] * model.reads_before, *["pictures, for its detectors"] * bool(model.definition.detectors)]
        problem = f"the model '{model.definition.name}' reads {' and '.join(reads)}"
        raise input_error("--live", problem, "a model that reads only the keypoints of a frame", f"give --model {KEYPOINT_MODEL}")
    if session.moves:
        raise input_error("--live", "a camera of the session moves", "cameras that stand still", "track it after the recording, without --live")
    if source == "searched":
        problem = f"frame {session.first_frame} has too few keypoints for a first pose, or --init auto looks for it in pictures"
        raise input_error("--live", problem, "keypoints of the person in that frame", "begin at a later one with --first-frame, without --init")
    if recover:
        raise input_error("--live", "a lost run would look for the person in pictures", "a run that does not", "give --no-recover")


def stored_record(settings: Settings) -> Record | None:
    """Return the tables of the run that is to be continued; None if a new run is started. The folder must be locked.

    Raises:
        InputError: a new run is to be started in a folder that has a run, or files that a run would replace; or the run's file cannot be read.
    """
    out = settings.out
    refuse_links(out)
    if settings.resume and (out / RUN_FILE).exists():
        record = read_run_file(out)
        if record.get("chains"):
            raise input_error(out, "runs that were put together", "the run of a filter", COMBINE_AGAIN)
        if record.get("smoothing"):
            raise input_error(out, "a smoothed run", "the run of a filter", "continue it with `bayes-body smooth`")
        return record
    refuse_occupied(out)
    return None


def refuse_occupied(out: Path) -> None:
    """Check that a new run can be made in a folder.

    Raises:
        InputError: it has a run, or files that a run would replace.
    """
    refuse_links(out)
    frames = len(FrameFiles(out / FRAMES_FOLDER))
    if frames and (out / RUN_FILE).exists():
        problem = f"holds a run that has {frames} frames"
        remedy = "continue it with --resume, or name another folder with --out"
        raise input_error(out, problem, "a folder without a run", remedy)
    # A run that stopped before its first frame may be started anew. Everything else may be somebody's work.
    taken = [name for name in RESULTS if (out / name).exists()]
    if taken:
        remedy = "name another with --out, continue it with --resume, or remove it" if (out / RUN_FILE).exists() else "name another with --out"
        raise input_error(out, f"holds {taken[0]}, which a run would replace", "a folder without a run", remedy)
    if (out / RUN_FILE).exists():
        # A file of that name that is not a run's is not replaced either.
        read_record(out)


KEYPOINT_MODEL, SILHOUETTE_MODEL, ONE_CAMERA_MODEL = "keypoints", "silhouettes", "walker_from_the_side"
ONE_VIEW = "in one view depth is uncertain: expect wide intervals"
LEGS = "it tracks the legs only, of a person who walks past the camera"


class ModelChoice(NamedTuple):
    """A definition's name, the reason as part of a sentence, and what the model cannot do for this session; empty if there is nothing to say."""

    model: str
    reason: str
    limits: str = ""

    @property
    def sentence(self) -> str:
        """The line that `bayes-body track` prints."""
        return "; ".join([f"model      {self.model}, because {self.reason}", *([self.limits] if self.limits else []), "--model names another."])


def choose_model(session: Session) -> ModelChoice:
    """Return the model that the data call for: keypoints, else silhouettes, of one still camera or of several cameras.

    All sample the posterior; a mode seeker is never chosen.

    Raises:
        InputError: the session has neither keypoints nor silhouettes.
    """
    count, cameras = sum(view.keypoints is not None for view in session.views), len(session.views)
    if count:
        return ModelChoice(
            KEYPOINT_MODEL, f"{count} of {cameras} cameras {'has' if count == 1 else 'have'} keypoints", ONE_VIEW if count == 1 else ""
        )
    source = _silhouette_source(session)
    if source and cameras == 1 and not session.moves:
        return ModelChoice(
            ONE_CAMERA_MODEL, f"the session has one still camera, with silhouettes ({source}) and no keypoints", f"{LEGS}, and {ONE_VIEW}"
        )
    if source:
        return ModelChoice(SILHOUETTE_MODEL, f"the session has silhouettes ({source}) and no keypoints", ONE_VIEW if cameras == 1 else "")
    problem, expected = "neither keypoints nor silhouettes", "one of the two in every frame"
    remedy = "import the recording with --keypoints or --masks, give each [[camera]] the `background` of an empty scene, or name a --model"
    raise input_error(session.folder / FILE_NAME, problem, expected, remedy)


def _silhouette_source(session: Session) -> str:
    """Return the source of the silhouettes in words; empty if there can be none. The background of a moving camera cannot be learned."""
    without = [view for view in session.views if view.masks is None]
    if not without:
        return "masks"
    learned = [view for view in without if view.background is None]
    if not has_silhouettes(session) or any(view.path is not None for view in learned):
        return ""
    return "from a background that is learned from the frames" if learned else "from an image of the empty scene"


def frames_from(session: Session, first_frame: int | None, show: Show) -> Session:
    """Return the session from a frame on; a note tells the user if its first pose belongs to another frame.

    Args:
        session: the recording.
        first_frame: number of the first frame that is tracked; the session's by default.
        show: receives lines for the user.

    Raises:
        InputError: the session does not have the frame.
    """
    part = excerpt(session, first_frame)
    # Keypoints of all frames have those of the new first one too.
    has_first_pose = session.initial or session.initial_markers or (session.initial_keypoints and not any(view.keypoints for view in session.views))
    if has_first_pose and part.first_frame != session.first_frame:
        show(f"note: the first pose in session.toml belongs to frame {session.first_frame}, and is not used for frame {part.first_frame}.")
    return part


def number_of_first(session: Session, whole: Session) -> int | None:
    """Return the number of a run's first frame as `run.toml` stores it; None for the first of the session."""
    return None if session.first_frame == whole.first_frame else session.first_frame
