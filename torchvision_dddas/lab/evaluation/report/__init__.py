"""report.html of a study: measures, charts, the worst frames, costs."""

from torchvision_dddas.lab.evaluation.report.study import study_report, study_tables

__all__ = ["study_report", "study_tables"]
