"""All parameters by group, and the table of their descriptions."""

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
    RefineParameters,
    RegistrationParameters,
    SmallParameters,
    TrackletParameters,
)
from torchvision_dddas.config.geo import (
    AerialParameters,
    CrowdParameters,
    FusionParameters,
    GroundParameters,
    LandmarkParameters,
)
from torchvision_dddas.config.group import Group, odd
from torchvision_dddas.config.operation import ConfirmParameters, LevelParameters, LiveParameters, SteeringParameters
from torchvision_dddas.config.people import PeopleParameters
from torchvision_dddas.config.tracking import PaperParameters, TrackParameters
from torchvision_dddas.errors import InputError


class Settings(Group):
    """All parameters, by group; `help(td.Settings().difference)` describes one group.

    Settings do not change: `td.load_settings` makes others.

    >>> settings = td.load_settings("fast", ["difference.threshold=15"])
    >>> settings.difference.threshold
    15.0
    >>> settings.refine
    RefineParameters(on=False)
    """

    registration: RegistrationParameters = RegistrationParameters()
    interval: IntervalParameters = IntervalParameters()
    difference: DifferenceParameters = DifferenceParameters()
    morphology: MorphologyParameters = MorphologyParameters()
    refine: RefineParameters = RefineParameters()
    tracklets: TrackletParameters = TrackletParameters()
    small: SmallParameters = SmallParameters()
    history: HistoryParameters = HistoryParameters()
    gates: GateParameters = GateParameters()
    track: TrackParameters = TrackParameters()
    paper: PaperParameters = PaperParameters()
    people: PeopleParameters = PeopleParameters()
    ground: GroundParameters = GroundParameters()
    confirm: ConfirmParameters = ConfirmParameters()
    fusion: FusionParameters = FusionParameters()
    landmarks: LandmarkParameters = LandmarkParameters()
    aerial: AerialParameters = AerialParameters()
    crowds: CrowdParameters = CrowdParameters()
    steering: SteeringParameters = SteeringParameters()
    live: LiveParameters = LiveParameters()
    levels: LevelParameters = LevelParameters()


@dataclass(frozen=True)
class Parameter:
    """A row of the table of parameters, as it is printed."""

    name: str
    default: object
    unit: str
    range: str
    meaning: str


def all_parameters() -> list[Parameter]:
    """Return the rows of all parameters in the order of the groups, for `dddas settings`."""
    return [describe_parameter(name, field) for name, field in parameter_fields()]


def describe_parameter(name: str, field: FieldInfo) -> Parameter:
    """Return the row of one parameter."""
    return Parameter(name, field.default, unit_of(field), range_of(field), field.description or "")


def changes(settings: Settings) -> dict[str, object]:
    """Return the parameters that differ from their defaults: `{"group.parameter": value}`."""
    now = {name: getattr(getattr(settings, name.split(".")[0]), name.split(".")[1]) for name, _ in parameter_fields()}
    return {name: now[name] for name, field in parameter_fields() if now[name] != field.default}


def is_set(settings: Settings, name: str) -> bool:
    """Return whether a parameter, `group.parameter`, was set explicitly, even to its default."""
    group, key = name.split(".")
    return key in getattr(settings, group).model_fields_set


def uses_tracklets(settings: Settings) -> bool:
    """Return whether targets are judged by tracklets, which need evidence in units of noise."""
    return settings.tracklets.on and settings.difference.kind == "normalized"


def is_tiny(size_px: float, tiny_px: float, kind: str) -> bool:
    """Return whether people of this size, 0 if unknown, need the settings for tiny people.

    These settings have thresholds in noise units. tiny_px, kind: `gates.tiny_px` and `difference.kind`.
    """
    return 0 < size_px < tiny_px and kind == "normalized"


def parameter_fields() -> Iterator[tuple[str, FieldInfo]]:
    """Yield every parameter's full name and its field."""
    for group, holder in Settings.model_fields.items():
        for name, field in type(holder.default).model_fields.items():
            yield f"{group}.{name}", field


def unit_of(field: FieldInfo) -> str:
    """Return the unit of a parameter, or ""."""
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""


def range_of(field: FieldInfo) -> str:
    """Return the range in words: `true or false`, `homography or affine`, `50 to 5000`, `3 to 15, odd`."""
    kind, rules = field.annotation, list(field.metadata)
    many = get_origin(kind) is tuple
    if many:  # the rules for a list's elements are stored with the elements
        kind, *inner = get_args(get_args(kind)[0]) or get_args(kind)[:1]
        rules += [rule for entry in inner for rule in (entry.metadata if isinstance(entry, FieldInfo) else [entry])]
    if kind is bool:
        return "true or false"
    if kind is str:
        return "a name or a file"
    if get_origin(kind) is Literal:
        return " or ".join(str(choice) or "nothing" for choice in get_args(kind))
    low = next((rule.ge for rule in rules if getattr(rule, "ge", None) is not None), None)
    high = next((rule.le for rule in rules if getattr(rule, "le", None) is not None), None)
    words = f"{low} to {high}" + (", odd" if any(getattr(rule, "func", None) is odd for rule in rules) else "")
    return f"a list of {words}" if many else words


def check_settings(settings: Any) -> Settings:
    """Return the given settings, or the defaults for None. Raises InputError for another type."""
    if settings is not None and not isinstance(settings, Settings):
        made = f": td.load_settings({settings!r}) makes them" if isinstance(settings, str | Path) else ""
        raise InputError(f"settings must be of type Settings, got {type(settings).__name__}{made}")
    return settings or Settings()
