"""Where a sweep looks: the values of each parameter on a grid, or the range that they are drawn from."""

import itertools
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torchvision_dddas.config import Settings, all_parameters, nearest, with_parameters
from torchvision_dddas.errors import InputError

MOST_POINTS = 10_000

_RANGE = re.compile(r"\s*([^\s:,\[\]]+)\s*:\s*([^\s:,\[\]]+)\s*(?::\s*(\w+)\s*)?")


@dataclass(frozen=True)
class Choice:
    """Some values of a parameter."""

    parameter: str
    values: tuple[object, ...]


@dataclass(frozen=True)
class Range:
    """Values of a knob from low to high, both in it. step: 0 for any number between; log: as many in each decade."""

    parameter: str
    low: float
    high: float
    step: int = 0
    log: bool = False


Axis = Choice | Range


def on_grid(texts: Sequence[str], settings: Settings) -> list[Choice]:
    """Axes from texts such as `difference.threshold=10,20,30`.

    Raises InputError for an unknown parameter, one that is named twice, no values, and a value that will not do.
    """
    axes: list[Choice] = []
    for text in texts:
        parameter, said = _halves(text, "group.parameter=value,value", settings, axes)
        axes.append(_choice(parameter, said, text, settings))
    return axes


def in_ranges(texts: Sequence[str], settings: Settings) -> list[Axis]:
    """Axes from texts such as `difference.threshold=8:30`, `small.gap_frames=2:20:log`, `difference.kind=a,b`.

    Raises InputError as `on_grid`, and for a range whose ends will not do.
    """
    axes: list[Axis] = []
    for text in texts:
        parameter, said = _halves(text, "group.parameter=low:high", settings, axes)
        found = _RANGE.fullmatch(said)
        axes.append(_range(parameter, found, text, settings) if found else _choice(parameter, said, text, settings))
    return axes


def points(axes: Sequence[Choice]) -> Iterator[dict[str, object]]:
    """Every combination of the values, the last axis the quickest. Raises InputError where they are too many."""
    count = 1
    for axis in axes:
        count *= len(axis.values)
    if count > MOST_POINTS:
        raise InputError(f"the grid has {count} points, at most {MOST_POINTS} will do; give fewer values, or --optuna")
    for values in itertools.product(*(axis.values for axis in axes)):
        yield {axis.parameter: value for axis, value in zip(axes, values, strict=True)}


def possible(settings: Settings, parameters: Mapping[str, object]) -> str:
    """Why parameters cannot have these values together; empty where they can."""
    try:
        with_parameters(settings, parameters)
    except InputError as error:
        return str(error)
    return ""


def _halves(text: str, wanted: str, settings: Settings, axes: Sequence[Axis]) -> tuple[str, str]:
    parameter, equals, said = (part.strip() for part in text.partition("="))
    if not equals or not parameter or not said:
        raise InputError(f"'{text}' is no axis of a sweep; wanted {wanted}, such as difference.threshold=10,20")
    names = [known.name for known in all_parameters()]
    if parameter not in names:
        raise InputError(f"unknown parameter '{parameter}'; {nearest(parameter, names)}")
    if any(axis.parameter == parameter for axis in axes):
        raise InputError(f"{parameter} is given twice; wanted all that it may be in one place")
    return parameter, said


def _choice(parameter: str, said: str, text: str, settings: Settings) -> Choice:
    values = [tuple(value) if isinstance(value, list) else value for value in _listed(said)]
    if not values:
        raise InputError(f"'{text}' has no values; wanted some, such as difference.threshold=10,20")
    for value in values:
        _check(parameter, value, settings)
    return Choice(parameter, tuple(dict.fromkeys(_as_it_is(parameter, value, settings) for value in values)))


def _listed(said: str) -> list[object]:
    """Values between commas; words need no quotes."""
    try:
        values: list[object] = tomllib.loads(f"values = [{said}]")["values"]
    except (ValueError, RecursionError):
        values = []
        for word in filter(None, (part.strip() for part in said.split(","))):
            try:
                values.append(tomllib.loads(f"value = {word}")["value"])
            except (ValueError, RecursionError):
                values.append(word)
    return values


def _range(parameter: str, found: re.Match[str], text: str, settings: Settings) -> Range:
    now = _value(settings, parameter)
    if isinstance(now, bool) or not isinstance(now, int | float):
        raise InputError(
            f"{parameter} is no number and has no range; wanted its values, such as {parameter}=first,second"
        )
    low, high = (_number(end, text) for end in found.groups()[:2])
    if not low < high:
        raise InputError(f"'{text}' goes from {low:g} to {high:g}; wanted the lower end first")
    if found[3] not in (None, "log"):
        raise InputError(f"'{text}' ends in '{found[3]}'; wanted low:high, or low:high:log")
    if (log := found[3] is not None) and low <= 0:
        raise InputError(f"'{text}' goes from {low:g} in decades; wanted a lower end above 0")
    if isinstance(now, float):
        for end in (low, high):
            _check(parameter, end, settings)
        return Range(parameter, low, high, 0, log)
    if odd_end := next((end for end in (low, high) if end != int(end)), None):
        raise InputError(f"{parameter} takes whole numbers; '{text}' has {odd_end:g}")
    for end in (low, high):
        _check(parameter, int(end), settings)
    odd = next(known.range for known in all_parameters() if known.name == parameter).endswith(", odd")
    if log and odd:
        raise InputError(f"{parameter} takes odd numbers, which cannot be drawn in decades; leave out :log")
    return Range(parameter, int(low), int(high), 2 if odd else 1, log)


def _number(text: str, axis: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"'{axis}': {text} is no number; wanted low:high") from None


def _check(parameter: str, value: object, settings: Settings) -> None:
    """Raises InputError where a knob cannot have a value; a rule over several knobs is asked at each point."""
    told = possible(settings, {parameter: value})
    if told.startswith(f"{parameter} = "):
        raise InputError(told)


def _as_it_is(parameter: str, value: object, settings: Settings) -> object:
    """The value as the settings hold it: 20 as 20.0 where a parameter is no whole number."""
    return float(value) if isinstance(_value(settings, parameter), float) and isinstance(value, int) else value


def _value(settings: Settings, parameter: str) -> object:
    group, name = parameter.split(".")
    return getattr(getattr(settings, group), name)
