"""What is wrong with the values of a scenario, in words: the parameter by its name, what came, what was wanted."""

import json
from typing import Any, get_args, get_origin

from pydantic.fields import FieldInfo

from torchvision_dddas.config import Group, nearest, will_not_do
from torchvision_dddas.simulation.scenario.parameters import Place, Scenario


def explained(loc: tuple[int | str, ...], kind: str, said: str, value: object) -> str:
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
        return f"{name}: {said.removeprefix('Value error, ')}"
    if name == "settings" and len(loc) > 1 and not isinstance(value, dict):
        name = f"settings.{loc[1]}"
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
    return next(iter(group.model_fields)) if group else "knob"


def _shown(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _group(field: FieldInfo) -> type[Group] | None:
    """The group that a field holds, or that the entries of its list are."""
    kind = get_args(field.annotation)[0] if get_origin(field.annotation) is tuple else field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Group) else None
