"""DJI's subtitle files in any dialect: positions, heights and attitudes as keys and values in text."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from torchvision_dddas.io.telemetry.log import Log, assemble
from torchvision_dddas.io.telemetry.quantities import dated, hfov_of_focal, quantity_of, understood
from torchvision_dddas.types import Telemetry

_TIMING = re.compile(r"(\d{1,6}):(\d{1,2}):(\d{1,2})[.,](\d{1,3})\s*-+>")
_MARKUP = re.compile(r"<[^>]*>")
_NUMBER = r"[-+]?\d+(?:[.,]\d+)?"
_TUPLE = re.compile(r"([A-Za-z][A-Za-z.]*)\s*:?\s*\(([^)]*)\)?")
_PAIR = re.compile(
    rf"([A-Za-z][A-Za-z_.]*)\s*[:=]?\s*({_NUMBER})(?![\d:.])\s*(m/s|km/h|kmh|mph|ft|cm|mm|m|°)?(?![A-Za-z])",
    re.IGNORECASE,
)
_OPTICS = ("focal_len", "fnum", "dzoom_ratio")
_AXES = {"g.pry": ("gimbalpitch", "gimbalroll", "gimbalyaw"), "f.pry": ("", "", "yaw")}


@dataclass
class Subtitle:
    """A subtitle. line: its first line in the file. time_s: NaN without a timing. lines: its text."""

    line: int
    time_s: float = math.nan
    lines: list[str] = field(default_factory=list)

    @cached_property
    def text(self) -> str:
        """The text without markup."""
        text = "\n".join(self.lines)
        return _MARKUP.sub(" ", text) if "<" in text else text


def read_subtitles(path: Path, text: str, clock_offset_s: float) -> Telemetry:
    """Raises InputError without any position, height or attitude, or if times decrease."""
    log = Log(path, "DJI subtitles", bridge_s=2.0)
    subtitles = list(_subtitles(text))
    parts = [_tuples(subtitle.text) for subtitle in subtitles]
    swapped = _latitude_first(log, [t["gps"] for t in parts if "gps" in t], [t["home"] for t in parts if "home" in t])
    dates = [dated(subtitle.text) for subtitle in subtitles]
    first = next((date[0] for date in dates if date), math.nan)
    lacking: dict[str, list[int]] = {}
    known: set[str] = set()
    for subtitle, tuples, date in zip(subtitles, parts, dates, strict=True):
        time_s = subtitle.time_s if math.isfinite(subtitle.time_s) else (date[0] - first if date else math.nan)
        if math.isnan(time_s):
            log.note(f"line {subtitle.line}: a subtitle without time is left out")
            continue
        said = _quantities(log, subtitle.text, tuples, swapped)
        log.moments.append((time_s, subtitle.line))
        for quantity, value in said.items():
            log.add(quantity, time_s, value, subtitle.line)
        for name in known - set(said):
            lacking.setdefault(name, []).append(subtitle.line)
            log.add(name, time_s, math.nan, subtitle.line)
        known |= set(said)
    _note_lacking(log, lacking, subtitles)
    zoned = next((date for date in dates if date), (math.nan, False))
    if not zoned[1] and math.isfinite(zoned[0]):
        log.note("the dates are in an unknown time zone, so the clock is not known")
    start = zoned[0] - log.moments[0][0] if zoned[1] and log.moments else math.nan
    return assemble(log, clock_offset_s, start)


def _subtitles(text: str) -> Iterator[Subtitle]:
    """Blocks that begin with a timing; in a file without timings, blocks between blank lines."""
    lines = text.splitlines()
    timed = any(_TIMING.match(line.strip()) for line in lines)
    now: Subtitle | None = None
    for number, line in enumerate(lines, 1):
        bare = line.strip()
        timing = _TIMING.match(bare) if ">" in bare else None
        if timing:
            if now is not None:
                yield now
            hours, minutes, seconds, fraction = timing.groups()
            now = Subtitle(number, int(hours) * 3600 + int(minutes) * 60 + int(seconds) + float(f"0.{fraction}"))
        elif bare.isdigit() or (not timed and not bare):
            if now is not None and not timed:
                yield now
                now = None
        elif bare:
            if now is None and not timed:
                now = Subtitle(number)
            if now is not None:
                now.lines.append(bare)
    if now is not None:
        yield now


def _tuples(text: str) -> dict[str, list[tuple[float, str]]]:
    """Numbers in brackets by the name before them, each with the letters beside it."""
    found: dict[str, list[tuple[float, str]]] = {}
    if "(" not in text:
        return found
    for name, inside in _TUPLE.findall(text):
        cells = re.split(r"[;,]\s+|;", inside) if re.search(r"[;,]\s|;", inside) else inside.split(",")
        if "." not in inside and len(cells) >= 4 and "," in inside and len(cells) == inside.count(",") + 1:
            cells = [",".join(cells[i : i + 2]) for i in range(0, len(cells), 2)]  # decimal commas
        numbers = []
        for cell in cells:
            match = re.search(_NUMBER, cell)
            value = float(match[0].replace(",", ".")) if match else math.nan
            numbers.append((value, re.sub(rf"{_NUMBER}|[\s:°]", "", cell, count=0).upper()))
        found["gps" if name.lower() == "rtk" else name.lower()] = numbers
    return found


def _latitude_first(log: Log, gps: list[list[tuple[float, str]]], home: list[list[tuple[float, str]]]) -> bool:
    """Whether GPS(...) has the latitude first: by values beyond 90 degrees, else by dialect.

    DJI writes longitude, latitude and the number of satellites; if the third is in metres, latitude comes first.
    """
    pairs = np.array([[a[0][0], a[1][0]] for a in gps + home if len(a) > 1 and not a[0][1] and not a[1][1]])
    if not len(pairs):
        return False
    first, second = (np.abs(pairs[:, i]) > 90 for i in (0, 1))
    if first.any() or second.any():
        return bool(second.any() and not first.any())
    metres = any(len(a) > 2 and a[2][1] == "M" for a in gps)
    log.note(
        f"GPS(...) is taken as {'latitude, longitude' if metres else 'longitude, latitude'}, as this dialect has it: "
        "the numbers would fit either order"
    )
    return metres


def _quantities(log: Log, text: str, tuples: dict[str, list[tuple[float, str]]], swapped: bool) -> dict[str, float]:
    """Values of one subtitle by quantity."""
    said: dict[str, float] = {}
    if gps := tuples.get("gps"):
        said |= _place(gps, swapped)
    for name, keys in _AXES.items():
        for key, (value, _) in zip(keys, tuples.get(name, ()), strict=False):
            if found := understood(key, value):
                said[found[0]] = found[1]
    plain: dict[str, str] = {}
    for key, number, unit in _PAIR.findall(_TUPLE.sub(" ", text) if tuples else text):
        if key in _OPTICS:
            plain[key] = number
        if quantity_of(key) is None:
            continue
        if key.lower() == "h" and not unit:  # only with a unit the letter means the height
            continue
        if (found := understood(key, float(number.replace(",", ".")), unit)) and found[0] not in said:
            said[found[0]] = found[1]
            if key.lower() in ("altitude", "alt"):
                log.note("the file does not say where the altitude is zero; above the sea is assumed")
    if "focal_len" in plain:
        other = [float(plain[k].replace(",", ".")) if k in plain else math.nan for k in ("fnum", "dzoom_ratio")]
        if (hfov := hfov_of_focal(plain["focal_len"], *other)) is not None:
            said["hfov_rad"] = hfov
            log.note("the field of view is that of a focal length for a picture 36 mm wide")
    if said.get("longitude_deg") == said.get("latitude_deg") == said.get("above_sea_m") == 0.0:
        said["above_sea_m"] = math.nan  # no fix
    return said


def _place(gps: list[tuple[float, str]], swapped: bool) -> dict[str, float]:
    said: dict[str, float] = {}
    for value, letter in gps[:2]:
        if letter in ("N", "S", "E", "W"):
            name = "latitude_deg" if letter in "NS" else "longitude_deg"
            said[name] = -abs(value) if letter in "SW" and value > 0 else value
    if not said and len(gps) > 1:
        names = ("latitude_deg", "longitude_deg") if swapped else ("longitude_deg", "latitude_deg")
        said = {name: value for name, (value, _) in zip(names, gps, strict=False)}
    # A third number with a unit is a height, without one the number of satellites; 0.0 m stands for none.
    if len(gps) > 2 and gps[2][1] == "M" and gps[2][0] != 0:
        said["above_sea_m"] = gps[2][0]
    return said


def _note_lacking(log: Log, lacking: dict[str, list[int]], subtitles: list[Subtitle]) -> None:
    """Note quantities that some subtitles lack and earlier ones have."""
    together: dict[tuple[int, ...], list[str]] = {}
    for name, lines in lacking.items():
        together.setdefault(tuple(lines), []).append(name)
    for at_lines, names in together.items():
        what = ", ".join(sorted(names))
        if at_lines == (subtitles[-1].line,):
            log.note(f"line {at_lines[0]}: the last subtitle lacks {what}: the file is incomplete; unknown there")
        elif len(at_lines) == 1:
            log.note(f"line {at_lines[0]}: the subtitle lacks {what}; unknown there")
        else:
            log.note(
                f"line {at_lines[0]}: the subtitle lacks {what}, as do {len(at_lines) - 1} more of {len(subtitles)}; "
                "unknown there"
            )
