"""A scenario from a TOML file, and from changes to it."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from torchvision_dddas.config import (
    Group,
    Settings,
    config_folder,
    describe_error,
    format_toml,
    is_file,
    nearest,
    parse_override,
    read_toml,
    with_parameters,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.scenario import Place, Scenario, WorldParameters


def scenario_names() -> list[str]:
    """The shipped scenarios, by name."""
    return sorted(path.stem for path in _scenario_folder().glob("*.toml"))


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """A scenario: a shipped one by its name, or a TOML file; changed by `group.parameter=value`, `crowd.1.people=20`.

    seed: in place of its own. Files that it names are looked for beside it, then from where the program was started.
    Raises InputError with one line: no such scenario (with those there are), no TOML, a parameter that there is not
    (with the nearest), a value out of its range, and what `check` says.
    """
    path = _find_file(name_or_path)
    content = read_toml(path)
    origin = str(path) if path == Path(name_or_path) else f"scenario {path.stem}"
    if not content:
        raise InputError(f"{origin} is empty; wanted tables such as [clip] and [[crowd]], as in the shipped scenarios")
    for text in overrides:
        _change(content, *parse_override(text))
    if seed is not None:
        content["seed"] = seed
    scenario = _built(content, origin)
    scenario = scenario.model_copy(update={"world": _beside(scenario.world, path.resolve().parent)})
    try:
        check_scenario(scenario)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    return scenario


def _scenario_folder() -> Path:
    return config_folder() / "scenarios"


def _find_file(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if is_file(path):
        return path
    if path.suffix == ".toml" or len(path.parts) > 1:
        raise InputError(f"no such scenario file: {path}")
    shipped = _scenario_folder() / f"{name_or_path}.toml"
    if not str(name_or_path) or not is_file(shipped):
        raise InputError(
            f"no scenario is named '{name_or_path}'; there are {', '.join(scenario_names())}, or give a TOML file"
        )
    return shipped


def _beside(world: WorldParameters, folder: Path) -> WorldParameters:
    """With the files that lie beside the scenario's own by their whole names."""
    found = {key: str(folder / name) for key in ("elevation", "photo") if (name := getattr(world, key))}
    return world.model_copy(update={key: name for key, name in found.items() if is_file(Path(name))})


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
            raise InputError(f"unknown parameter '{name}'; {nearest_parameter(name)}")
    if isinstance(place, list):
        raise InputError(f"'{name}' names no parameter; wanted such as {parts[-1]}.1.{example(parts[-1])}=...")
    place[last] = value


def _entry(entries: list[Any], kind: str, number: str, name: str) -> Any:
    if not number.isdecimal() or len(number) > 6 or not 1 <= int(number) <= len(entries):
        one = "is 1" if len(entries) == 1 else f"are {len(entries)}"
        raise InputError(f"'{name}' names no {kind}; wanted {kind}.1, {kind}.2, ..., of which there {one}")
    return entries[int(number) - 1]


def _built(content: dict[str, Any], origin: str) -> Scenario:
    try:
        return Scenario.model_validate(_tuples(content))
    except RecursionError:
        raise InputError(f"{origin}: its tables go too deep; wanted such as [clip] and [[crowd]]") from None
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            f"{origin}: {explain_error(first['loc'], first['type'], first['msg'], first['input'])}"
        ) from None


def _tuples(value: Any) -> Any:
    """TOML has lists where records have tuples."""
    if isinstance(value, dict):
        return {key: _tuples(entry) for key, entry in value.items()}
    return tuple(_tuples(entry) for entry in value) if isinstance(value, list) else value


# Checks of a scenario that need no world.


FEWEST = 4  # landmarks that lay a picture on the ground


HIGHEST_DEG = 85.0  # near the poles longitudes run together


MARGIN_M = 2.0  # least distance of what moves from the edge of the world


OF_VEHICLES = ("ugv_lost", "gps_dropout", "gps_jump", "landmark_hidden")  # faults of one ground vehicle


