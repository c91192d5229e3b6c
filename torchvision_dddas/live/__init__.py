"""Live runs: capture in a thread of its own, load shedding, health, and a server for the health."""

from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.commanding import CommandOptions
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.recording import RECORDED
from torchvision_dddas.live.report_inputs import is_live_input
from torchvision_dddas.live.runner import LoadShedding
from torchvision_dddas.live.session import LiveOptions, run_live

__all__ = [
    "RECORDED",
    "CommandOptions",
    "Health",
    "LiveOptions",
    "LiveSource",
    "LoadShedding",
    "is_live_input",
    "run_live",
]
