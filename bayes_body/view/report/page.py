"""The whole page: its sections in order, and pictures in the best quality that the size limit allows."""

from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import check_free, has_mark, make_folder, write_text
from bayes_body.base.progress import Watch, unwatched
from bayes_body.view.report.bands import band_section
from bayes_body.view.report.chains import chain_section
from bayes_body.view.report.clinical import clinical_section
from bayes_body.view.report.figures import style
from bayes_body.view.report.filtering import filter_section
from bayes_body.view.report.gait import gait_section, has_gait
from bayes_body.view.report.head import findings, key_figures, provenance_section, scales, subtitle, verdict
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.joint import TITLE, joint_section
from bayes_body.view.report.markup import Markup, joined, tag
from bayes_body.view.report.message_passing import message_section
from bayes_body.view.report.pairs import pair_section
from bayes_body.view.report.pictures import QUALITIES, picture_section
from bayes_body.view.report.prediction import prediction_section
from bayes_body.view.report.runs import run_section
from bayes_body.view.report.truth import truth_section
from bayes_body.view.report.unknowns import TITLE as UNKNOWNS_TITLE
from bayes_body.view.report.unknowns import unknown_section

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

FILE_NAME = "report.html"
# Bytes; small enough to be mailed and to be opened on a phone.
LARGEST = 10_000_000
# What tells a report from other files (`has_mark`).
MARK = b'<meta name="generator" content="bayes-body report">'
SECTIONS: Sequence[tuple[str, str, Callable[[Inspection], Markup]]] = (
    ("warnings", "Warnings", lambda inspection: findings(inspection.warnings)),
    ("pictures", "Pictures", lambda inspection: picture_section(inspection.run.folder, QUALITIES[0], inspection.run.frames)),
    ("truth", "Comparison with the truth", truth_section),
    ("prediction", "Posterior predictive check", prediction_section),
    ("clinical", "Clinical angles", clinical_section),
    ("gait", "Gait", gait_section),
    ("angles", "Angles and positions", band_section),
    ("pairs", "Dependence of the angles", pair_section),
    ("unknowns", UNKNOWNS_TITLE, unknown_section),
    ("filter", "Filter", filter_section),
    ("joint", TITLE, joint_section),
    ("chains", "Markov chains", chain_section),
    ("messages", "Message passing", message_section),
    ("runs", "Agreement of the runs", run_section),
    ("made", "How it was made", lambda inspection: provenance_section(inspection.run)),
)
PICTURES = 1


def write_report(run: "SavedRun", out: Path | None = None, watch: Watch = unwatched, overwrite: bool = False) -> Path:
    """Write the report of a run: one file that opens without a network. Return its path.

    Args:
        run: the run, loaded from its folder.
        out: the file; `report.html` in the run's folder by default.
        watch: wraps the indices of the page's sections to show progress.
        overwrite: whether to replace a file that is not a report. An older report is always replaced.

    Raises:
        InputError: the file exists and is not a report, it cannot be written, or the body has too many dofs for a page of LARGEST bytes.
    """
    path = out or run.folder / FILE_NAME
    check_free(path, overwrite or has_mark(path, MARK))
    make_folder(path.parent)
    write_text(path, page(run, watch))
    return path


def page(run: "SavedRun", watch: Watch = unwatched) -> str:
    """Return the page's HTML, in less than LARGEST bytes; for arguments and errors see `write_report`."""
    inspection = Inspection(run, watch=watch)
    with style():
        made = sections_of(inspection)
        # Before the sections, because it has a bar of its own, and two bars cannot be shown at once.
        _ = inspection.prediction
        sections = [made[part][2](inspection) for part in watch(range(len(made)))]
    return fitted(inspection, sections, LARGEST)


def sections_of(inspection: Inspection) -> Sequence[tuple[str, str, Callable[[Inspection], Markup]]]:
    """Return SECTIONS, without those about which the run says nothing, such as the truth, gait, or Markov chains."""
    missing = {
        "truth": not inspection.has_truth,
        "clinical": not inspection.clinical.names,
        "gait": not has_gait(inspection),
        "unknowns": not inspection.run.summary.get("unknowns"),
        "filter": inspection.run.smoothed,
        "joint": inspection.diagnosis.joint is None,
        "chains": inspection.diagnosis.mixing is None,
        "messages": inspection.diagnosis.messages is None,
    }
    return [entry for entry in SECTIONS if not missing.get(entry[0], False)]


def fitted(inspection: Inspection, sections: Sequence[Markup], largest: int) -> str:
    """Return the page of these sections, with pictures in the best quality for which it has less than `largest` bytes.

    Raises:
        InputError: the page is too large even without pictures.
    """
    text = _filled(inspection, sections)
    for quality in (*QUALITIES[1:], None):
        if len(text.encode()) < largest:
            return text
        pictures = picture_section(inspection.run.folder, quality, inspection.run.frames)
        text = _filled(inspection, [*sections[:PICTURES], pictures, *sections[PICTURES + 1 :]])
    if len(text.encode()) < largest:
        return text
    problem, remedy = f"{len(text.encode()) / 1e6:.1f} MB without pictures", "this run has too many dofs for a report: read posterior.nc instead"
    raise input_error("the report", problem, f"less than {largest / 1e6:g} MB", remedy)


def _filled(inspection: Inspection, sections: Sequence[Markup]) -> str:
    template = Template(files(__package__).joinpath("page.html").read_text(encoding="utf-8"))
    version = inspection.run.versions.get("bayes-body", "of unknown version")
    values = {
        "title": f"Posterior of {inspection.run.folder.resolve().name}",
        "subtitle": subtitle(inspection.run),
        "verdict": verdict(inspection.run.summary, inspection.warnings, inspection.agreement_known),
        "scales": scales(inspection),
        "contents": joined(tag("li", tag("a", title, href=f"#{name}")) for name, title, _ in sections_of(inspection)),
        "figures": key_figures(inspection.run.summary, inspection.diagnosis, inspection.run.smoothed),
        "sections": joined(sections),
        "footer": f"Made by bayes-body report from a run of bayes-body {version}. This file is complete in itself and needs no network.",
    }
    return template.substitute({name: joined([value]) for name, value in values.items()})
