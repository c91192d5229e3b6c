"""Tuning of parameters by gradient: labelled examples, losses on them, the descent, and a test of its effect."""

from torchvision_dddas.lab.tuning.descent import DescentStep, Plan, descend
from torchvision_dddas.lab.tuning.family import Family, prepare
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.lab.tuning.tuner import FILES, REPORT, RUN, TUNED, Display, Tuned, Tuner
from torchvision_dddas.lab.tuning.verdict import judge

__all__ = [
    "FILES",
    "REPORT",
    "RUN",
    "TUNABLE",
    "TUNED",
    "DescentStep",
    "Display",
    "Family",
    "Parameters",
    "Plan",
    "Tuned",
    "Tuner",
    "descend",
    "judge",
    "prepare",
]
