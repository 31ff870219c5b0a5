"""report.html: one file that says of a run what a person wants to know of it."""

from lusee_bayes.report.comparison_report import comparison_report
from lusee_bayes.report.report import REPORT, write_report

__all__ = ["REPORT", "comparison_report", "write_report"]
