"""Scenarios: the contents and events of a simulated world. Read them from TOML files, change, check and write them.

Metres are local: east and north of the world's origin, which is its middle. Speeds, behaviours and heights are those of
appendix A, section V: a border area near Tucson, 1300 m above the sea; crowds at U(1.11, 3.34) m per time unit along
east and along north; UGVs that are fast at first and slow near the crowd; a UAV 50 to 200 m above ground.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo

from torchvision_dddas.config import (
    Group,
    Parameter,
    Settings,
    config_folder,
    describe_error,
    describe_parameter,
    format_toml,
    is_file,
    nearest,
    parameter,
    parse_override,
    read_toml,
    with_parameters,
)
from torchvision_dddas.errors import InputError

_FEWEST = 4  # landmarks needed to georeference a picture
_HIGHEST_DEG = 85.0  # greatest latitude; longitudes converge near the poles
_MARGIN_M = 2.0  # least distance of moving objects from the edge of the world
_OF_VEHICLES = ("ugv_lost", "gps_dropout", "gps_jump", "landmark_hidden")  # faults of one ground vehicle
_FILES = ("elevation", "photo")  # world parameters that name files

Place = tuple[float, float]
_PLACES: dict[Any, str] = {Place: "two numbers", tuple[Place, ...]: "a list of pairs of numbers"}


class WorldParameters(Group):
    """The ground and the objects that stand on it."""

    origin_deg: Place = parameter((-110.95, 31.6), "longitude and latitude of the world's middle", "deg")
    side_m: float = parameter(400.0, "length of the square world's side", "m", 40, 4000)
    texel_m: float = parameter(0.1, "size of a pixel of the ground's texture", "m", 0.02, 2)
    above_sea_m: float = parameter(1300.0, "height of the middle above the sea", "m", -500, 9000)
    relief_m: float = parameter(3.0, "height from the lowest to the highest ground; 0: level", "m", 0, 1000)
    elevation: str = parameter("", "GeoTIFF of heights that replaces the synthetic relief")
    photo: str = parameter("", "GeoTIFF of an orthophoto that replaces the synthetic desert scrub")
    bushes_per_ha: float = parameter(40.0, "bushes per hectare", "1/ha", 0, 2000)
    trees_per_ha: float = parameter(3.0, "trees per hectare", "1/ha", 0, 500)
    buildings: int = parameter(2, "buildings in the world", "buildings", 0, 200)
    poles: int = parameter(0, "lamp posts and other poles in the world", "poles", 0, 500)
    shore_m: float = parameter(
        0.0, "distance of the water's edge south of the middle, in aerial pictures; 0: no water", "m", -2000, 2000
    )
    sun_azimuth_deg: float = parameter(140.0, "direction of the sun, clockwise from north", "deg", 0, 360)
    sun_height_deg: float = parameter(50.0, "elevation of the sun", "deg", 5, 90)


class CrowdPlan(Group):
    """A crowd: people who move together."""

    people: int = parameter(10, "number of people in it", "people", 1, 5000)
    start_m: Place = parameter((0.0, 0.0), "their initial centre", "m")
    radius_m: float = parameter(2.0, "their largest distance from the centre", "m", 0, 200)
    behaviour: Literal["walk", "random", "stand"] = parameter(
        "walk", "walk: along way_m or heading_deg; random: a new velocity each time unit; stand: stay"
    )
    speed_m_s: float = parameter(1.4, "their walking speed", "m/s", 0, 10)
    heading_deg: float = parameter(90.0, "direction if way_m is empty, clockwise from north", "deg", -360, 360)
    way_m: tuple[Place, ...] = parameter((), "waypoints, walked there and back", "m")
    from_s: float = parameter(0.0, "start time; until then they stand", "s", 0, 86400)


class CarPlan(Group):
    """A car. Cars are not landmarks."""

    start_m: Place = parameter((0.0, 0.0), "its initial position", "m")
    heading_deg: float = parameter(90.0, "direction if way_m is empty, clockwise from north", "deg", -360, 360)
    speed_m_s: float = parameter(6.0, "its driving speed", "m/s", 0, 40)
    way_m: tuple[Place, ...] = parameter((), "waypoints, driven there and back", "m")
    from_s: float = parameter(0.0, "its start time", "s", 0, 86400)


class Happening(Group):
    """An event of crowds. Crowds are numbered from 1, in the order of the file."""

    time_s: float = parameter(10.0, "time of the event", "s", 0, 86400)
    what: Literal["join", "split", "scatter"] = parameter(
        "join",
        "join: two or more crowds meet and continue as the first; split: a crowd becomes two, whose directions differ "
        "by turn_deg; scatter: the people of a crowd run off one by one",
    )
    crowds: Annotated[tuple[Annotated[int, Field(ge=1, le=10_000)], ...], Field(min_length=1)] = parameter(
        (1,), "numbers of the crowds"
    )
    turn_deg: float = parameter(60.0, "angle between the directions of the two parts of a split", "deg", 0, 180)


class TeamParameters(Group):
    """The ground vehicles: landmarks for the aerial camera, with cameras of their own."""

    ugvs: int = parameter(4, "number of vehicles; each has its own colour", "vehicles", 0, 12)
    ring_m: float = parameter(14.0, "radius of the ring about middle_m on which they start", "m", 0, 1000)
    middle_m: Place = parameter((0.0, 0.0), "middle of the ring", "m")
    patrol_m_s: float = parameter(1.0, "speed along their planned ways while they are not steered", "m/s", 0, 10)
    patrol: Literal["stand", "random", "gather", "along"] = parameter(
        "random",
        "stand: stay; random: go from place to place within the ring; gather: go to the middle, fast and then slow, as "
        "in the source; along: follow the UAV's way",
    )
    planned: bool = parameter(True, "whether they share planned waypoints, which bridge GPS dropouts")
    hfov_deg: float = parameter(56.0, "horizontal field of view of their cameras", "deg", 10, 120)
    width_px: int = parameter(640, "width of their pictures", "px", 64, 3840)
    height_px: int = parameter(480, "height of their pictures", "px", 64, 2160)
    camera_m: float = parameter(1.3, "height of their cameras above ground", "m", 0.1, 20)


class GpsParameters(Group):
    """The receivers of the ground vehicles."""

    error95_m: float = parameter(0.0, "95 % of the reported places have at most this error; 0: exact", "m", 0, 1000)
    white_share: float = parameter(0.1, "share of the variance that is new in each report", "-", 0, 1)
    correlation_s: float = parameter(60.0, "time constant of the rest of the error", "s", 0.1, 1e5)
    common_m: float = parameter(0.0, "standard deviation, per axis, of the error shared by all receivers", "m", 0, 1000)
    rate_hz: float = parameter(10.0, "reports per second", "1/s", 0.01, 100)


class AircraftParameters(Group):
    """The UAV, its reports, and its flight while it is not steered."""

    altitude_m: float = parameter(50.0, "height above the ground below it", "m", 2, 2000)
    pitch_deg: float = parameter(90.0, "angle of the camera below the horizon; 90: straight down", "deg", 10, 90)
    heading_deg: float = parameter(0.0, "initial heading of the picture's upper edge", "deg", -360, 360)
    start_m: Place = parameter((0.0, 0.0), "initial ground place in the middle of the picture", "m")
    way_m: tuple[Place, ...] = parameter((), "ground places that it looks at in turn, there and back", "m")
    size_m: float = parameter(0.0, "size of the UAV for its shadow on the ground; 0: no shadow", "m", 0, 20)
    speed_m_s: float = parameter(2.0, "speed along its way", "m/s", 0, 40)
    maximum_m_s: float = parameter(10.0, "greatest speed when it is steered", "m/s", 0.1, 60)
    wind_m_s: float = parameter(1.0, "standard deviation of the gusts that move it", "m/s", 0, 30)
    shake_deg: float = parameter(0.15, "standard deviation of the camera's angles", "deg", 0, 20)
    place_error95_m: float = parameter(3.5, "error of the UAV's own GPS, as gps.error95_m", "m", 0, 1000)
    angle_error_deg: float = parameter(1.0, "standard deviation of the reported tilt's lasting error", "deg", 0, 90)
    heading_error_deg: float = parameter(3.0, "standard deviation of the error of the reported heading", "deg", 0, 180)
    altitude_error: float = parameter(0.01, "standard deviation of the reported altitude, as a share of it", "-", 0, 1)


class CameraParameters(Group):
    """The UAV's camera."""

    width_px: int = parameter(640, "width of the picture", "px", 64, 3840)
    height_px: int = parameter(480, "height of the picture", "px", 64, 2160)
    hfov_deg: float = parameter(60.0, "horizontal field of view", "deg", 5, 120)
    thermal: bool = parameter(False, "thermal camera: people are bright, ground and buildings are dull, no shadows")
    exposure_s: float = parameter(0.002, "exposure time, which blurs moving objects", "s", 0, 0.5)
    readout_s: float = parameter(0.015, "rolling shutter: time from the first to the last row", "s", 0, 0.5)
    vibration_px: float = parameter(
        0.04, "rolling shutter: standard deviation of the rows' shift by vibration", "px", 0, 10
    )
    sharpness_px: float = parameter(0.6, "standard deviation of the lens's blur", "px", 0, 10)
    shot_noise: float = parameter(0.015, "variance of the noise per grey level of brightness", "-", 0, 10)
    read_noise: float = parameter(0.6, "standard deviation of the noise in the dark", "grey levels", 0, 50)
    drift: float = parameter(0.03, "amplitude of slow changes of exposure, as a share", "-", 0, 0.5)
    quality: int = parameter(75, "JPEG quality; 100: no compression", "-", 10, 100)


