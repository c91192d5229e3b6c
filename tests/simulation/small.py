"""Scenarios that are made in a moment: a small world, a small picture."""

from typing import Any

from torchvision_dddas.simulation import Scenario

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
    from torchvision_dddas.simulation import scenario_toml

    path.write_text(scenario_toml(scenario))
    return path
