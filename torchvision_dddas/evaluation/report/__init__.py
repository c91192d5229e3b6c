"""The pages of studies: report.html of one, compare.html of two."""

from torchvision_dddas.evaluation.report.comparison import MEANING, comparison_report, comparison_section
from torchvision_dddas.evaluation.report.study import study_report

__all__ = ["MEANING", "comparison_report", "comparison_section", "study_report"]
