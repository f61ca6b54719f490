"""Assemble a session; where pictures were turned by 90° against the calibration, ask the keypoints in which direction."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.agreement.sizes import OtherSizesError
from bayes_body.recording.readers.assemble import Rig, assemble
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.readers.keypoints.imported import with_imported_keypoints
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.options import Options
from bayes_body.recording.session.session import Session

# Frames in which the turns are compared.
FRAMES = 20
# As many times as many keypoints must agree with one turn as with the other.
CLEAR = 2


def assemble_upright(rig: Rig, folder: Path, title: str, options: Options, usual: Path | None = None) -> tuple[Session, list[str]]:
    """Build the session of a rig's recordings (`assemble`), and name the turn by which the keypoints agree if one is missing.

    Args:
        rig: the cameras and the folder with their recordings.
        folder: the session's folder.
        title: one line for the reader.
        options: the user's options.
        usual: the folder with keypoints, if the options name none.

    Returns:
        The session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something is missing or wrong; one sentence for each fault.
        OtherSizesError: the pictures have another size than those of the calibration, and a change of the calibration would explain it.
    """
    try:
        return assemble(rig, folder, title, options)
    except OtherSizesError as error:
        if len(error.proposals) < 2:
            raise
        counts = [_agreeing_keypoints(rig, replace(options, rig={**options.rig, **changes}), list(error.sizes), usual) for changes in error.proposals]
        best = int(np.argmax(counts))
        if counts[best] <= CLEAR * sorted(counts)[-2]:
            raise
        raise error.with_best(error.proposals[best]) from None


def _agreeing_keypoints(rig: Rig, options: Options, names: list[str], usual: Path | None) -> int:
    """Return how many keypoints of some cameras agree with the other cameras in the first frames."""
    with TemporaryDirectory() as folder:
        try:
            session, _ = assemble(rig, Path(folder), "", options)
            session = excerpt(session, None, min(FRAMES, session.frames))
            session, _ = with_imported_keypoints(session, replace(options, measures_lengths=False), usual)
        except InputError:
            return 0
        paths = [session.keypoints_path(view) for view in session.views if view.camera.name in names]
        return sum(int(np.isfinite(read_series(path).keypoints[..., 0]).sum()) for path in paths if path is not None)
