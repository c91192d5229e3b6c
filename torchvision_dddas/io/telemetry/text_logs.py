"""DJI's subtitle files in any dialect, as telemetry."""

import math
import re
from collections.abc import Iterator
from datetime import tzinfo
from pathlib import Path

import numpy as np

from torchvision_dddas.io.telemetry.record import Log, build_record
from torchvision_dddas.io.telemetry.tables import UNKNOWN_ZONE, convert, hfov_of_focal, parse_date, quantity_of, to_utc
from torchvision_dddas.types import Telemetry

Numbers = list[tuple[float, str]]
"""The numbers in a pair of brackets, each with the letters beside it."""

_TIMING = re.compile(r"(\d{1,6}):(\d{1,2}):(\d{1,2})[.,](\d{1,3})\s*-+>")
_MARKUP = re.compile(r"<[^<>]*>")
_NUMBER = r"[-+]?\d+(?:[.,]\d+)?"
_NUMERAL, _NO_LETTERS = re.compile(_NUMBER), re.compile(rf"{_NUMBER}|[\s:°]")
# A name, and what follows it: see `_after_names`.
_TUPLE = re.compile(r"[A-Za-z][A-Za-z.]*"), re.compile(r"\s*(?::\s*)?\(([^)]*)\)?")
_PAIR = (
    re.compile(r"[A-Za-z][A-Za-z_.]*", re.IGNORECASE),
    re.compile(rf"\s*(?:[:=]\s*)?({_NUMBER})(?![\d:.])\s*(m/s|km/h|kmh|mph|ft|cm|mm|m|°)?(?![A-Za-z])", re.IGNORECASE),
)
_OPTICS = ("focal_len", "fnum", "dzoom_ratio")
_AXES = {"g.pry": ("gimbalpitch", "gimbalroll", "gimbalyaw"), "f.pry": ("", "", "yaw")}


def read_subtitles(path: Path, text: str, clock_offset_s: float, zone: tzinfo | None = None) -> Telemetry:
    """zone: of dates that say none.

    Raises InputError without any position, height or attitude, or if times decrease.
    """
    log = Log(path, "DJI subtitles", bridge_s=2.0)
    subtitles = _subtitles(text)
    tuples = [_tuples(words) for *_, words in subtitles]
    is_swapped = _is_latitude_first(log, *([t[name] for t in tuples if name in t] for name in ("gps", "home")))
    dates = [parse_date(words) for *_, words in subtitles]
    first_s, is_zoned = next((date for date in dates if date), (math.nan, False))
    lacking: dict[str, list[int]] = {}
    timeless: list[int] = []
    for (line, time_s, words), numbers, date in zip(subtitles, tuples, dates, strict=True):
        if math.isnan(time_s):
            time_s = date[0] - first_s if date else math.nan
        if math.isnan(time_s):
            timeless.append(line)
            continue
        values = _quantities(log, words, numbers, is_swapped)
        log.moments.append((time_s, 0.0, line))
        for name in [name for name in log.samples if name not in values]:
            lacking.setdefault(name, []).append(line)
            values[name] = math.nan
        for name, value in values.items():
            log.add(name, time_s, value, line)
    if timeless:
        log.note(f"line {timeless[0]}: a subtitle without time is left out, {len(timeless)} in all")
    _note_lacking(log, lacking, subtitles[-1][0] if subtitles else 0, len(subtitles))
    if not is_zoned and zone is not None and math.isfinite(first_s):
        first_s, is_zoned = to_utc(first_s, zone), True
    elif not is_zoned and math.isfinite(first_s):
        log.note(UNKNOWN_ZONE)
    return build_record(log, clock_offset_s, first_s - log.moments[0][0] if is_zoned and log.moments else math.nan)


def _subtitles(text: str) -> list[tuple[int, float, str]]:
    """Line, time (NaN without a timing) and text without markup of each subtitle.

    Subtitles begin with a timing; in a file without timings they lie between blank lines.
    """
    lines = [line.strip() for line in text.splitlines()]
    is_timed = any(_TIMING.match(line) for line in lines)
    blocks: list[tuple[int, float, list[str]]] = []
    is_between = not is_timed
    for number, line in enumerate(lines, 1):
        if timing := _TIMING.match(line):
            hours, minutes, seconds, fraction = timing.groups()
            time_s = int(hours) * 3600 + int(minutes) * 60 + int(seconds) + float(f"0.{fraction}")
            blocks.append((number, time_s, []))
        elif not line or line.isdigit():
            is_between = not is_timed
        elif is_between or blocks:
            if is_between:
                blocks.append((number, math.nan, []))
                is_between = False
            blocks[-1][2].append(line)
    return [(number, time_s, _MARKUP.sub(" ", "\n".join(words))) for number, time_s, words in blocks]


def _after_names(text: str, name: re.Pattern[str], value: re.Pattern[str]) -> Iterator[tuple[str, re.Match[str], int]]:
    """Each name that a value follows, the value, and where the name begins.

    One expression for both would try every part of a long word as a name: time as the square of its length, or worse.
    """
    place = 0
    while (word := name.search(text, place)) is not None:
        place = word.end()
        if (found := value.match(text, place)) is not None:
            yield word[0], found, word.start()
            place = found.end()


