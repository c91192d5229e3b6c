"""What a simulated world holds and what happens in it: every number of a scenario, with its unit and range.

Metres are local: east and north of the world's origin, which is its middle. Speeds, behaviours and heights follow
appendix A, section V: a border area near Tucson, 1300 m above the sea, crowds at U(1.11, 3.34) m a time unit along east
and along north, UGVs that are fast at first and slow near the crowd, a UAV 50 to 200 m above ground.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo

from torchvision_dddas.errors import InputError
from torchvision_dddas.settings import (
    Group,
    Settings,
    config_folder,
    knob,
    nearest,
    parse_override,
    read_toml,
    will_not_do,
    with_knobs,
)

Place = tuple[float, float]


class WorldKnobs(Group):
    """The ground and what stands on it."""

    origin_deg: Place = knob((-110.95, 31.6), "deg", meaning="longitude and latitude of the world's middle")
    side_m: float = knob(400.0, "m", 40, 4000, meaning="length of the square world's side")
    texel_m: float = knob(0.1, "m", 0.02, 2, meaning="size of a pixel of the ground's texture")
    above_sea_m: float = knob(1300.0, "m", -500, 9000, meaning="height of the middle above the sea")
    relief_m: float = knob(3.0, "m", 0, 1000, meaning="from the lowest to the highest ground; 0: level")
    elevation: str = knob("", "-", meaning="a GeoTIFF of heights in place of the synthetic relief")
    photo: str = knob("", "-", meaning="an ortho-photo, a GeoTIFF, in place of the synthetic desert scrub")
    bushes_per_ha: float = knob(40.0, "1/ha", 0, 2000, meaning="bushes on a hectare")
    trees_per_ha: float = knob(3.0, "1/ha", 0, 500, meaning="trees on a hectare")
    buildings: int = knob(2, "buildings", 0, 200, meaning="buildings in the world")
    sun_azimuth_deg: float = knob(140.0, "deg", 0, 360, meaning="where the sun stands, clockwise from north")
    sun_height_deg: float = knob(50.0, "deg", 5, 90, meaning="how high it stands above the horizon")


class CrowdPlan(Group):
    """A crowd: people who go together."""

    people: int = knob(10, "people", 1, 5000, meaning="how many they are")
    start_m: Place = knob((0.0, 0.0), "m", meaning="where their middle is at first")
    radius_m: float = knob(2.0, "m", 0, 200, meaning="how far from their middle they are")
    behaviour: Literal["walk", "random", "stand"] = knob(
        "walk", "-", meaning="walk: along way_m or heading_deg; random: a new velocity each time unit; stand"
    )
    speed_m_s: float = knob(1.4, "m/s", 0, 10, meaning="how fast they walk")
    heading_deg: float = knob(90.0, "deg", -360, 360, meaning="whither, clockwise from north, without way_m")
    way_m: tuple[Place, ...] = knob((), "m", meaning="places they walk through, one after the other, and back again")
    from_s: float = knob(0.0, "s", 0, 86400, meaning="when they set out; until then they stand")


class CarPlan(Group):
    """A vehicle that is no landmark: clutter, which no person is."""

    start_m: Place = knob((0.0, 0.0), "m", meaning="where it is at first")
    heading_deg: float = knob(90.0, "deg", -360, 360, meaning="whither it drives, clockwise from north, without way_m")
    speed_m_s: float = knob(6.0, "m/s", 0, 40, meaning="how fast it drives")
    way_m: tuple[Place, ...] = knob((), "m", meaning="places it drives through, one after the other, and back again")
    from_s: float = knob(0.0, "s", 0, 86400, meaning="when it sets out")


class Happening(Group):
    """Something that crowds do at a time. Crowds are numbered from 1, in the order of the file."""

    time_s: float = knob(10.0, "s", 0, 86400, meaning="when")
    what: Literal["join", "split", "scatter"] = knob(
        "join",
        "-",
        meaning="join: two or more walk to one place and go on as the first; split: one parts in two, whose ways "
        "differ by turn_deg; scatter: everyone of it runs off on their own",
    )
    crowds: Annotated[tuple[Annotated[int, Field(ge=1, le=10_000)], ...], Field(min_length=1)] = knob(
        (1,), "-", meaning="which crowds"
    )
    turn_deg: float = knob(60.0, "deg", 0, 180, meaning="angle between the ways of the two parts of a split")


class TeamKnobs(Group):
    """The ground vehicles: landmarks for the aerial camera, and eyes on the ground."""

    ugvs: int = knob(4, "vehicles", 0, 12, meaning="how many there are; each wears a colour of its own")
    ring_m: float = knob(14.0, "m", 0, 1000, meaning="radius of the ring about middle_m on which they stand at first")
    middle_m: Place = knob((0.0, 0.0), "m", meaning="middle of that ring")
    patrol_m_s: float = knob(1.0, "m/s", 0, 10, meaning="speed along their planned ways, while nobody steers them")
    patrol: Literal["stand", "random", "gather", "along"] = knob(
        "random",
        "-",
        meaning="planned ways: none; from place to place within the ring; to its middle, fast and then slow, as the "
        "source's; with the UAV's own way",
    )
    planned: bool = knob(True, "-", meaning="they share their planned waypoints, which bridge GPS dropouts")
    hfov_deg: float = knob(56.0, "deg", 10, 120, meaning="width of the field of view of their cameras")
    width_px: int = knob(640, "px", 64, 3840, meaning="width of their pictures")
    height_px: int = knob(480, "px", 64, 2160, meaning="height of their pictures")
    camera_m: float = knob(1.3, "m", 0.1, 20, meaning="height of their cameras above ground")


class GpsKnobs(Group):
    """The receivers of the ground vehicles."""

    error95_m: float = knob(0.0, "m", 0, 1000, meaning="95 % of the places are this near the truth; 0: exact")
    white_share: float = knob(0.1, "-", 0, 1, meaning="share of the variance that is new in each report")
    correlation_s: float = knob(60.0, "s", 0.1, 1e5, meaning="time over which the rest stays alike")
    common_m: float = knob(0.0, "m", 0, 1000, meaning="standard deviation, per axis, of what all receivers share")
    rate_hz: float = knob(10.0, "1/s", 0.01, 100, meaning="reports a second")


class AircraftKnobs(Group):
    """The UAV, what it reports of itself, and how it flies while nobody steers it."""

    altitude_m: float = knob(50.0, "m", 2, 2000, meaning="height above the ground below it")
    pitch_deg: float = knob(90.0, "deg", 10, 90, meaning="how far the camera looks below the horizon; 90: down")
    heading_deg: float = knob(0.0, "deg", -360, 360, meaning="heading of the picture's upper edge at first")
    start_m: Place = knob((0.0, 0.0), "m", meaning="ground that is in the middle of the picture at first")
    way_m: tuple[Place, ...] = knob((), "m", meaning="places that it looks at, one after the other, and back again")
    speed_m_s: float = knob(2.0, "m/s", 0, 40, meaning="speed along its way")
    maximum_m_s: float = knob(10.0, "m/s", 0.1, 60, meaning="fastest that it flies when it is steered")
    wind_m_s: float = knob(1.0, "m/s", 0, 30, meaning="standard deviation of the gusts that push it about")
    shake_deg: float = knob(0.15, "deg", 0, 20, meaning="standard deviation of the camera's angles about the intended")
    place_error95_m: float = knob(3.5, "m", 0, 1000, meaning="of its own GPS, as in gps.error95_m")
    angle_error_deg: float = knob(1.0, "deg", 0, 90, meaning="standard deviation of the tilt it reports, lasting")
    heading_error_deg: float = knob(3.0, "deg", 0, 180, meaning="of the heading")
    altitude_error: float = knob(0.01, "-", 0, 1, meaning="of the altitude, as a share")


class CameraKnobs(Group):
    """The UAV's camera."""

    width_px: int = knob(640, "px", 64, 3840, meaning="width of the picture")
    height_px: int = knob(480, "px", 64, 2160, meaning="height of the picture")
    hfov_deg: float = knob(60.0, "deg", 5, 120, meaning="width of the field of view")
    exposure_s: float = knob(0.002, "s", 0, 0.5, meaning="time of exposure: what moves is blurred along its way")
    readout_s: float = knob(0.015, "s", 0, 0.5, meaning="rolling shutter: the last row is read so much later")
    sharpness_px: float = knob(0.6, "px", 0, 10, meaning="standard deviation of the lens's blur")
    shot_noise: float = knob(0.015, "-", 0, 10, meaning="variance of the noise, in grey levels, for each grey level")
    read_noise: float = knob(0.6, "grey levels", 0, 50, meaning="standard deviation of the noise in the dark")
    drift: float = knob(0.03, "-", 0, 0.5, meaning="amplitude of slow changes of exposure, as a share")
    quality: int = knob(92, "-", 10, 100, meaning="of the JPEG compression; 100: none")


