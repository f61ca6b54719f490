"""What pictures for a paper have in common: their formats, their style, and the line that says what was made of which recording."""

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bayes_body.base.errors import escaped, input_error
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.view.report.figures import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bayes_body.results.storage.saved_run import SavedRun

FORMATS = (".png", ".svg", ".pdf")
# Points: letters of the small print. Mean width of a letter, as a fraction of its height.
SMALL, LETTER = 7.5, 0.53


@contextmanager
def paper_style() -> Iterator[None]:
    """Within it, plots have the report's style, and text in vector pictures stays text."""
    import matplotlib as mpl

    with style(), mpl.rc_context({"svg.fonttype": "none", "pdf.fonttype": 42, "savefig.transparent": False, "savefig.facecolor": "white"}):
        yield


def check_format(path: Path) -> None:
    """Check that a picture's file has a suffix that tells its format.

    Raises:
        InputError: it has another suffix.
    """
    if path.suffix.lower() not in FORMATS:
        raise input_error(path, f"the suffix '{path.suffix}'", ", ".join(FORMATS), "name a file with one of these suffixes by --out")


def save(figure: "Figure", path: Path, dpi: float) -> None:
    """Write a figure, completely or not at all; its suffix gives the format. The same run gives the same file.

    Raises:
        InputError: the suffix is another one, or the file cannot be written.
    """
    check_format(path)
    kind = path.suffix.lower().removeprefix(".")
    metadata = {"png": None, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    make_folder(path.parent)
    with replacing(path) as partial:
        figure.savefig(partial, format=kind, dpi=dpi, metadata=metadata)


def made_of(run: "SavedRun") -> str:
    """Return the recording, the model and the kernel, with the number of runs."""
    runs = run.tree["posterior"].sizes["chain"]
    smoothed = ", smoothed" if run.smoothed else ""
    return escaped(f"{run.session.title}. Model {run.settings['model']}, kernel {run.kernel['kind']}{smoothed}, {runs} run{'s' * (runs > 1)}")


def wrapped(text: str, width_in: float, size: float = SMALL) -> str:
    """Return the text in lines that fit into that width, inches, in letters of that height, points."""
    return "\n".join(textwrap.wrap(text, max(20, int(width_in * 72 / (LETTER * size)))))
