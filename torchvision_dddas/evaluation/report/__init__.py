"""report.html of a study: how good, how sure, where it fails, what it cost."""

from torchvision_dddas.evaluation.report.page import report

__all__ = ["report"]
