"""Where a sweep looks: the values of each knob on a grid, or the range that they are drawn from."""

import itertools
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torchvision_dddas.config import Settings, all_knobs, nearest, with_knobs
from torchvision_dddas.errors import InputError

MOST_POINTS = 10_000

_RANGE = re.compile(r"\s*([^\s:,\[\]]+)\s*:\s*([^\s:,\[\]]+)\s*(?::\s*(\w+)\s*)?")


@dataclass(frozen=True)
class Choice:
    """Some values of a knob."""

    knob: str
    values: tuple[object, ...]


@dataclass(frozen=True)
class Range:
    """Values of a knob from low to high, both in it. step: 0 for any number between; log: as many in each decade."""

    knob: str
    low: float
    high: float
    step: int = 0
    log: bool = False


Axis = Choice | Range


def on_grid(texts: Sequence[str], settings: Settings) -> list[Choice]:
    """Axes from texts such as `difference.threshold=10,20,30`.

    Raises InputError for an unknown knob, one that is named twice, no values, and a value that will not do.
    """
    axes: list[Choice] = []
    for text in texts:
        knob, said = _halves(text, "group.knob=value,value", settings, axes)
        axes.append(_choice(knob, said, text, settings))
    return axes


def in_ranges(texts: Sequence[str], settings: Settings) -> list[Axis]:
    """Axes from texts such as `difference.threshold=8:30`, `small.gap_frames=2:20:log`, `difference.kind=a,b`.

    Raises InputError as `on_grid`, and for a range whose ends will not do.
    """
    axes: list[Axis] = []
    for text in texts:
        knob, said = _halves(text, "group.knob=low:high", settings, axes)
        found = _RANGE.fullmatch(said)
        axes.append(_range(knob, found, text, settings) if found else _choice(knob, said, text, settings))
    return axes


def points(axes: Sequence[Choice]) -> Iterator[dict[str, object]]:
    """Every combination of the values, the last axis the quickest. Raises InputError where they are too many."""
    count = 1
    for axis in axes:
        count *= len(axis.values)
    if count > MOST_POINTS:
        raise InputError(f"the grid has {count} points, at most {MOST_POINTS} will do; give fewer values, or --optuna")
    for values in itertools.product(*(axis.values for axis in axes)):
        yield {axis.knob: value for axis, value in zip(axes, values, strict=True)}


def possible(settings: Settings, knobs: Mapping[str, object]) -> str:
    """Why knobs cannot have these values together; empty where they can."""
    try:
        with_knobs(settings, knobs)
    except InputError as error:
        return str(error)
    return ""


def _halves(text: str, wanted: str, settings: Settings, axes: Sequence[Axis]) -> tuple[str, str]:
    knob, equals, said = (part.strip() for part in text.partition("="))
    if not equals or not knob or not said:
        raise InputError(f"'{text}' is no axis of a sweep; wanted {wanted}, such as difference.threshold=10,20")
    names = [known.name for known in all_knobs()]
    if knob not in names:
        raise InputError(f"unknown knob '{knob}'; {nearest(knob, names)}")
    if any(axis.knob == knob for axis in axes):
        raise InputError(f"{knob} is given twice; wanted all that it may be in one place")
    return knob, said


def _choice(knob: str, said: str, text: str, settings: Settings) -> Choice:
    values = [tuple(value) if isinstance(value, list) else value for value in _listed(said)]
    if not values:
        raise InputError(f"'{text}' has no values; wanted some, such as difference.threshold=10,20")
    for value in values:
        _check(knob, value, settings)
    return Choice(knob, tuple(dict.fromkeys(_as_it_is(knob, value, settings) for value in values)))


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


def _range(knob: str, found: re.Match[str], text: str, settings: Settings) -> Range:
    now = _value(settings, knob)
    if isinstance(now, bool) or not isinstance(now, int | float):
        raise InputError(f"{knob} is no number and has no range; wanted its values, such as {knob}=first,second")
    low, high = (_number(end, text) for end in found.groups()[:2])
    if not low < high:
        raise InputError(f"'{text}' goes from {low:g} to {high:g}; wanted the lower end first")
    if found[3] not in (None, "log"):
        raise InputError(f"'{text}' ends in '{found[3]}'; wanted low:high, or low:high:log")
    if (log := found[3] is not None) and low <= 0:
        raise InputError(f"'{text}' goes from {low:g} in decades; wanted a lower end above 0")
    if isinstance(now, float):
        for end in (low, high):
            _check(knob, end, settings)
        return Range(knob, low, high, 0, log)
    if odd_end := next((end for end in (low, high) if end != int(end)), None):
        raise InputError(f"{knob} takes whole numbers; '{text}' has {odd_end:g}")
    for end in (low, high):
        _check(knob, int(end), settings)
    odd = next(known.range for known in all_knobs() if known.name == knob).endswith(", odd")
    if log and odd:
        raise InputError(f"{knob} takes odd numbers, which cannot be drawn in decades; leave out :log")
    return Range(knob, int(low), int(high), 2 if odd else 1, log)


def _number(text: str, axis: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"'{axis}': {text} is no number; wanted low:high") from None


def _check(knob: str, value: object, settings: Settings) -> None:
    """Raises InputError where a knob cannot have a value; a rule over several knobs is asked at each point."""
    told = possible(settings, {knob: value})
    if told.startswith(f"{knob} = "):
        raise InputError(told)


def _as_it_is(knob: str, value: object, settings: Settings) -> object:
    """The value as the settings hold it: 20 as 20.0 where a knob is no whole number."""
    return float(value) if isinstance(_value(settings, knob), float) and isinstance(value, int) else value


def _value(settings: Settings, knob: str) -> object:
    group, name = knob.split(".")
    return getattr(getattr(settings, group), name)