class Fault(Group):
    """Something that goes wrong for a while."""

    what: Literal[
        "ugv_lost", "gps_dropout", "gps_jump", "frozen", "dropped", "gust", "landmark_hidden", "telemetry_silent"
    ] = knob(
        "gps_dropout",
        "-",
        meaning="a vehicle stops and is silent; its receiver is silent; its places are off by `size` metres; the "
        "camera repeats a picture; pictures are missing; the UAV is pushed with `size` m/s; a marker is covered; the "
        "UAV says nothing of itself",
    )
    time_s: float = knob(10.0, "s", 0, 86400, meaning="when it begins")
    seconds: float = knob(5.0, "s", 0, 86400, meaning="how long it lasts")
    vehicle: int = knob(1, "-", 1, 12, meaning="which ground vehicle, counted from 1")
    size: float = knob(10.0, "-", 0, 1000, meaning="how far or fast, in metres or metres a second")


class ClipKnobs(Group):
    """How long the run is, and how it is located."""

    seconds: float = knob(30.0, "s", 0.3, 86400, meaning="length of the run")
    rate_hz: float = knob(10.0, "1/s", 1, 120, meaning="pictures a second")
    located_by: Literal["landmarks", "telemetry", "nothing"] = knob(
        "landmarks", "-", meaning="what lays the UAV's pictures on the ground"
    )


