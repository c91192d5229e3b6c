"""Tuning of parameters by gradient: examples of what is true, losses on them, descent, and what it was worth."""

from torchvision_dddas.lab.tuning.colours import fit_colours
from torchvision_dddas.lab.tuning.descent import Descended, Plan, Step, descend
from torchvision_dddas.lab.tuning.family import Example, Family, Prepared, load_family, prepare
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.lab.tuning.tuner import FILES, REPORT, RUN, TUNED, Display, Tuned, Tuner
from torchvision_dddas.lab.tuning.verdict import Side, Verdict, judge

__all__ = [
    "FILES",
    "REPORT",
    "RUN",
    "TUNABLE",
    "TUNED",
    "Descended",
    "Display",
    "Example",
    "Family",
    "Parameters",
    "Plan",
    "Prepared",
    "Side",
    "Step",
    "Tuned",
    "Tuner",
    "Verdict",
    "descend",
    "fit_colours",
    "judge",
    "load_family",
    "prepare",
]
