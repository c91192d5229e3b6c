"""Read DJI's subtitle files, in any dialect, as telemetry."""

import math
import re
from collections.abc import Callable, Iterator
from datetime import tzinfo
from pathlib import Path

import numpy as np

from torchvision_dddas.geometry import DEGREE_M
from torchvision_dddas.io.telemetry.clocks import DATE_JUMP_S, clock_at_start, parse_dates, sort_flights
from torchvision_dddas.io.telemetry.fields import ANGLE, UNITS, Names, field_of_view, names_of_subtitles, parse_angle
from torchvision_dddas.io.telemetry.record import JUMP_M, SPLIT_S, Log, build_record
from torchvision_dddas.types import Telemetry

Values = dict[str, float]
Numbers = list[tuple[float, str]]
"""The numbers in a pair of brackets, each with the letters beside it."""

_TIMING = re.compile(r"(?:(\d{1,6}):)?(\d{1,2}):(\d{1,2})[.,](\d{1,9})\s*-+>(?:\s*[\d:]{5,12}[.,](\d{1,9}))?")
_MARKUP = re.compile(r"<[^<>]*>")
_NUMBER = r"[-+]?\d+(?:[.,]\d+)?"
_NUMERAL, _NO_LETTERS = re.compile(_NUMBER), re.compile(rf"{_NUMBER}|[\s:°]")
# A name, and the value behind it: see `_after_names`.
_TUPLE = re.compile(r"[A-Za-z][A-Za-z.]*"), re.compile(r"\s*(?::\s*)?\(([^)]*)\)?")
_PAIR = (
    re.compile(r"[A-Za-z][A-Za-z_.]*", re.IGNORECASE),
    re.compile(rf"\s*(?:[:=]\s*)?x?({_NUMBER})(?![\d:.])\s*(m/s|km/h|kmh|mph|ft|[cm]?m|°|x)?(?![a-z])", re.IGNORECASE),
)
# [Gimbal: Yaw:1.0, Pitch:-30.0] and Gimbal(Yaw:1.0), also over several lines: the angles get the name of the group.
_OWNERS, _ANGLES = "gimbal|gb|camera|mount|payload|drone|aircraft|uav|vehicle|flight", "(?:yaw|pitch|roll|heading)"
_GROUP = re.compile(
    rf"\b({_OWNERS})(?: ?(?:attitude|angles?))?\s?(?:[:=]\s?[\[({{]?|[\[({{])\s*(?={_ANGLES}\s?[:=])"
    rf"((?:(?!\b(?:{_OWNERS})\b|\n\s*\n)[^\[\](){{}}]){{1,200}})",
    re.IGNORECASE,
)
_IN_GROUP = re.compile(rf"\b{_ANGLES}(?=\s?[:=])", re.IGNORECASE)
_OWNED = re.compile(rf"\b({_OWNERS}) +(?={_ANGLES}\b)", re.IGNORECASE)
# A latitude or longitude with a side or with minutes, and two coordinates without brackets.
_SIDED = re.compile(
    rf"\b((?:lat|lon|lng)[a-z]{{0,7}}\s*[:=]\s*)(?=[NSEW]|-?[\d.,]{{1,15}} ?[NSEWd°])({ANGLE})(?![\w.])", re.IGNORECASE
)
_TWO = re.compile(
    r"\b(?:gps|position|location|coord[a-z]{0,8})\s*[:=]\s*(-?\d+\.\d+\s*[,;]\s*-?\d+\.\d+)", re.IGNORECASE
)
# Forms of a few dialects, and functions that rewrite them in the usual form.
_USUAL: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], str]], ...] = (
    (_GROUP, lambda found: _IN_GROUP.sub(rf"{found[1]}.\g<0>", found[2])),
    (_OWNED, lambda found: f"{found[1]}."),
    (_SIDED, lambda found: f"{found[1]}{parse_angle(found[2])[0]:.9f}"),
    (_TWO, lambda found: f"GPS({found[1]})"),
)
_DECIMAL, _PLACES = re.compile(r"\s*-?\d{1,6},\d{1,6} ?(?:[mM]|ft)?\s*"), ("gps", "rtk", "home")
_AXES = {"g.pry": ("gimbalpitch", "gimbalroll", "gimbalyaw"), "f.pry": ("", "", "yaw")}
_OPTICS = ("focal_mm", "f_number", "zoom")
_POINT = re.compile(r"\d[.,]\d")
_WORST, _SAMPLE, _SATELLITES = 1000, 10_000, 60


