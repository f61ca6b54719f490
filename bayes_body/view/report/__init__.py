"""The report of a run: one HTML file with everything in it, for people who want to look into a posterior without writing code."""

from bayes_body.view.report.page import write_report

__all__ = ["write_report"]