class Fault(Group):
    """A fault that lasts for a while."""

    what: Literal[
        "ugv_lost", "gps_dropout", "gps_jump", "frozen", "dropped", "gust", "cut", "landmark_hidden", "telemetry_silent"
    ] = parameter(
        "gps_dropout",
        "ugv_lost: the vehicle stops and is silent; gps_dropout: no GPS; gps_jump: its places are off by `size` m; "
        "frozen: the camera repeats a picture; dropped: no pictures; gust: `size` m/s; cut: the film jumps `size` m "
        "east; landmark_hidden: the marker is covered; telemetry_silent: the UAV sends no telemetry",
    )
    time_s: float = parameter(10.0, "start time", "s", 0, 86400)
    seconds: float = parameter(5.0, "duration", "s", 0, 86400)
    vehicle: int = parameter(1, "number of the ground vehicle, from 1", "-", 1, 12)
    size: float = parameter(10.0, "size of the fault, in metres or m/s", "-", 0, 1000)


class ClipParameters(Group):
    """Length of the run, and how its pictures are located."""

    seconds: float = parameter(30.0, "length of the run", "s", 0.3, 86400)
    rate_hz: float = parameter(10.0, "pictures per second", "1/s", 1, 120)
    located_by: Literal["landmarks", "telemetry", "nothing"] = parameter(
        "landmarks",
        "how `dddas run sim:` locates the UAV's pictures on the ground; telemetry: without markers",
    )


