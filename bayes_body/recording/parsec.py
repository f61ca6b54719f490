"""A recording of the PARSEC suite's bodytrack (Intel 2006; also the layout of Balan et al.'s data) as a session."""

from pathlib import Path

from bayes_body.errors import wrong
from bayes_body.recording.faults import Faults
from bayes_body.recording.parsec_subject import POSITIONS, read_subject
from bayes_body.recording.parsec_views import read_views
from bayes_body.session import Session, load_session, save_session

# The format does not say; the subject's steps and speed fit 60 (about 15 mm a frame).
FPS = 60.0


def import_parsec(source: Path, folder: Path) -> tuple[Session, list[str]]:
    """Write the session of a bodytrack folder; its images stay where they are.

    Args:
        source: holds CALIB, CAMc, FGc, BodyShapeParameters.txt, InitialPose.txt and PoseParameters.txt.
        folder: where `session.toml` is to lie; made if need be.

    Returns:
        The session as saved, and remarks for the user, a sentence each.

    Raises:
        FaultyFileError: one sentence for each thing in the source that is missing or wrong.
        InputError: `source` is no folder, or `folder` cannot be written.
    """
    if not source.is_dir():
        raise wrong(source, "no such folder", "a bodytrack recording (CALIB, CAM1, FG1, InitialPose.txt ...)", "check the path")
    faults, recorded, known = Faults(), None, None
    with faults.collect():
        recorded = read_views(source)
    with faults.collect():
        known = read_subject(source)
    if recorded is None or known is None:
        faults.raise_any()
        raise AssertionError("a reader neither returned nor raised")
    session = Session(
        folder=folder.resolve(),
        title=f"bodytrack recording {source.resolve().name}",
        up="z",
        fps=FPS,
        frames=recorded.frames,
        first_frame=recorded.first_frame,
        views=recorded.views,
        subject=known.subject,
        initial=known.initial,
        positions=frozenset(POSITIONS),
    )
    # Read back: what the caller works with is what the file says, rounded as it is.
    return load_session(save_session(session)), [*recorded.remarks, *known.remarks, _fps_remark()]


def _fps_remark() -> str:
    return f"The recording does not say its frame rate: {FPS:g} frames a second are assumed; correct fps in session.toml if you know better."