def read_subtitles(
    path: Path, text: str, clock_offset_s: float, zone: tzinfo | None = None, order: str = "auto"
) -> Telemetry:
    """Return the record of subtitles. Arguments and errors are those of `read_telemetry`."""
    log = Log(path, "DJI subtitles", bridge_s=2.0)
    names = names_of_subtitles(text)
    some = "\n\n".join(text[k * len(text) // 4 :][:_SAMPLE] for k in range(4))
    for form, usual in _USUAL:
        text = form.sub(usual, text) if form.search(some) else text
    subtitles = _subtitles(text)
    dates, is_sure, remark = parse_dates([words for *_, words in subtitles])
    parted = [_tuples(words) for *_, words in subtitles]
    is_swapped = _is_latitude_first(log, names, [tuples for tuples, _ in parted], order)
    first_s, is_zoned = next((date for date in dates if date), (math.nan, False))
    lacking: dict[str, list[int]] = {}
    timeless: list[int] = []
    lenses: list[dict[str, str]] = []
    last_s = last_date_s = math.nan  # time and date of the previous subtitle
    last: Values = {}
    jumps, shift_s = list[tuple[float, float]](), 0.0
    for (line, time_s, _), (tuples, rest), date in zip(subtitles, parted, dates, strict=True):
        if math.isnan(time_s):
            time_s = date[0] - first_s if date else math.nan
        if math.isnan(time_s):
            timeless.append(line)
            continue
        time_s += shift_s
        values, lens = _quantities(names, rest, tuples, is_swapped)
        jump_s = date[0] - last_date_s - (time_s - last_s) if date is not None else math.nan
        if math.isfinite(jump_s):
            jumps.append((last_s, jump_s))
        if time_s < last_s:  # the dates or a jump of the place show whether another flight begins here
            here, there = ([at.get(f"{name}itude_deg", math.nan) for name in ("long", "lat")] for at in (values, last))
            if math.isnan(jump_s) and math.dist(here, there) * DEGREE_M > JUMP_M:
                jump_s = last_s - time_s + 1.0
                log.splits.append(last_s + SPLIT_S)
            if abs(jump_s) > DATE_JUMP_S or jump_s > 0:
                time_s, shift_s = time_s + jump_s, shift_s + jump_s
        last_s, last = time_s, values
        last_date_s = date[0] if date is not None else math.nan
        log.moments.append((time_s, 0.0, line))
        lenses.append(lens)
        for name in [name for name in log.samples if name not in values]:
            lacking.setdefault(name, []).append(line)
            values[name] = math.nan
        for name, value in values.items():
            log.add(name, time_s, value, line)
    if timeless:
        log.note(f"line {timeless[0]}: a subtitle without time is left out, {len(timeless)} in all")
    _note_lacking(log, lacking, subtitles[-1][0] if subtitles else 0, len(subtitles))
    usual_s = float(np.median([abs(jump_s) for _, jump_s in jumps] or [0.0]))
    log.splits += [time_s + SPLIT_S for time_s, jump_s in jumps if abs(jump_s) > max(DATE_JUMP_S, 10 * usual_s)]
    sort_flights(log, np.array([moment[0] for moment in log.moments]))
    if any("focal_mm" in lens for lens in lenses):
        hfov, notes = field_of_view(*([lens.get(name, "") for lens in lenses] for name in _OPTICS))
        times, _, lines = np.array(log.moments).T
        log.add_all(times, lines, {"hfov_rad": hfov})
        log.is_nominal = True
        log.notes += notes
    start_s = first_s - log.moments[0][0] if log.moments else math.nan
    start_s = clock_at_start(log, start_s, is_zoned, is_sure, zone, "the date", remark)
    return build_record(log, clock_offset_s, start_s)


def _subtitles(text: str) -> list[tuple[int, float, str]]:
    """Return the line, the time (NaN without a timing) and the text without markup of each subtitle.

    Subtitles begin with a timing; in a file without timings they lie between blank lines.
    """
    lines = [line.strip() for line in text.splitlines()]
    timings = [_TIMING.match(line) for line in lines]
    # Milliseconds without leading zeros, or over 999, show as fractions of different lengths.
    sizes = {len(part) for timing in timings if timing for part in timing.groups()[3:] if part}
    is_timed = bool(sizes)
    blocks: list[tuple[int, float, list[str]]] = []
    is_between = not is_timed
    for number, (line, timing) in enumerate(zip(lines, timings, strict=True), 1):
        if timing is not None:
            hours, minutes, seconds, fraction, _ = timing.groups()
            part_s = float(f"0.{fraction}") if len(sizes) == 1 else int(fraction) / 1000
            blocks.append((number, int(hours or 0) * 3600 + int(minutes) * 60 + int(seconds) + part_s, []))
        elif not line or line.isdigit():
            is_between = not is_timed
        elif is_between or blocks:
            if is_between:
                blocks.append((number, math.nan, []))
                is_between = False
            blocks[-1][2].append(line)
    return [(number, time_s, _MARKUP.sub(" ", "\n".join(words))) for number, time_s, words in blocks]


def _after_names(text: str, name: re.Pattern[str], value: re.Pattern[str]) -> Iterator[tuple[str, re.Match[str], int]]:
    """Yield each name that a value follows, the value, and where the name begins.

    A single expression would try every part of a long word as a name, in time quadratic in the word's length or worse.
    """
    place = 0
    while (word := name.search(text, place)) is not None:
        place = word.end()
        if (found := value.match(text, place)) is not None:
            yield word[0], found, word.start()
            place = found.end()


def _tuples(text: str) -> tuple[dict[str, Numbers], str]:
    """Return the numbers in brackets by the name before them, and the text without names and brackets."""
    found: dict[str, Numbers] = {}
    parts, place = [], 0
    for name, brackets, begin in _after_names(text, *_TUPLE) if "(" in text else ():
        inside = brackets[1]
        cells = re.split(r"[;,]\s+|;", inside) if re.search(r"[;,]\s|;", inside) else inside.split(",")
        if "." not in inside and len(cells) >= 4 and len(cells) == inside.count(",") + 1:
            cells = [",".join(cells[i : i + 2]) for i in range(0, len(cells), 2)]  # decimal commas
        elif name.lower() not in _PLACES and _DECIMAL.fullmatch(inside):
            cells = [inside]
        matches = [_NUMERAL.search(cell) for cell in cells]
        values = [float(match[0].replace(",", ".")) if match else math.nan for match in matches]
        # Decimals without a unit count as the letter "."
        letters = [_NO_LETTERS.sub("", cell).upper() or "." * bool(_POINT.search(cell)) for cell in cells]
        found["gps" if name.lower() == "rtk" else name.lower()] = list(zip(values, letters, strict=True))
        parts.append(text[place:begin])
        place = brackets.end()
    return found, " ".join([*parts, text[place:]]) if parts else text


def _is_latitude_first(log: Log, names: Names, tuples: list[dict[str, Numbers]], order: str) -> bool:
    """Return whether GPS(...) has the latitude first."""
    places = [found[name] for found in tuples for name in ("gps", "home") if name in found]
    pairs = [(two[0][0], two[1][0]) for two in places if len(two) > 1 and {two[0][1], two[1][1]} <= {"", "."}]
    return bool(pairs) and log.latitude_first(np.array(pairs), names.order, order, "GPS(...)")


def _quantities(names: Names, text: str, tuples: dict[str, Numbers], is_swapped: bool) -> tuple[Values, dict[str, str]]:
    """Return the values of a subtitle by quantity, and values of the lens as text. text: without the tuples."""
    values = _place(tuples.get("gps", []), is_swapped, names.order == "lat-lon")
    lens, ranks = dict[str, str](), dict[str, int]()
    found = [
        (f"{key} ({letters})" if letters in ("M", "FT") else key, str(value))
        for name, numbers in tuples.items()
        for key, (value, letters) in zip(_AXES.get(name, (name,) * (len(numbers) == 1)), numbers, strict=False)
    ]
    found += [(f"{key} ({pair[2]})" if pair[2] else key, pair[1]) for key, pair, _ in _after_names(text, *_PAIR)]
    for title, number in found:
        known = names.find(title)
        if known is None or known.rank >= ranks.get(known.field.quantity, _WORST):
            continue
        quantity, kind = known.field.quantity, known.field.kind
        ranks[quantity] = known.rank
        if quantity in _OPTICS:
            lens[quantity] = number.replace(",", ".")
        elif kind in UNITS and kind != "time":
            values[quantity] = float(number.replace(",", ".")) * known.scale
    if values.get("longitude_deg") == values.get("latitude_deg") == 0.0:  # no fix
        values |= {name: math.nan for name in ("bare_altitude_m", "above_sea_m") if values.get(name) == 0.0}
    return values, lens


def _place(gps: Numbers, is_swapped: bool, has_height: bool) -> dict[str, float]:
    values: dict[str, float] = {}
    for value, letter in gps[:2]:
        if letter in ("N", "S", "E", "W"):
            name = "latitude_deg" if letter in "NS" else "longitude_deg"
            values[name] = -abs(value) if letter in "SW" else value
    if not values and len(gps) > 1:
        names = ("latitude_deg", "longitude_deg") if is_swapped else ("longitude_deg", "latitude_deg")
        values = {name: value for name, (value, _) in zip(names, gps, strict=False)}
    # A third number with a unit or decimals is a height, otherwise the number of satellites. 0.0 m means unknown.
    third, unit = gps[2] if len(gps) > 2 else (0.0, "")
    if third != 0 and (unit in ("M", ".") or (has_height and third > _SATELLITES)):
        values["bare_altitude_m"] = third
    return values


def _note_lacking(log: Log, lacking: dict[str, list[int]], last: int, count: int) -> None:
    """Note quantities that some subtitles lack but earlier ones have. last: line of the last of `count` subtitles."""
    together: dict[tuple[int, ...], list[str]] = {}
    for name, lines in lacking.items():
        together.setdefault(tuple(lines), []).append(name)
    for (first, *others), names in together.items():
        what = f"lacks {', '.join(sorted(names))}"
        if first == last:
            log.note(f"line {last}: the last subtitle {what}: the file is incomplete, and values are unknown there")
        else:
            also = f", as do {len(others)} more of {count}" if others else ""
            log.note(f"line {first}: the subtitle {what}{also}: values are unknown there")
