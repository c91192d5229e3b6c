"""What a sweep searches: values of each parameter on a grid, or the range that they are drawn from."""

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchvision_dddas.config import Settings, all_parameters, nearest, with_parameters
from torchvision_dddas.errors import InputError

MAX_POINTS = 10_000

_RANGE = re.compile(r"\s*([^\s:,\[\]]+)\s*:\s*([^\s:,\[\]]+)\s*(?::\s*(\w+)\s*)?")


@dataclass(frozen=True)
class Choice:
    """Some values of a parameter."""

    parameter: str
    values: tuple[object, ...]


@dataclass(frozen=True)
class Range:
    """Values of a parameter from low to high, both included. step: 0 for real numbers. log: even in the logarithm."""

    parameter: str
    low: float
    high: float
    step: int = 0
    log: bool = False


Axis = Choice | Range


def parse_grid(texts: Sequence[str], settings: Settings) -> list[Choice]:
    """Axes from texts such as `difference.threshold=10,20,30`.

    Raises InputError for an unknown parameter, one that is named twice, no values, a bad value, or too many points.
    """
    axes: list[Choice] = []
    for text in texts:
        parameter, values = _split(text, "group.parameter=value,value", axes)
        axes.append(_choice(parameter, values, text, settings))
    if (count := count_points(axes)) > MAX_POINTS:
        raise InputError(f"the grid may have {MAX_POINTS} points, got {count}; give fewer values, or take --optuna")
    return axes


def parse_ranges(texts: Sequence[str], settings: Settings) -> list[Axis]:
    """Axes from texts such as `difference.threshold=8:30`, `small.gap_frames=2:20:log`, `difference.kind=a,b`.

    Raises InputError as `parse_grid`, and for bad ends of a range.
    """
    axes: list[Axis] = []
    for text in texts:
        parameter, values = _split(text, "group.parameter=low:high", axes)
        found = _RANGE.fullmatch(values)
        axes.append(_range(parameter, found, text, settings) if found else _choice(parameter, values, text, settings))
    return axes


def count_points(axes: Sequence[Choice]) -> int:
    """The number of points of a grid."""
    return math.prod(len(axis.values) for axis in axes)


def why_impossible(settings: Settings, parameters: Mapping[str, object]) -> str:
    """Why parameters cannot have these values together; empty if they can."""
    try:
        with_parameters(settings, parameters)
    except InputError as error:
        return str(error)
    return ""


def _split(text: str, wanted: str, axes: Sequence[Axis]) -> tuple[str, str]:
    parameter, equals, values = (part.strip() for part in text.partition("="))
    if not equals or not parameter or not values:
        raise InputError(f"'{text}' is no axis of a sweep; wanted {wanted}, such as difference.threshold=10,20")
    names = [known.name for known in all_parameters()]
    if parameter not in names:
        raise InputError(f"unknown parameter '{parameter}'; {nearest(parameter, names)}")
    if any(axis.parameter == parameter for axis in axes):
        raise InputError(f"{parameter} is given twice; give all its values in one place")
    return parameter, values


def _choice(parameter: str, listed: str, text: str, settings: Settings) -> Choice:
    values = [tuple(value) if isinstance(value, list) else value for value in _parse_values(listed)]
    if not values:
        raise InputError(f"'{text}' has no values; wanted some, such as difference.threshold=10,20")
    for value in values:
        _check(parameter, value, settings)
    if isinstance(_current(settings, parameter), float):
        values = [float(value) if isinstance(value, int) else value for value in values]
    return Choice(parameter, tuple(dict.fromkeys(values)))


def _parse_values(listed: str) -> list[object]:
    """Values between commas, as TOML has them; words need no quotes."""
    values: list[object] = []
    try:
        return list(tomllib.loads(f"values = [{listed}]")["values"])
    except (ValueError, RecursionError):
        for word in filter(None, (part.strip() for part in listed.split(","))):
            try:
                values.append(tomllib.loads(f"value = {word}")["value"])
            except (ValueError, RecursionError):
                values.append(word)
    return values


def _range(parameter: str, found: re.Match[str], text: str, settings: Settings) -> Range:
    current = _current(settings, parameter)
    if isinstance(current, bool) or not isinstance(current, int | float):
        raise InputError(f"{parameter} is no number and has no range; give its values, as {parameter}=first,second")
    try:
        low, high = float(found[1]), float(found[2])
    except ValueError:
        raise InputError(f"'{text}': the ends of a range must be numbers, low:high") from None
    if not low < high:
        raise InputError(f"'{text}': the lower end must come first, got {low:g}:{high:g}")
    log = found[3] is not None
    if log and found[3] != "log":
        raise InputError(f"'{text}' ends in '{found[3]}'; wanted low:high, or low:high:log")
    if log and low <= 0:
        raise InputError(f"'{text}': the lower end of a logarithmic range must be above 0, got {low:g}")
    odd = next(known.range for known in all_parameters() if known.name == parameter).endswith(", odd")
    if isinstance(current, int):
        if fractions := [end for end in (low, high) if end != int(end)]:
            raise InputError(f"{parameter} takes whole numbers, got {fractions[0]:g}")
        low, high = int(low), int(high)
    for end in (low, high):
        _check(parameter, end, settings)
    if log and odd:
        raise InputError(f"{parameter} takes odd numbers, which have no logarithmic range; leave out :log")
    return Range(parameter, low, high, 0 if isinstance(current, float) else 2 if odd else 1, log)


def _check(parameter: str, value: object, settings: Settings) -> None:
    """Raises InputError for a bad value. Rules over several parameters are checked at each point."""
    cause = why_impossible(settings, {parameter: value})
    if cause.startswith((f"{parameter} = ", f"{parameter} must ")):
        raise InputError(cause)


def _current(settings: Settings, parameter: str) -> object:
    group, name = parameter.split(".")
    return getattr(getattr(settings, group), name)
