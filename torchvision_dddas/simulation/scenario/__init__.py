"""Scenarios: what a simulated world holds and what happens in it, as files that are read, changed, checked, written."""

from torchvision_dddas.simulation.scenario.checks import check, settings_of
from torchvision_dddas.simulation.scenario.knobs import (
    AircraftKnobs,
    CameraKnobs,
    CarPlan,
    ClipKnobs,
    CrowdPlan,
    Fault,
    GpsKnobs,
    Happening,
    Place,
    Scenario,
    TeamKnobs,
    WorldKnobs,
)
from torchvision_dddas.simulation.scenario.reading import load, names
from torchvision_dddas.simulation.scenario.writing import as_toml

__all__ = [
    "AircraftKnobs",
    "CameraKnobs",
    "CarPlan",
    "ClipKnobs",
    "CrowdPlan",
    "Fault",
    "GpsKnobs",
    "Happening",
    "Place",
    "Scenario",
    "TeamKnobs",
    "WorldKnobs",
    "as_toml",
    "check",
    "load",
    "names",
    "settings_of",
]
