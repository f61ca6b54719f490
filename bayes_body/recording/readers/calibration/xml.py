"""XML of programs that calibrate cameras."""

from pathlib import Path
from xml.etree import ElementTree

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import read_text


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
