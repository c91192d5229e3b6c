"""The feedback rules, and the closed loop that steers the vehicles."""

from torchvision_dddas.control.closed_loop import (
    Instrument,
    Mission,
    StartedSource,
    Steering,
    build_mission,
    fit_settings,
)
from torchvision_dddas.control.ground_confirmation import GroundConfirmation
from torchvision_dddas.control.sensor_monitor import Notice, SensorMonitor

__all__ = [
    "GroundConfirmation",
    "Instrument",
    "Mission",
    "Notice",
    "SensorMonitor",
    "StartedSource",
    "Steering",
    "build_mission",
    "fit_settings",
]
