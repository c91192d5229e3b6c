"""A scenario from a TOML file, and from changes to it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from torchvision_dddas.config import config_folder, is_file, parse_override, read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.scenario.checks import check
from torchvision_dddas.simulation.scenario.parameters import Scenario, WorldParameters
from torchvision_dddas.simulation.scenario.wording import example, explained, nearest_parameter


def names() -> list[str]:
    """The shipped scenarios, by name."""
    return sorted(path.stem for path in _folder().glob("*.toml"))


def load(name_or_path: str | Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """A scenario: a shipped one by its name, or a TOML file; changed by `group.parameter=value`, `crowd.1.people=20`.

    seed: in place of its own. Files that it names are looked for beside it, then from where the program was started.
    Raises InputError with one line: no such scenario (with those there are), no TOML, a parameter that there is not
    (with the nearest), a value out of its range, and what `check` says.
    """
    path = _file(name_or_path)
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
        check(scenario)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    return scenario


def _folder() -> Path:
    return config_folder() / "scenarios"


def _file(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if is_file(path):
        return path
    if path.suffix == ".toml" or len(path.parts) > 1:
        raise InputError(f"no such scenario file: {path}")
    shipped = _folder() / f"{name_or_path}.toml"
    if not str(name_or_path) or not is_file(shipped):
        raise InputError(f"no scenario is named '{name_or_path}'; there are {', '.join(names())}, or give a TOML file")
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
        raise InputError(f"{origin}: {explained(first['loc'], first['type'], first['msg'], first['input'])}") from None


def _tuples(value: Any) -> Any:
    """TOML has lists where records have tuples."""
    if isinstance(value, dict):
        return {key: _tuples(entry) for key, entry in value.items()}
    return tuple(_tuples(entry) for entry in value) if isinstance(value, list) else value
