"""Measure the package's speed on this machine: detection chains and operations, beside a plain OpenCV chain."""

from torchvision_dddas.lab.benchmark.chains import CHAINS, STAGES, ChainFigures, draw_frame, measure_chains
from torchvision_dddas.lab.benchmark.machine import describe_machine, format_table, machine_words
from torchvision_dddas.lab.benchmark.report import format_chains, format_operations

__all__ = [
    "CHAINS",
    "STAGES",
    "ChainFigures",
    "describe_machine",
    "draw_frame",
    "format_chains",
    "format_operations",
    "format_table",
    "machine_words",
    "measure_chains",
]
