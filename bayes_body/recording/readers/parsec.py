"""Import a recording of the PARSEC suite's bodytrack (Intel 2006; also the layout of Balan et al.'s data) as a session."""

from dataclasses import replace
from pathlib import Path

from bayes_body.recording.readers.assemble import saved, source_folder, with_options
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.imported_keypoints import with_imported_keypoints
from bayes_body.recording.readers.options import Options, check_fps, check_height
from bayes_body.recording.readers.parsec_subject import POSITIONS, read_subject
from bayes_body.recording.readers.parsec_views import REMARK_NO_MASKS, read_views
from bayes_body.recording.readers.timing import align
from bayes_body.recording.session.session import Session

# The format does not state it. The subject's steps and speed fit 60 (about 15 mm per frame).
FPS = 60.0


def import_parsec(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a bodytrack folder. Its images stay where they are.

    Args:
        source: holds CALIB, CAMc, FGc, BodyShapeParameters.txt, InitialPose.txt and PoseParameters.txt.
        folder: the folder for `session.toml`; created if needed.
        options: the user's options; the format fixes the unit and the up axis: millimetres and z.

    Returns:
        The saved session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something in the source is missing or wrong; one sentence for each fault.
        InputError: `source` is not a folder, an option is wrong, or `folder` cannot be written.
    """
    options = options or Options()
    source_folder(source, "a bodytrack recording (CALIB, CAM1, FG1, InitialPose.txt ...)")
    check_height(options.height_m)
    check_fps(options.fps)
    faults, recorded, known = Faults(), None, None
    with faults.collect():
        recorded = read_views(source)
    with faults.collect():
        known = read_subject(source)
    if recorded is None or known is None:
        faults.raise_any()
        raise AssertionError("a reader neither returned nor raised")
    timing = align({view.camera.name: (recorded.first_frame, recorded.frames) for view in recorded.views}, options.offsets)
    whole = Session(
        folder=folder.resolve(),
        title=f"bodytrack recording {source.resolve().name}",
        up="z",
        fps=options.fps or FPS,
        frames=timing.frames,
        first_frame=timing.first_frame,
        views=tuple(replace(view, offset=timing.offsets[view.camera.name]) for view in recorded.views),
        subject=known.subject,
        initial=known.initial,
        positions=frozenset(POSITIONS),
    )
    session = excerpt(whole, options.first_frame, options.frames)
    session, keypoint_remarks = with_imported_keypoints(with_options(session, options), options)
    remarks = [*recorded.remarks, *known.remarks, *timing.remarks, *_left_out(whole, session)]
    remarks += [*([] if options.fps else [_fps_remark()]), *keypoint_remarks]
    return saved(session), [remark for remark in remarks if not (options.masks and remark == REMARK_NO_MASKS)]


def _left_out(whole: Session, session: Session) -> list[str]:
    if not whole.initial or session.first_frame == whole.first_frame:
        return []
    return [f"The recording's first pose belongs to frame {whole.first_frame} and is left out: the session begins at frame {session.first_frame}."]


def _fps_remark() -> str:
    return f"The recording does not state its frame rate: {FPS:g} frames per second are assumed; correct fps in session.toml if this is wrong."
