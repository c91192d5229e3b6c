"""report.html of a study: how good, how sure, where it fails, what it cost."""

from torchvision_dddas.sinks.study_report.page import report

__all__ = ["report"]