class Scenario(Group):
    """A whole scenario. seed: seed of all random numbers. about: one sentence about the scenario."""

    about: str = ""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    clip: ClipParameters = ClipParameters()
    world: WorldParameters = WorldParameters()
    uav: AircraftParameters = AircraftParameters()
    camera: CameraParameters = CameraParameters()
    team: TeamParameters = TeamParameters()
    gps: GpsParameters = GpsParameters()
    crowd: tuple[CrowdPlan, ...] = ()
    car: tuple[CarPlan, ...] = ()
    happening: tuple[Happening, ...] = ()
    fault: tuple[Fault, ...] = ()
    settings: dict[str, dict[str, object]] = Field(default_factory=dict)


def scenario_names() -> list[str]:
    """Return the names of the shipped scenarios."""
    return sorted(path.stem for path in (config_folder() / "scenarios").glob("*.toml"))


def scenario_parameters() -> list[Parameter]:
    """Return every parameter of a scenario, named as in overrides: `uav.altitude_m`, `crowd.1.people`."""
    rows = []
    for key, field in Scenario.model_fields.items():
        if group := _group(field):
            inside = f"{key}.1" if get_origin(field.annotation) is tuple else key
            for name, inner in group.model_fields.items():
                row, words = describe_parameter(f"{inside}.{name}", inner), _PLACES.get(inner.annotation)
                rows.append(replace(row, range=words) if words else row)
    return rows


