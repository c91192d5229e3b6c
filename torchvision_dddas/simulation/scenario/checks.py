"""What of a scenario cannot be, whatever the world looks like: told in one line before anything is made."""

from pathlib import Path

from torchvision_dddas.config import Settings, is_file, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.scenario.parameters import Place, Scenario

FEWEST = 4
"""Landmarks that lay a picture on the ground."""


HIGHEST_DEG = 85.0
"""Near the poles longitudes run together."""


MARGIN_M = 2.0
"""What moves begins and goes so far inside the world."""


OF_VEHICLES = ("ugv_lost", "gps_dropout", "gps_jump", "landmark_hidden")
"""Faults of one ground vehicle."""


def check(scenario: Scenario) -> None:
    """Raises InputError with one line for what cannot be: something outside the world, happening to no crowd, ..."""
    _check_origin(scenario)
    _check_places(scenario)
    _check_times(scenario)
    if scenario.clip.located_by == "landmarks" and scenario.team.ugvs < FEWEST:
        raise InputError(
            f"team.ugvs = {scenario.team.ugvs} will not do: a clip located by landmarks needs {FEWEST}; add vehicles, "
            'or set clip.located_by = "telemetry"'
        )
    if scenario.camera.exposure_s * scenario.clip.rate_hz > 1:
        raise InputError(
            f"camera.exposure_s = {scenario.camera.exposure_s:g} is longer than from picture to picture; wanted "
            f"{1 / scenario.clip.rate_hz:g} s or less at clip.rate_hz = {scenario.clip.rate_hz:g}"
        )
    for key in ("elevation", "photo"):
        if (file := getattr(scenario.world, key)) and not is_file(Path(file)):
            raise InputError(f"world.{key}: there is no file {file}")
    with_parameters(Settings(), settings_of(scenario), "settings")


def settings_of(scenario: Scenario) -> dict[str, object]:
    """The parameters of the system that a scenario sets: `{"group.knob": value}`."""
    return {f"{group}.{key}": value for group, keys in scenario.settings.items() for key, value in keys.items()}


def _check_origin(scenario: Scenario) -> None:
    """The world lies where longitudes and latitudes tell places."""
    longitude, latitude = scenario.world.origin_deg
    if abs(longitude) > 180 or abs(latitude) > HIGHEST_DEG:
        raise InputError(
            f"world.origin_deg = [{longitude:g}, {latitude:g}] will not do; wanted a longitude of -180 to 180 and a "
            f"latitude of -{HIGHEST_DEG:g} to {HIGHEST_DEG:g} degrees"
        )


def _check_places(scenario: Scenario) -> None:
    """Everything that has a place is inside the world."""
    reach = scenario.world.side_m / 2 - MARGIN_M
    rooms: list[tuple[str, Place, float]] = []
    for k, crowd in enumerate(scenario.crowd, 1):
        rooms.append((f"crowd.{k}.start_m", crowd.start_m, crowd.radius_m))
        rooms += [(f"crowd.{k}.way_m", place, 0.0) for place in crowd.way_m]
    for k, car in enumerate(scenario.car, 1):
        rooms += [(f"car.{k}.start_m", car.start_m, 0.0), *((f"car.{k}.way_m", place, 0.0) for place in car.way_m)]
    if scenario.team.ugvs:
        rooms.append(("team.middle_m", scenario.team.middle_m, scenario.team.ring_m))
    rooms += [("uav.start_m", scenario.uav.start_m, 0.0), *(("uav.way_m", place, 0.0) for place in scenario.uav.way_m)]
    for name, (east, north), radius in rooms:
        if max(abs(east), abs(north)) + radius > reach:
            about = f" with {radius:g} m about it" if radius else ""
            raise InputError(
                f"{name} = [{east:g}, {north:g}]{about} is outside the world; wanted within {reach:g} m of its middle "
                "east and north, or a larger world.side_m"
            )


def _check_times(scenario: Scenario) -> None:
    """What happens, happens during the clip, to something that is there."""
    end, crowds = scenario.clip.seconds, len(scenario.crowd)
    for k, happening in enumerate(scenario.happening, 1):
        name = f"happening.{k}"
        for which in happening.crowds:
            if which > crowds:
                there = f"there {'is' if crowds == 1 else 'are'} {crowds or 'none'}"
                raise InputError(f"{name}.crowds names crowd {which}, of which {there}")
        if happening.what == "join" and len(set(happening.crowds)) < 2:
            raise InputError(f"{name}.crowds = {list(happening.crowds)} will not do; to join takes two or more")
        if len(set(happening.crowds)) < len(happening.crowds):
            raise InputError(f"{name}.crowds = {list(happening.crowds)} names a crowd twice")
        if happening.what == "split":
            for which in happening.crowds:
                if scenario.crowd[which - 1].people < 2:
                    raise InputError(f"{name}: crowd {which} is one person, and cannot split")
        _check_time(f"{name}.time_s", happening.time_s, end)
    for k, fault in enumerate(scenario.fault, 1):
        _check_time(f"fault.{k}.time_s", fault.time_s, end)
        if fault.what in OF_VEHICLES and fault.vehicle > scenario.team.ugvs:
            raise InputError(
                f"fault.{k}.vehicle = {fault.vehicle} is not there; team.ugvs = {scenario.team.ugvs} counts them"
            )


def _check_time(name: str, time_s: float, end_s: float) -> None:
    if time_s >= end_s:
        raise InputError(f"{name} = {time_s:g} is after the end; clip.seconds = {end_s:g}")
