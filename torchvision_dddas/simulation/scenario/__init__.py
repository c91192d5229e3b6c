"""Scenarios: what a simulated world holds and what happens in it, as files that are read, changed, checked, written."""

from torchvision_dddas.simulation.scenario.checks import check, settings_of
from torchvision_dddas.simulation.scenario.parameters import (
    AircraftParameters,
    CameraParameters,
    CarPlan,
    ClipParameters,
    CrowdPlan,
    Fault,
    GpsParameters,
    Happening,
    Place,
    Scenario,
    TeamParameters,
    WorldParameters,
)
from torchvision_dddas.simulation.scenario.reading import load, names
from torchvision_dddas.simulation.scenario.writing import as_toml

__all__ = [
    "AircraftParameters",
    "CameraParameters",
    "CarPlan",
    "ClipParameters",
    "CrowdPlan",
    "Fault",
    "GpsParameters",
    "Happening",
    "Place",
    "Scenario",
    "TeamParameters",
    "WorldParameters",
    "as_toml",
    "check",
    "load",
    "names",
    "settings_of",
]
