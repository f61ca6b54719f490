"""All detectors on one frame. Detections are proposals for a sampler, never factors of a density: they may be wrong, and there may be none."""

from collections.abc import Callable, Mapping
from time import perf_counter
from typing import NamedTuple

from bayes_body.base.errors import input_error, nearest
from bayes_body.initial.detection.detections import LANDMARKS, PARTS, Detections, Found, Person, merge
from bayes_body.initial.detection.faces import detect_faces
from bayes_body.initial.detection.keypoints import detect_keypoints
from bayes_body.initial.detection.limbs import detect_limbs
from bayes_body.initial.detection.scene import Scene, read_scene
from bayes_body.initial.detection.silhouettes import detect_silhouettes
from bayes_body.initial.detection.standing import detect_standing
from bayes_body.recording.observation.frames import Frame, read_frame
from bayes_body.recording.session.session import Session

# Each detector and its share of the weight of a landmark or part that others detect too.
DETECTORS: Mapping[str, tuple[Callable[[Scene], Found], float]] = {
    "keypoints": (detect_keypoints, 4.0),
    "silhouettes": (detect_silhouettes, 2.0),
    "standing": (detect_standing, 2.0),
    "faces": (detect_faces, 2.0),
    "limbs": (detect_limbs, 1.0),
}
# Detectors whose person is trusted; the first one that found a person is used.
TRUSTED = ("keypoints", "silhouettes", "standing")


class Detected(NamedTuple):
    """What all detectors found in one frame.

    Attributes:
        landmarks: detections of the fifteen markers by name; a marker that was not detected is missing.
        parts: detections of the fifteen parts by name; likewise.
        person: where the person stands; None if no detector found it.
        notices: sentences for the reader, such as "no face was found in any view".
        seconds: the time that each detector took; "scene" is that of reading the pictures and silhouettes and of the visual hull.
    """

    landmarks: Mapping[str, Detections]
    parts: Mapping[str, Detections]
    person: Person | None
    notices: tuple[str, ...]
    seconds: Mapping[str, float]


def detect(session: Session, frame: Frame | int, detectors: tuple[str, ...] = tuple(DETECTORS)) -> Detected:
    """Detect the person in a frame of a session. It is not an error if nothing is found.

    Args:
        session: the recording.
        frame: the frame, or its index, counted from 0.
        detectors: names of the detectors to use.

    Raises:
        InputError: no such detector or frame, or a file of the session cannot be used.
    """
    for name in detectors:
        if name not in DETECTORS:
            raise input_error(f"detector '{name}'", "no such detector", f"some of {', '.join(DETECTORS)}", nearest(name, DETECTORS))
    start = perf_counter()
    scene = read_scene(session, read_frame(session, frame) if isinstance(frame, int) else frame)
    _ = scene.figure
    return _detected(scene, detectors, perf_counter() - start)


def _detected(scene: Scene, detectors: tuple[str, ...], seconds: float) -> Detected:
    findings, times = dict[str, Found](), {"scene": seconds}
    for name in detectors:
        start = perf_counter()
        findings[name] = DETECTORS[name][0](scene) if scene.cameras else Found({}, {})
        times[name] = perf_counter() - start
    shares = {name: DETECTORS[name][1] for name in findings}
    landmarks = {
        name: merge([(finding.landmarks[name], shares[d]) for d, finding in findings.items() if name in finding.landmarks]) for name in LANDMARKS
    }
    parts = {name: merge([(finding.parts[name], shares[d]) for d, finding in findings.items() if name in finding.parts]) for name in PARTS}
    people = [findings[name].person for name in TRUSTED if name in findings and findings[name].person is not None]
    notices = [notice for finding in findings.values() for notice in finding.notices]
    if not scene.cameras:
        notices = ["no camera saw this frame"]
    elif scene.masks is None:
        notices.append("the session has no silhouettes: only keypoints and faces are detected")
    return Detected(
        {name: detections for name, detections in landmarks.items() if detections is not None},
        {name: detections for name, detections in parts.items() if detections is not None},
        _facing(findings, scene, people[0] if people else None),
        tuple(notices),
        times,
    )


def _facing(findings: Mapping[str, Found], scene: Scene, person: Person | None) -> Person | None:
    """Return the person, with the facing of the strongest face if the facing is not known otherwise."""
    heads = findings["faces"].parts.get("head") if "faces" in findings else None
    if person is None or person.facing_known or heads is None:
        return person
    looks = heads.rotations[heads.weights.argmax(), :, 0] if heads.rotations is not None else None
    return person._replace(facing=looks, facing_known=looks is not None)
