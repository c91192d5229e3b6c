"""Scenarios that are made in a moment (a small world, a small picture), bodies and moments."""

from typing import Any

import numpy as np

from torchvision_dddas.lab.simulation import Scenario, scenario_toml
from torchvision_dddas.lab.simulation.agents import Moment
from torchvision_dddas.types import Bodies, CameraPose

WORLD = {"side_m": 60.0, "texel_m": 0.25, "buildings": 0, "bushes_per_ha": 10.0, "trees_per_ha": 0.0}


def small(**tables):
    """A scenario of two seconds: one crowd, four vehicles; tables replace or add to its own."""
    content: dict[str, Any] = {
        "seed": 3,
        "clip": {"seconds": 2.0},
        "world": WORLD,
        "uav": {"altitude_m": 30.0},
        "camera": {"width_px": 160, "height_px": 120},
        "team": {"ring_m": 8.0, "width_px": 160, "height_px": 120},
        "crowd": ({"people": 4, "start_m": (-3.0, 0.0), "speed_m_s": 1.0},),
    }
    for name, table in tables.items():
        content[name] = {**content.get(name, {}), **table} if isinstance(table, dict) else table
    return Scenario.model_validate(content)


def as_file(path, scenario):
    """The same as a file, whose path is returned."""
    path.write_text(scenario_toml(scenario))
    return path


def bodies_at(place_m=(), kind="person", **columns):
    """Bodies of one or several kinds that stand at (N, 3), each a target of its own; columns replace what they have."""
    n = len(place_m)
    kinds = np.array([kind] * n if isinstance(kind, str) else kind, dtype="U6")
    defaults = {
        "number": np.arange(1, n + 1),
        "kind": kinds,
        "target": np.arange(1, n + 1),
        "place_m": np.asarray(place_m, float).reshape(-1, 3),
        "velocity_m_s": np.zeros((n, 2)),
        "facing_rad": np.full(n, 0.4),
        "height_m": np.full(n, 1.75),
        "phase": np.zeros(n),
        "colour": np.full((n, 3), 200.0),
        "plate": np.where((kinds == "ugv")[:, None], (0.0, 0.0, 255.0), np.nan),
        "hidden": np.zeros(n, bool),
    }
    return Bodies(**{**defaults, **columns})


def moment_of(bodies, pose=None, number=1, velocity=(0, 0, 0), turn=(0, 0, 0), **columns):
    """A moment with one ground vehicle that reports to be at the scenarios' origin."""
    pose = CameraPose(np.array([0, 0, 50.0]), np.eye(3)) if pose is None else pose
    reported = {"reported_lonlat_deg": np.array([[-110.95, 31.6]]), "reported_heading_rad": np.full(1, 0.02)}
    rates = np.array(velocity, float), np.array(turn, float)
    return Moment(number, number / 10, bodies, pose, *rates, None, (), np.zeros(1), **{**reported, **columns})
