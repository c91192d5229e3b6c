"""A simulated team above and on a piece of desert, with known truth: scenarios, the simulator, its recordings."""

from torchvision_dddas.simulation.recording import RECORDED, film, film_clip, record_scenario
from torchvision_dddas.simulation.scenario import (
    AircraftParameters,
    CameraParameters,
    CarPlan,
    ClipParameters,
    CrowdPlan,
    Fault,
    GpsParameters,
    Happening,
    Scenario,
    TeamParameters,
    WorldParameters,
    check_scenario,
    load_scenario,
    scenario_names,
    scenario_settings,
    scenario_toml,
)
from torchvision_dddas.simulation.simulator import (
    Shot,
    Simulator,
    SimulatorSource,
    name_scenario_in_errors,
    open_scenario,
    open_simulator,
)
from torchvision_dddas.simulation.truth import SimulatedRunRecorder, TruthOutput
from torchvision_dddas.simulation.world import World, build_world

__all__ = [
    "RECORDED",
    "AircraftParameters",
    "CameraParameters",
    "CarPlan",
    "ClipParameters",
    "CrowdPlan",
    "Fault",
    "GpsParameters",
    "Happening",
    "Scenario",
    "Shot",
    "SimulatedRunRecorder",
    "Simulator",
    "SimulatorSource",
    "TeamParameters",
    "TruthOutput",
    "World",
    "WorldParameters",
    "build_world",
    "check_scenario",
    "film",
    "film_clip",
    "load_scenario",
    "name_scenario_in_errors",
    "open_scenario",
    "open_simulator",
    "record_scenario",
    "scenario_names",
    "scenario_settings",
    "scenario_toml",
]
