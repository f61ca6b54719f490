"""The report of a run: one self-contained HTML file, for people who want to inspect a posterior without writing code."""

from bayes_body.view.report.page import write_report
from bayes_body.view.report.people import write_people_report

__all__ = ["write_people_report", "write_report"]
