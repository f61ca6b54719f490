"""XML of programs that calibrate cameras."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import read_text
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.session.schema import MOST_CAMERAS


def read_root(path: Path, kind: str) -> ElementTree.Element:
    """Return the outermost element of a file.

    Args:
        path: the file.
        kind: what it should be, in error messages.

    Raises:
        InputError: no file, or not XML.
    """
    text = read_text(path, kind)
    # Nested entities can grow without bound, and no calibration has any.
    if "<!doctype" in text.lower() or "<!entity" in text.lower():
        raise input_error(path, "a document type or entities", f"{kind}, which has none", "name the file that the calibration program wrote")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise input_error(path, f"not XML ({error})", kind, "restore the file") from None


class Format(NamedTuple):
    """How a program writes its cameras.

    Attributes:
        kind: what a file of it is, in error messages.
        tag: of the element of a camera.
        name: the attribute with a camera's name.
        model_of: `(element)` -> the model of a camera, as a user knows it.
        films: `(model)` -> whether such a camera films; others record only markers.
        camera_of: `(entry, name, element)` -> the camera; `entry` names it in error messages.
    """

    kind: str
    tag: str
    name: str
    model_of: Callable[[ElementTree.Element], str]
    films: Callable[[str], bool]
    camera_of: Callable[[str, str, ElementTree.Element], Calibrated]

    def read(self, path: Path, note: Callable[[str], None]) -> list[Calibrated]:
        """Return the cameras of a file that film, in its order.

        Args:
            path: the file.
            note: receives a sentence about the cameras that record only markers, and are left out.

        Raises:
            InputError: no file, not XML, or no video camera in it.
            FaultyFileError: one sentence for each fault.
        """
        listed = [(element, self.model_of(element)) for element in read_root(path, self.kind).iter(self.tag)]
        filming = [element for element, model in listed if self.films(model)]
        if not filming:
            models = ", ".join(sorted({model for _, model in listed})) or "none"
            raise input_error(path, f"no video camera in it, but {models}", self.kind, "name the file that the calibration program wrote")
        if len(filming) > MOST_CAMERAS:
            raise input_error(path, f"{len(filming)} cameras", f"{self.kind} of at most {MOST_CAMERAS}", "restore the file")
        if left_out := [f"{element.get(self.name, '?')} ({model})" for element, model in listed if not self.films(model)]:
            note(f"{path.name}: {', '.join(left_out[:MOST_CAMERAS])}: cameras for markers, left out.")
        faults, cameras = Faults(), []
        for number, element in enumerate(filming, 1):
            name = element.get(self.name, "")
            with faults.collect():
                cameras.append(self.camera_of(f"{path}: camera '{name}'" if name else f"{path}: camera #{number}", name, element))
        faults.raise_any()
        return cameras
