"""The run for a person: one self-contained HTML page, made from the run's own files."""

from pipeline.report.page import write_report

__all__ = ["write_report"]