class Scenario(Group):
    """A whole scenario. seed: of everything that chance decides in it; about: what it shows, in a sentence."""

    about: str = ""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    clip: ClipKnobs = ClipKnobs()
    world: WorldKnobs = WorldKnobs()
    uav: AircraftKnobs = AircraftKnobs()
    camera: CameraKnobs = CameraKnobs()
    team: TeamKnobs = TeamKnobs()
    gps: GpsKnobs = GpsKnobs()
    crowd: tuple[CrowdPlan, ...] = ()
    car: tuple[CarPlan, ...] = ()
    happening: tuple[Happening, ...] = ()
    fault: tuple[Fault, ...] = ()
    settings: dict[str, dict[str, object]] = Field(default_factory=dict)


# --------------------------------------------------------------------------------------------------------------------
# Reading one.

FEWEST = 4
"""Landmarks that lay a picture on the ground."""

MARGIN_M = 2.0
"""What moves begins and goes so far inside the world."""


def names() -> list[str]:
    """The shipped scenarios, by name."""
    return sorted(path.stem for path in _folder().glob("*.toml"))


def load(name_or_path: str | Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """A scenario: a shipped one by its name, or a TOML file; changed by `group.knob=value`, `crowd.1.people=20`.

    seed: in place of its own. Files that it names are looked for beside it, then from where the program was started.
    Raises InputError with one line: no such scenario (with those there are), no TOML, a knob that there is not (with
    the nearest), a value out of its range, and what `check` says.
    """
    path = _file(name_or_path)
    content = read_toml(path)
    origin = str(path) if path == Path(name_or_path) else f"scenario {path.stem}"
    for text in overrides:
        _change(content, *parse_override(text))
    if seed is not None:
        content["seed"] = seed
    scenario = _built(content, origin)
    scenario = scenario.model_copy(update={"world": _beside(scenario.world, path.resolve().parent)})
    try:
        check(scenario)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    return scenario


def check(scenario: Scenario) -> None:
    """Raises InputError with one line for what cannot be: something outside the world, happening to no crowd, ..."""
    _check_places(scenario)
    _check_times(scenario)
    if scenario.clip.located_by == "landmarks" and scenario.team.ugvs < FEWEST:
        raise InputError(
            f"team.ugvs = {scenario.team.ugvs} will not do: a clip located by landmarks needs {FEWEST}; add vehicles, "
            'or set clip.located_by = "telemetry"'
        )
    for key in ("elevation", "photo"):
        if (file := getattr(scenario.world, key)) and not Path(file).is_file():
            raise InputError(f"world.{key}: there is no file {file}")
    with_knobs(Settings(), settings_of(scenario), "settings")


def settings_of(scenario: Scenario) -> dict[str, object]:
    """The knobs of the system that a scenario sets: `{"group.knob": value}`."""
    return {f"{group}.{key}": value for group, keys in scenario.settings.items() for key, value in keys.items()}


def as_toml(scenario: Scenario) -> str:
    """The whole scenario as a file that `load` reads."""
    lines: list[str] = []
    content = scenario.model_dump(mode="json")
    for key, value in content.items():
        if not isinstance(value, (dict, list)):
            lines.append(f"{key} = {_toml(value)}")
    for key, value in content.items():
        tables = value if isinstance(value, list) else [value] if isinstance(value, dict) and key != "settings" else []
        for table in tables:
            lines += ["", f"[[{key}]]" if isinstance(value, list) else f"[{key}]"]
            lines += [f"{name} = {_toml(entry)}" for name, entry in table.items()]
    for group, knobs in content["settings"].items():
        lines += ["", f"[settings.{group}]", *(f"{name} = {_toml(entry)}" for name, entry in knobs.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(entry) for entry in value) + "]"
    # Numbers, words and truth values are written alike in JSON, but that its words may not hold DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _folder() -> Path:
    return config_folder() / "scenarios"


def _file(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.suffix == ".toml" or len(path.parts) > 1:
        raise InputError(f"no such scenario file: {path}")
    shipped = _folder() / f"{name_or_path}.toml"
    if not str(name_or_path) or not shipped.is_file():
        raise InputError(f"no scenario is named '{name_or_path}'; there are {', '.join(names())}, or give a TOML file")
    return shipped


def _beside(world: WorldKnobs, folder: Path) -> WorldKnobs:
    """With the files that lie beside the scenario's own by their whole names."""
    found = {key: str(folder / name) for key in ("elevation", "photo") if (name := getattr(world, key))}
    return world.model_copy(update={key: name for key, name in found.items() if Path(name).is_file()})


def _change(content: dict[str, Any], name: str, value: object) -> None:
    """Set a value by its name. Raises InputError where there is no such place."""
    place: Any = content
    *parts, last = name.split(".")
    for k, part in enumerate(parts):
        if isinstance(place, list):
            place = _entry(place, parts[k - 1], part, name)
        else:
            place = place.setdefault(part, {})
        if not isinstance(place, (dict, list)):
            raise InputError(f"unknown knob '{name}'; {_nearest(name)}")
    if isinstance(place, list):
        raise InputError(f"'{name}' names no knob; wanted such as {parts[-1]}.1.{_example(parts[-1])}=...")
    place[last] = value


def _entry(entries: list[Any], kind: str, number: str, name: str) -> Any:
    if not number.isdecimal() or not 1 <= int(number) <= len(entries):
        one = "is 1" if len(entries) == 1 else f"are {len(entries)}"
        raise InputError(f"'{name}' names no {kind}; wanted {kind}.1, {kind}.2, ..., of which there {one}")
    return entries[int(number) - 1]


def _built(content: dict[str, Any], origin: str) -> Scenario:
    try:
        return Scenario.model_validate(_tuples(content))
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{origin}: {_explained(first['loc'], first['type'], first['msg'], first['input'])}") from None


def _tuples(value: Any) -> Any:
    """TOML has lists where records have tuples."""
    if isinstance(value, dict):
        return {key: _tuples(entry) for key, entry in value.items()}
    return tuple(_tuples(entry) for entry in value) if isinstance(value, list) else value


def _explained(loc: tuple[int | str, ...], kind: str, said: str, value: object) -> str:
    """One line of what pydantic found first."""
    fields, name, field, listed = Scenario.model_fields, "", None, False
    for part in loc:
        if listed:
            name, listed = f"{name}.{int(part) + 1}", False
            continue
        if part not in fields:  # inside a knob: a place in a list
            break
        name = f"{name}.{part}".lstrip(".")
        field = fields[str(part)]
        group = _group(field)
        fields, listed = (group.model_fields, get_origin(field.annotation) is tuple) if group else ({}, False)
    if kind == "extra_forbidden":
        full = ".".join(str(part + 1) if isinstance(part, int) else part for part in loc)
        return f"unknown knob '{full}'; {_nearest(full)}"
    if kind == "value_error":  # a rule across knobs
        return f"{name}: {said.removeprefix('Value error, ')}"
    if field is None or _group(field) is not None or name.startswith("settings"):
        wanted = "a list of tables" if listed or name in ("crowd", "car", "happening", "fault") else "a table"
        return f"{name} = {_shown(value)} will not do; wanted {wanted}"
    if name == "seed":
        return f"seed = {value!r} will not do; wanted a whole number, 0 to {2**31 - 1}"
    annotation: Any = field.annotation
    if annotation == Place:
        return f"{name} = {_shown(value)} will not do; wanted two numbers, [east, north]"
    if annotation == tuple[Place, ...]:
        return f"{name} = {_shown(value)} will not do; wanted a list of places, [[east, north], ...]"
    return will_not_do(name, _shown(value) if isinstance(value, (tuple, dict)) else value, field)


def _shown(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _group(field: FieldInfo) -> type[Group] | None:
    """The group that a field holds, or that the entries of its list are."""
    kind = get_args(field.annotation)[0] if get_origin(field.annotation) is tuple else field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Group) else None


def _example(kind: str) -> str:
    group = _group(Scenario.model_fields[kind]) if kind in Scenario.model_fields else None
    return next(iter(group.model_fields)) if group else "knob"


def _nearest(name: str) -> str:
    known = ["about", "seed"]
    for key, field in Scenario.model_fields.items():
        if group := _group(field):
            inside = f"{key}.1" if get_origin(field.annotation) is tuple else key
            known += [f"{inside}.{knob_name}" for knob_name in group.model_fields]
    tables = ", ".join(key for key in Scenario.model_fields if key not in ("about", "seed"))
    return nearest(name, known, f"its tables are {tables}")


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


OF_VEHICLES = ("ugv_lost", "gps_dropout", "gps_jump", "landmark_hidden")
"""Faults of one ground vehicle."""
