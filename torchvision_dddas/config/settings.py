"""All parameters by group, and the table that describes them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from torchvision_dddas.config.detection import (
    DifferenceParameters,
    GateParameters,
    HistoryParameters,
    IntervalParameters,
    MorphologyParameters,
    PersistenceParameters,
    RefineParameters,
    RegistrationParameters,
    SmallParameters,
    TrackletParameters,
)
from torchvision_dddas.config.geo import AerialParameters, CrowdParameters, GroundParameters, LandmarkParameters
from torchvision_dddas.config.group import Group, odd
from torchvision_dddas.config.operation import ConfirmParameters, LevelParameters, LiveParameters, SteeringParameters
from torchvision_dddas.config.people import PeopleParameters
from torchvision_dddas.config.tracking import PaperParameters, TrackParameters
from torchvision_dddas.errors import InputError


class Settings(Group):
    """All parameters, by group."""

    registration: RegistrationParameters = RegistrationParameters()
    interval: IntervalParameters = IntervalParameters()
    difference: DifferenceParameters = DifferenceParameters()
    morphology: MorphologyParameters = MorphologyParameters()
    refine: RefineParameters = RefineParameters()
    persistence: PersistenceParameters = PersistenceParameters()
    tracklets: TrackletParameters = TrackletParameters()
    small: SmallParameters = SmallParameters()
    history: HistoryParameters = HistoryParameters()
    gates: GateParameters = GateParameters()
    track: TrackParameters = TrackParameters()
    paper: PaperParameters = PaperParameters()
    people: PeopleParameters = PeopleParameters()
    ground: GroundParameters = GroundParameters()
    confirm: ConfirmParameters = ConfirmParameters()
    landmarks: LandmarkParameters = LandmarkParameters()
    aerial: AerialParameters = AerialParameters()
    crowds: CrowdParameters = CrowdParameters()
    steering: SteeringParameters = SteeringParameters()
    live: LiveParameters = LiveParameters()
    levels: LevelParameters = LevelParameters()


@dataclass(frozen=True)
class Parameter:
    """One row of the table of parameters, ready to print."""

    name: str
    default: object
    unit: str
    range: str
    meaning: str


def all_parameters() -> list[Parameter]:
    """Every parameter in the order of the groups, for `dddas settings` and the README."""
    return [describe_parameter(name, field) for name, field in parameter_fields()]


def describe_parameter(name: str, field: FieldInfo) -> Parameter:
    """The row of one parameter."""
    return Parameter(name, field.default, unit_of(field), range_of(field), field.description or "")


def changes(settings: Settings) -> dict[str, object]:
    """The parameters that differ from their defaults: `{"group.parameter": value}`."""
    now = {name: getattr(getattr(settings, name.split(".")[0]), name.split(".")[1]) for name, _ in parameter_fields()}
    return {name: now[name] for name, field in parameter_fields() if now[name] != field.default}


def is_set(settings: Settings, name: str) -> bool:
    """Whether somebody has set a parameter, `group.parameter`: its value counts then, also where it is the default."""
    group, key = name.split(".")
    return key in getattr(settings, group).model_fields_set


def uses_tracklets(settings: Settings) -> bool:
    """Whether targets are judged by tracklets: these need evidence in units of noise."""
    return settings.tracklets.on and settings.difference.kind == "normalized"


def parameter_fields() -> Iterator[tuple[str, FieldInfo]]:
    """Every parameter by its full name."""
    for group, holder in Settings.model_fields.items():
        for name, field in type(holder.default).model_fields.items():
            yield f"{group}.{name}", field


def unit_of(field: FieldInfo) -> str:
    """The unit of a parameter; empty where it has none."""
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""


def range_of(field: FieldInfo) -> str:
    """In words: `true or false`, `homography or affine`, `50 to 5000`, `3 to 15, odd`, `a list of 1 to 30`."""
    kind, rules = field.annotation, list(field.metadata)
    many = get_origin(kind) is tuple
    if many:  # the rules of a list's elements hang on the elements
        kind, *inner = get_args(get_args(kind)[0]) or get_args(kind)[:1]
        rules += [rule for entry in inner for rule in (entry.metadata if isinstance(entry, FieldInfo) else [entry])]
    if kind is bool:
        return "true or false"
    if kind is str:
        return "a name or a file"
    if get_origin(kind) is Literal:
        return " or ".join(str(choice) for choice in get_args(kind))
    low = next((rule.ge for rule in rules if getattr(rule, "ge", None) is not None), None)
    high = next((rule.le for rule in rules if getattr(rule, "le", None) is not None), None)
    words = f"{low} to {high}" + (", odd" if any(getattr(rule, "func", None) is odd for rule in rules) else "")
    return f"a list of {words}" if many else words


def check_settings(settings: Any) -> Settings:
    """The settings that a class was given, the defaults for None. Raises InputError for anything else."""
    if settings is not None and not isinstance(settings, Settings):
        made = f": td.load_settings({settings!r}) makes them" if isinstance(settings, str | Path) else ""
        raise InputError(f"settings must be of type Settings, got {type(settings).__name__}{made}")
    return settings or Settings()
