"""Simulate a UAV, ground vehicles and crowds in a desert with known truth: scenarios, simulator, recordings."""

from torchvision_dddas.lab.simulation.recording import RECORDED, film, film_clip, record_scenario
from torchvision_dddas.lab.simulation.scenario import (
    CarPlan,
    CrowdPlan,
    Scenario,
    load_scenario,
    scenario_names,
    scenario_parameters,
    scenario_settings,
    scenario_toml,
)
from torchvision_dddas.lab.simulation.serving import ServeOptions
from torchvision_dddas.lab.simulation.simulator import (
    SimulatorSource,
    name_scenario_in_errors,
    open_scenario,
    open_simulator,
)
from torchvision_dddas.lab.simulation.truth import SimulatedRunRecorder

__all__ = [
    "RECORDED",
    "CarPlan",
    "CrowdPlan",
    "Scenario",
    "ServeOptions",
    "SimulatedRunRecorder",
    "SimulatorSource",
    "film",
    "film_clip",
    "load_scenario",
    "name_scenario_in_errors",
    "open_scenario",
    "open_simulator",
    "record_scenario",
    "scenario_names",
    "scenario_parameters",
    "scenario_settings",
    "scenario_toml",
]
