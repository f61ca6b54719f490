"""Sentences on a rig whose keypoints contradict its calibration (judge.py)."""

from collections.abc import Mapping, Sequence

import numpy as np

from bayes_body.base.errors import InputError, input_error
from bayes_body.recording.readers.agreement.changes import CHANGES, SIZES
from bayes_body.recording.readers.agreement.judge import Cause, Verdict
from bayes_body.recording.readers.agreement.option import AS_GIVEN, option
from bayes_body.recording.session.session import CameraSpec

# So many changes are listed, where several make the rays of two cameras meet.
MOST_LISTED = 3
# The principal point of pictures of the right size is nearer to their middle than this share of the diagonal.
CENTRAL = 0.2


def contradiction(subject: object, cameras: Sequence[CameraSpec], verdict: Verdict) -> InputError:
    """Return the error for a rig on which no majority of the cameras agrees.

    Args:
        subject: the calibration, as the message calls it.
        cameras: those that have keypoints.
        verdict: of `judge.judge`.
    """
    seeing = int((verdict.agreement.seeing > 0).sum())
    members = len(verdict.agreement.members)
    agreeing = f"{members} of {seeing} cameras agree" if members else f"no two of {seeing} cameras agree"
    problem = f"the keypoints contradict it: {agreeing} on where a person is"
    if verdict.remedies:
        problem += f"; the rays of the keypoints meet if {describe_remedies(cameras, verdict)}"
        remedy = f"import again with that option, or with --rig {AS_GIVEN} to use the calibration as it is"
    else:
        remedy = (
            "check that calibration, videos and keypoints are of the same cameras and the same time (--offset), and that X_camera = R X_world + T; "
            f"--rig {AS_GIVEN} imports them nevertheless"
        )
    return input_error(subject, problem, "both cameras to agree" if seeing == 2 else "more than half of the cameras to agree", remedy)


def describe_remedies(cameras: Sequence[CameraSpec], verdict: Verdict) -> str:
    """Return the changes by which the rays meet, with the option that makes each: the end of a sentence."""
    return ", or if ".join(_describe(cameras, remedy) for remedy in verdict.remedies[:MOST_LISTED])


def _describe(cameras: Sequence[CameraSpec], remedy: Mapping[str, str]) -> str:
    meanings = [f"{f'for {camera}: ' if camera else ''}{CHANGES[change].meaning}" for camera, change in remedy.items()]
    sizes = {change for change in remedy.values() if change in SIZES}
    if sizes and all(_is_central(camera) for camera in cameras):
        # The calibration is that of these pictures, so it is the keypoints that are of others.
        size = "half" if "half_size" in sizes else "twice"
        return f"the keypoints belong to pictures of {size} the size (find them in the pictures that are imported)"
    return f"{', and '.join(meanings)} ({option(remedy)})"


def _is_central(camera: CameraSpec) -> bool:
    return bool(np.hypot(*(np.array(camera.centre_px) - np.array(camera.size_px) / 2)) < CENTRAL * np.hypot(*camera.size_px))


def rough_agreement(cameras: Sequence[CameraSpec], verdict: Verdict) -> list[str]:
    """Return a sentence on cameras that agree roughly and would agree far better with a change; none if they agree well."""
    if not verdict.remedies:
        return []
    agreement = f"The cameras agree only roughly on where the person is ({100 * verdict.agreement.error:.0f} % of the person's size)"
    return [f"{agreement}; they agree far better if {describe_remedies(cameras, verdict)}: look at the pictures, and import again with that option."]


def describe_dissent(camera: str, frames: int, total: int, agreeing: int, cause: Cause | None) -> str:
    """Return a sentence on a camera that contradicts the others.

    Args:
        camera: its name.
        frames: in which the people that it sees agree with no other camera.
        total: the number of all frames.
        agreeing: how many cameras agree.
        cause: what would explain it; None if nothing does.
    """
    reference = f"the other {agreeing}" if agreeing > 1 else "the other camera"
    problem = f"camera '{camera}': its keypoints contradict {reference} in {frames} of {total} frames"
    if cause is None:
        return f"{problem}: these are other people, or its calibration or its clock is off."
    if cause.change is None:
        return f"{problem}; they fit if {cause.words}: find its keypoints again, in its own pictures."
    return f"{problem}; they fit if {cause.words}: if that is so, import again with --rig {camera}={cause.change}."