TEAM: dict[str, object] = {
    "aerial.shadows": True,  # the simulator's sun is known
    "landmarks.length_m": 2.5,
    "people.scale_step": 1.1,  # finds as many people from the ground in half the time
    "crowds.join_m": 3.0,
    "steering.sampling": True,
    "gates.tiny_px": 1000.0,  # a crowd stays one target at any height
}
"""Settings for a simulated team that watches crowds."""


def scenario_settings(scenario: Scenario, config: str | None = None) -> dict[str, object]:
    """Return the system's parameters that a scenario sets: `{"group.parameter": value}`.

    config: the chosen configuration. TEAM is added for the default configuration and for `patrol`.
    """
    own = {f"{group}.{key}": value for group, keys in scenario.settings.items() for key, value in keys.items()}
    return TEAM | own if config in (None, "patrol") else own


def scenario_toml(scenario: Scenario) -> str:
    """Return the whole scenario as the text of a file that `load_scenario` reads."""
    content = scenario.model_dump(mode="json")
    return format_toml({key: value for key, value in content.items() if value not in ([], {})})


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """Load a shipped scenario by its name, or a scenario from a TOML file.

    overrides: changes such as `uav.altitude_m=80` or `crowd.1.people=20`. seed: replaces the scenario's own seed. Files
    that the scenario names are searched for in its folder first, then in the working directory.
    Raises InputError for an unknown scenario (lists known scenarios), invalid TOML, an unknown parameter (suggests the
    nearest), a value outside its range, and a scenario that `check_scenario` rejects.
    """
    path = Path(name_or_path)
    if not is_file(path):
        if path.suffix == ".toml" or len(path.parts) > 1:
            raise InputError(f"no such scenario file: {path}")
        path = config_folder() / "scenarios" / f"{name_or_path}.toml"
        if not str(name_or_path) or not is_file(path):
            names = ", ".join(scenario_names())
            raise InputError(f"no scenario is named '{name_or_path}'; choose from {names}, or give a TOML file")
    content = read_toml(path)
    origin = str(path) if path == Path(name_or_path) else f"scenario {path.stem}"
    if not content:
        raise InputError(f"{origin} is empty; wanted tables such as [clip] and [[crowd]], as in the shipped scenarios")
    for text in overrides:
        _override(content, *parse_override(text))
    if seed is not None:
        content["seed"] = seed
    try:
        scenario = Scenario.model_validate(_with_tuples(content))
        files = {key: path.resolve().parent / getattr(scenario.world, key) for key in _FILES}
        beside = {key: str(file) for key, file in files.items() if is_file(file)}
        scenario = scenario.model_copy(update={"world": scenario.world.model_copy(update=beside)})
        check_scenario(scenario)
    except RecursionError:
        raise InputError(f"{origin}: tables are nested too deeply; use tables such as [clip] only") from None
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{origin}: {_explain(first['loc'], first['type'], first['msg'], first['input'])}") from None
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    return scenario