def _without_tuples(text: str) -> str:
    """The text without numbers in brackets and their names."""
    parts, place = [], 0
    for _, found, begin in _after_names(text, *_TUPLE):
        parts.append(text[place:begin])
        place = found.end()
    return " ".join([*parts, text[place:]])


def _tuples(text: str) -> dict[str, Numbers]:
    """Numbers in brackets by the name before them."""
    found: dict[str, Numbers] = {}
    for name, brackets, _ in _after_names(text, *_TUPLE) if "(" in text else ():
        inside = brackets[1]
        cells = re.split(r"[;,]\s+|;", inside) if re.search(r"[;,]\s|;", inside) else inside.split(",")
        if "." not in inside and len(cells) >= 4 and len(cells) == inside.count(",") + 1:
            cells = [",".join(cells[i : i + 2]) for i in range(0, len(cells), 2)]  # decimal commas
        matches = [_NUMERAL.search(cell) for cell in cells]
        values = [float(match[0].replace(",", ".")) if match else math.nan for match in matches]
        letters = [_NO_LETTERS.sub("", cell).upper() for cell in cells]
        found["gps" if name.lower() == "rtk" else name.lower()] = list(zip(values, letters, strict=True))
    return found


def _is_latitude_first(log: Log, gps: list[Numbers], home: list[Numbers]) -> bool:
    """Whether GPS(...) has the latitude first: by values beyond 90 degrees, else by dialect.

    DJI writes longitude, latitude and the number of satellites; if the third is in metres, latitude comes first.
    """
    pairs = np.array([[a[0][0], a[1][0]] for a in gps + home if len(a) > 1 and not a[0][1] and not a[1][1]])
    if not len(pairs):
        return False
    is_first_longitude, is_second_longitude = (np.abs(pairs) > 90).any(axis=0)
    if is_first_longitude or is_second_longitude:
        return bool(is_second_longitude and not is_first_longitude)
    is_metres = any(len(a) > 2 and a[2][1] == "M" for a in gps)
    log.note(
        f"GPS(...) is taken as {'latitude, longitude' if is_metres else 'longitude, latitude'}, as this dialect has "
        "it: the numbers would fit either order"
    )
    return is_metres


def _quantities(log: Log, text: str, tuples: dict[str, Numbers], is_swapped: bool) -> dict[str, float]:
    """Values of one subtitle by quantity."""
    values = _place(tuples.get("gps", []), is_swapped)
    for name, keys in _AXES.items():
        for key, (value, _) in zip(keys, tuples.get(name, ()), strict=False):
            if found := convert(key, value):
                values[found[0]] = found[1]
    optics: dict[str, str] = {}
    for key, pair, _ in _after_names(_without_tuples(text) if tuples else text, *_PAIR):
        number, unit = pair[1], pair[2] or ""
        if key in _OPTICS:
            optics[key] = number
        # Only with a unit the letter h means the height.
        if quantity_of(key) is None or (key.lower() == "h" and not unit):
            continue
        found = convert(key, float(number.replace(",", ".")), unit)
        if found and found[0] not in values:
            values[found[0]] = found[1]
            if key.lower() in ("altitude", "alt"):
                log.note("the file does not say where the altitude is zero; above the sea is assumed")
    hfov = hfov_of_focal(*(optics.get(name, "").replace(",", ".") for name in _OPTICS))
    if hfov is not None:
        values["hfov_rad"] = hfov
        log.is_nominal = True
        log.note("the field of view is that of a focal length as for a picture with a longer side of 36 mm")
    if values.get("longitude_deg") == values.get("latitude_deg") == values.get("above_sea_m") == 0.0:
        values["above_sea_m"] = math.nan  # no fix
    return values


def _place(gps: Numbers, is_swapped: bool) -> dict[str, float]:
    values: dict[str, float] = {}
    for value, letter in gps[:2]:
        if letter in ("N", "S", "E", "W"):
            name = "latitude_deg" if letter in "NS" else "longitude_deg"
            values[name] = -abs(value) if letter in "SW" else value
    if not values and len(gps) > 1:
        names = ("latitude_deg", "longitude_deg") if is_swapped else ("longitude_deg", "latitude_deg")
        values = {name: value for name, (value, _) in zip(names, gps, strict=False)}
    # A third number with a unit is a height, without one the number of satellites; 0.0 m stands for none.
    if len(gps) > 2 and gps[2][1] == "M" and gps[2][0] != 0:
        values["above_sea_m"] = gps[2][0]
    return values


def _note_lacking(log: Log, lacking: dict[str, list[int]], last: int, count: int) -> None:
    """Note quantities that some subtitles lack and earlier ones have. last: line of the last of `count` subtitles."""
    together: dict[tuple[int, ...], list[str]] = {}
    for name, lines in lacking.items():
        together.setdefault(tuple(lines), []).append(name)
    for (first, *others), names in together.items():
        what = f"lacks {', '.join(sorted(names))}"
        if first == last:
            log.note(f"line {last}: the last subtitle {what}: the file is incomplete; unknown there")
        else:
            also = f", as do {len(others)} more of {count}" if others else ""
            log.note(f"line {first}: the subtitle {what}{also}; unknown there")
