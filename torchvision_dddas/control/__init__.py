"""The feedback rules, the confirmation of targets from the ground, and the closed loop that steers the vehicles."""

from torchvision_dddas.control.closed_loop import (
    Instrument,
    Mission,
    StartedSource,
    Steering,
    build_mission,
    fit_settings,
)
from torchvision_dddas.control.confirmation import Vehicle, confirm_pictures, confirm_positions
from torchvision_dddas.control.ground_team import UAV, FurtherUav, GroundTeam, Picture, PlatformLook, check_size
from torchvision_dddas.control.rules import SAMPLING, SHED, Load, rungs, shed
from torchvision_dddas.control.sensor_monitor import SensorMonitor

__all__ = [
    "SAMPLING",
    "SHED",
    "UAV",
    "FurtherUav",
    "GroundTeam",
    "Instrument",
    "Load",
    "Mission",
    "Picture",
    "PlatformLook",
    "SensorMonitor",
    "StartedSource",
    "Steering",
    "Vehicle",
    "build_mission",
    "check_size",
    "confirm_pictures",
    "confirm_positions",
    "fit_settings",
    "rungs",
    "shed",
]