def _override(content: dict[str, Any], name: str, value: object) -> None:
    """Set a value by its name. Raises InputError if the name does not exist."""
    place: Any = content
    *parts, last = name.split(".")
    for k, part in enumerate(parts):
        if isinstance(place, list):
            if not part.isdecimal() or len(part) > 6 or not 1 <= int(part) <= len(place):
                kind, count = parts[k - 1], "is 1" if len(place) == 1 else f"are {len(place)}"
                raise InputError(f"'{name}' names no {kind}; wanted {kind}.1, {kind}.2, ...; there {count}")
            place = place[int(part) - 1]
        else:
            place = place.setdefault(part, {})
        if not isinstance(place, (dict, list)):
            raise InputError(f"unknown parameter '{name}'; {_nearest_parameter(name)}")
    if isinstance(place, list):
        kind = parts[-1]
        group = _group(Scenario.model_fields[kind]) if kind in Scenario.model_fields else None
        example = next(iter(group.model_fields)) if group else "value"
        raise InputError(f"'{name}' names no parameter; wanted a name such as {kind}.1.{example}=...")
    place[last] = value


def _with_tuples(value: Any) -> Any:
    """Replace the lists of TOML by the tuples of scenarios."""
    if isinstance(value, dict):
        return {key: _with_tuples(entry) for key, entry in value.items()}
    return tuple(_with_tuples(entry) for entry in value) if isinstance(value, list) else value


def check_scenario(scenario: Scenario) -> None:
    """Raise InputError for an impossible scenario: places outside the world, unknown crowds and so on."""
    clip, camera, team = scenario.clip, scenario.camera, scenario.team
    longitude, latitude = scenario.world.origin_deg
    if abs(longitude) > 180 or abs(latitude) > _HIGHEST_DEG:
        raise InputError(
            f"world.origin_deg must be a longitude from -180 to 180 and a latitude from -{_HIGHEST_DEG:g} to "
            f"{_HIGHEST_DEG:g} degrees, got [{longitude:g}, {latitude:g}]"
        )
    _check_places(scenario)
    _check_events(scenario)
    if clip.located_by == "landmarks" and team.ugvs < _FEWEST:
        raise InputError(
            f"team.ugvs must be {_FEWEST} or more in a clip located by landmarks, got {team.ugvs}; "
            'add vehicles, or set clip.located_by = "telemetry"'
        )
    if camera.exposure_s * clip.rate_hz > 1:
        raise InputError(
            f"camera.exposure_s = {camera.exposure_s:g} is longer than the time between pictures; wanted "
            f"{1 / clip.rate_hz:g} s or less at clip.rate_hz = {clip.rate_hz:g}"
        )
    for key in _FILES:
        if (file := getattr(scenario.world, key)) and not is_file(Path(file)):
            raise InputError(f"world.{key}: there is no file {file}")
    with_parameters(Settings(), scenario_settings(scenario), "settings")


def _check_places(scenario: Scenario) -> None:
    """Raise InputError if a place lies outside the world."""
    team, uav, reach = scenario.team, scenario.uav, scenario.world.side_m / 2 - _MARGIN_M
    places: list[tuple[str, Place, float]] = []
    plans: dict[str, Sequence[CrowdPlan | CarPlan]] = {"crowd": scenario.crowd, "car": scenario.car}
    for kind, entries in plans.items():
        for k, plan in enumerate(entries, 1):
            places.append((f"{kind}.{k}.start_m", plan.start_m, getattr(plan, "radius_m", 0.0)))
            places += [(f"{kind}.{k}.way_m", place, 0.0) for place in plan.way_m]
    if team.ugvs:
        places.append(("team.middle_m", team.middle_m, team.ring_m))
    places += [("uav.start_m", uav.start_m, 0.0), *(("uav.way_m", place, 0.0) for place in uav.way_m)]
    for name, (east, north), radius in places:
        if max(abs(east), abs(north)) + radius > reach:
            about = f" with {radius:g} m about it" if radius else ""
            raise InputError(
                f"{name} = [{east:g}, {north:g}]{about} is outside the world; wanted within {reach:g} m of its middle "
                "east and north, or a larger world.side_m"
            )


