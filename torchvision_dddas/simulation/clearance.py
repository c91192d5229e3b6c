"""Whether a UAV can fly its way through a world, and see what it means to see."""

from itertools import pairwise

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.scenario import AircraftParameters
from torchvision_dddas.simulation.world import World

CLEAR_M = 1.0
"""Nothing that stands below it comes nearer: gusts push it about by less."""

_STEP_M = 1.0
_PARTS = 64


def check_way(parameters: AircraftParameters, world: World) -> None:
    """Raises InputError where what stands there reaches up to its way, or the ground hides what it looks at."""
    aimed = _places(parameters)
    aimed_up = world.up_m(aimed)
    heading, pitch = np.radians(parameters.heading_deg), np.radians(parameters.pitch_deg)
    back = parameters.altitude_m / np.tan(pitch) if parameters.pitch_deg < 90 else 0.0
    flown = aimed - back * np.array([np.sin(heading), np.cos(heading)])
    tall = heights_m(world, flown)
    if (low := tall + CLEAR_M > parameters.altitude_m).any():
        k = int(np.where(low, tall, -1).argmax())
        raise InputError(
            f"uav.altitude_m = {parameters.altitude_m:g} is too low: {tall[k]:.1f} m stand at {_at(flown[k])}; "
            f"fly {np.ceil(tall[k] + CLEAR_M):g} m high or more"
        )
    flown_up = parameters.altitude_m + world.up_m(flown)
    share = np.linspace(0, 1, _PARTS, endpoint=False)[:, None]
    rays = flown + share[..., None] * (aimed - flown)
    ground = world.up_m(rays.reshape(-1, 2)).reshape(rays.shape[:2])
    over = flown_up + share * (aimed_up - flown_up) - ground
    if (over < 0).any():
        part, aim = divmod(int(over.argmin()), over.shape[1])
        raise InputError(
            f"uav.altitude_m = {parameters.altitude_m:g} is below the terrain that it looks over: at "
            f"{_at(rays[part, aim])} the ground is {-over[part, aim]:.1f} m above its line of sight; fly "
            f"higher, or look down more steeply than uav.pitch_deg = {parameters.pitch_deg:g}"
        )


def heights_m(world: World, east_north_m: np.ndarray) -> np.ndarray:
    """(N,) of what stands at places (N, 2), above the ground; beyond its edges the world is mirrored."""
    side = world.surface.shape[0]
    column = (east_north_m[:, 0] + world.side_m / 2) / world.surface_texel_m
    row = (world.side_m / 2 - east_north_m[:, 1]) / world.surface_texel_m
    places = np.floor(np.stack([row, column])).astype(int) % (2 * side)
    places = np.where(places < side, places, 2 * side - 1 - places)
    return world.surface[places[0], places[1]].astype(float)


def _places(parameters: AircraftParameters) -> np.ndarray:
    """(N, 2) the ground that it looks at, a metre from one to the next."""
    corners = np.array([parameters.start_m, *parameters.way_m], float)
    legs = [corners[:1]]
    for begin, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / _STEP_M)))
        legs.append(begin + np.arange(1, count + 1)[:, None] / count * (end - begin))
    return np.concatenate(legs)


def _at(place: np.ndarray) -> str:
    return f"[{place[0]:.0f}, {place[1]:.0f}]"