def check_scenario(scenario: Scenario) -> None:
    """Raises InputError with one line for an impossible scenario: places outside the world, no such crowd, ..."""
    _check_origin(scenario)
    _check_places(scenario)
    _check_times(scenario)
    if scenario.clip.located_by == "landmarks" and scenario.team.ugvs < FEWEST:
        raise InputError(
            f"team.ugvs must be {FEWEST} or more in a clip located by landmarks, got {scenario.team.ugvs}; "
            'add vehicles, or set clip.located_by = "telemetry"'
        )
    if scenario.camera.exposure_s * scenario.clip.rate_hz > 1:
        raise InputError(
            f"camera.exposure_s = {scenario.camera.exposure_s:g} is longer than from picture to picture; wanted "
            f"{1 / scenario.clip.rate_hz:g} s or less at clip.rate_hz = {scenario.clip.rate_hz:g}"
        )
    for key in ("elevation", "photo"):
        if (file := getattr(scenario.world, key)) and not is_file(Path(file)):
            raise InputError(f"world.{key}: there is no file {file}")
    with_parameters(Settings(), scenario_settings(scenario), "settings")


def scenario_settings(scenario: Scenario) -> dict[str, object]:
    """The parameters of the system that a scenario sets: `{"group.parameter": value}`."""
    return {f"{group}.{key}": value for group, keys in scenario.settings.items() for key, value in keys.items()}


def _check_origin(scenario: Scenario) -> None:
    """The world lies where longitudes and latitudes tell places."""
    longitude, latitude = scenario.world.origin_deg
    if abs(longitude) > 180 or abs(latitude) > HIGHEST_DEG:
        raise InputError(
            f"world.origin_deg must be a longitude from -180 to 180 and a latitude from -{HIGHEST_DEG:g} to "
            f"{HIGHEST_DEG:g} degrees, got [{longitude:g}, {latitude:g}]"
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
            raise InputError(f"{name}.crowds must name two or more crowds to join, got {list(happening.crowds)}")
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


# What is wrong with the values of a scenario, in words: the parameter by its name, what came, what was wanted.


def explain_error(loc: tuple[int | str, ...], kind: str, message: str, value: object) -> str:
    """One line of what pydantic found first."""
    fields, name, field, listed = Scenario.model_fields, "", None, False
    for part in loc:
        if listed:
            name, listed = f"{name}.{int(part) + 1}", False
            continue
        if part not in fields:  # inside a parameter: a place in a list
            break
        name = f"{name}.{part}".lstrip(".")
        field = fields[str(part)]
        group = _group(field)
        fields, listed = (group.model_fields, get_origin(field.annotation) is tuple) if group else ({}, False)
    if kind == "extra_forbidden":
        full = ".".join(str(part + 1) if isinstance(part, int) else part for part in loc)
        return f"unknown parameter '{full}'; {nearest_parameter(full)}"
    if kind == "value_error":  # a rule across parameters
        return f"{name}: {message.removeprefix('Value error, ')}"
    if name == "settings" and len(loc) > 1 and not isinstance(value, dict):
        name = f"settings.{loc[1]}"
    if field is None or _group(field) is not None or name.startswith("settings"):
        wanted = "a list of tables" if listed or name in ("crowd", "car", "happening", "fault") else "a table"
        return f"{name} must be {wanted}, got {_shown(value)}"
    if name == "seed":
        return f"seed must be a whole number from 0 to {2**31 - 1}, got {value!r}"
    annotation: Any = field.annotation
    if annotation == Place:
        return f"{name} must be two numbers, [east, north], got {_shown(value)}"
    if annotation == tuple[Place, ...]:
        return f"{name} must be a list of places, [[east, north], ...], got {_shown(value)}"
    return describe_error(name, _shown(value) if isinstance(value, (tuple, dict)) else value, field)


def nearest_parameter(name: str) -> str:
    """Names that look like it, or the tables that there are."""
    known = ["about", "seed"]
    for key, field in Scenario.model_fields.items():
        if group := _group(field):
            inside = f"{key}.1" if get_origin(field.annotation) is tuple else key
            known += [f"{inside}.{parameter_name}" for parameter_name in group.model_fields]
    tables = ", ".join(key for key in Scenario.model_fields if key not in ("about", "seed"))
    return nearest(name, known, f"its tables are {tables}")


def example(kind: str) -> str:
    """A parameter of an entry of a list."""
    group = _group(Scenario.model_fields[kind]) if kind in Scenario.model_fields else None
    return next(iter(group.model_fields)) if group else "value"


def _shown(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _group(field: FieldInfo) -> type[Group] | None:
    """The group that a field holds, or that the entries of its list are."""
    kind = get_args(field.annotation)[0] if get_origin(field.annotation) is tuple else field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Group) else None


def scenario_toml(scenario: Scenario) -> str:
    """The whole scenario as a file that `load_scenario` reads."""
    content = scenario.model_dump(mode="json")
    return format_toml({key: value for key, value in content.items() if value not in ([], {})})