def _check_events(scenario: Scenario) -> None:
    """Raise InputError if an event or fault is after the clip's end, or concerns a missing crowd or vehicle."""
    ugvs, end, count = scenario.team.ugvs, scenario.clip.seconds, len(scenario.crowd)

    def check_time(name: str, time_s: float) -> None:
        if time_s >= end:
            raise InputError(f"{name}.time_s = {time_s:g} is after the end; clip.seconds = {end:g}")

    for k, happening in enumerate(scenario.happening, 1):
        name, crowds = f"happening.{k}", happening.crowds
        for which in crowds:
            if which > count:
                there = "is 1 crowd" if count == 1 else f"are {count or 'no'} crowds"
                raise InputError(f"{name}.crowds names crowd {which}, but there {there}")
        if happening.what == "join" and len(set(crowds)) < 2:
            raise InputError(f"{name}.crowds must name two or more crowds to join, got {list(crowds)}")
        if len(set(crowds)) < len(crowds):
            raise InputError(f"{name}.crowds = {list(crowds)} names a crowd twice")
        for which in crowds:
            if happening.what == "split" and scenario.crowd[which - 1].people < 2:
                raise InputError(f"{name}: crowd {which} has one person and cannot split")
        check_time(name, happening.time_s)
    for k, fault in enumerate(scenario.fault, 1):
        check_time(f"fault.{k}", fault.time_s)
        if fault.what in _OF_VEHICLES and fault.vehicle > ugvs:
            raise InputError(f"fault.{k}.vehicle = {fault.vehicle} does not exist; wanted team.ugvs = {ugvs} or less")


def _explain(loc: tuple[int | str, ...], kind: str, message: str, value: object) -> str:
    """Return a line about pydantic's first error: the parameter's name, the value, and the wanted values."""
    fields, name, field, is_list = Scenario.model_fields, "", None, False
    for part in loc:
        if is_list:
            name, is_list = f"{name}.{int(part) + 1}", False
            continue
        if part not in fields:  # a list index inside a parameter
            break
        name = f"{name}.{part}".lstrip(".")
        field = fields[str(part)]
        group = _group(field)
        fields, is_list = (group.model_fields, get_origin(field.annotation) is tuple) if group else ({}, False)
    if kind == "extra_forbidden":
        full = ".".join(str(part + 1) if isinstance(part, int) else part for part in loc)
        return f"unknown parameter '{full}'; {_nearest_parameter(full)}"
    text = json.dumps(value, default=str)
    shown = text if len(text) <= 60 else text[:57] + "..."
    if name == "settings" and len(loc) > 1 and not isinstance(value, dict):
        name = f"settings.{loc[1]}"
    if field is None or _group(field) is not None or name.startswith("settings"):
        wanted = "a list of tables" if is_list or name in ("crowd", "car", "happening", "fault") else "a table"
        return f"{name} must be {wanted}, got {shown}"
    if name == "seed":
        return f"seed must be a whole number from 0 to {2**31 - 1}, got {value!r}"
    annotation: Any = field.annotation
    if annotation == Place:
        return f"{name} must be two numbers, [east, north], got {shown}"
    if annotation == tuple[Place, ...]:
        return f"{name} must be a list of places, [[east, north], ...], got {shown}"
    return describe_error(name, shown if isinstance(value, (tuple, dict)) else value, field)


def _nearest_parameter(name: str) -> str:
    """Suggest the parameters with similar names, or list the tables."""
    known = ["about", "seed", *(row.name for row in scenario_parameters())]
    tables = ", ".join(key for key in Scenario.model_fields if key not in ("about", "seed"))
    return nearest(name, known, f"its tables are {tables}")


def _group(field: FieldInfo) -> type[Group] | None:
    """Return the group class of a field or of its list's entries, or None."""
    kind = get_args(field.annotation)[0] if get_origin(field.annotation) is tuple else field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Group) else None
