"""A frame as a line of JSON: targets, people and places. docs/stream.md has the table of fields."""

import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.io.streams.stream import About
from torchvision_dddas.io.tables import compass_deg
from torchvision_dddas.types import Adjustment, AerialLocations, FrameResult, TrackedFrame

_LATEST_UTC_S = 253_402_300_799.0  # the end of the year 9999: ISO 8601 has four digits for a year


def json_lines(
    result: FrameResult | None,
    people: TrackedFrame | None,
    about: About,
    age_s: float = math.nan,
    most_bytes: int = 0,
) -> list[bytes]:
    """The lines of a frame, ASCII and with their line ends: one, or one each where the two are of different frames.

    result, people: as in Stream.write. age_s: from the capture of the frame to now. most_bytes: a longer line is split
    into parts, each with some of the targets and people, its number `part` from 1 and their count `parts`; 0: never.
    A line of one target is never split. Numbers that are not finite are null.
    """
    apart = result is not None and people is not None and result.tracked.number != people.number
    frames = [(result, None), (None, people)] if apart else [(result, people)]
    lines = []
    for of, seen in frames:
        fields = _frame(of, seen, about, age_s)
        line = _encoded(fields)
        lines += [line] if not 0 < most_bytes < len(line) else _parts(fields, most_bytes)
    return lines


def _frame(result: FrameResult | None, people: TrackedFrame | None, about: About, age_s: float) -> dict[str, Any]:
    followed = result.tracked if result is not None else people
    assert followed is not None
    grounded = result.locations if result is not None else None
    time_s = math.nan
    if followed.frame is not None:
        time_s = followed.frame.time_s
    elif grounded is not None:
        time_s = grounded.time_s
    moved = (*followed.adjustments, *(grounded.adjustments if grounded is not None else ()))
    return {
        "frame": followed.number,
        "time_s": _number(time_s, 4),
        "utc": utc(about.start_utc_s + time_s),
        "age_s": _number(age_s, 4),
        "cause": followed.cause,
        "targets": None if result is None else _targets(result),
        "people": None if people is None else list(_boxes(people)),
        "ground": None if grounded is None else _ground(grounded, result, about),
        "adjustments": [_adjustment(adjustment) for adjustment in dict.fromkeys(moved)],
    }


def _targets(result: FrameResult) -> list[dict[str, Any]]:
    targets = list(_boxes(result.tracked))
    places = {} if result.locations is None else _places(result)
    for target in targets:
        target |= places.get(target["id"], {})
    return targets


def _boxes(followed: TrackedFrame) -> Iterator[dict[str, Any]]:
    """The boxes that have an identity, then those that have none."""
    tracks, found = followed.tracks, followed.detections
    tracked = zip(
        tracks.identity.tolist(), tracks.row.tolist(), tracks.box_px.tolist(), tracks.score.tolist(), strict=True
    )
    loose = ((None, row, found.box_px[row].tolist(), float(found.score[row])) for row in followed.untracked)
    for identity, row, box, score in [*tracked, *loose]:
        fields = {
            "id": identity,
            "kind": found.kind,
            "seen": row >= 0,
            "box_px": _numbers(box, 2),
            "score": _number(score, 4),
        }
        if row >= 0:
            fields["heading_deg"] = _number(_compass_deg(float(found.heading_rad[row])), 1)
            fields["speed_px_per_frame"] = _number(float(found.speed_px[row]), 3)
        yield fields


def _places(result: FrameResult) -> dict[int, dict[str, Any]]:
    """Places and confirmations of the targets, by identity."""
    grounded, confirmed = result.locations, result.confirmed
    assert grounded is not None
    at = grounded.positions
    places = {}
    for row, target in enumerate(at.target.tolist()):
        covariance = at.covariance_m2[row]
        fields: dict[str, Any] = {
            "east_north_m": _numbers(at.east_north_m[row].tolist(), 3),
            "covariance_m2": _numbers([covariance[0, 0], covariance[0, 1], covariance[1, 1]], 6),
            "velocity_m_s": _numbers(grounded.velocity_m_s[row].tolist(), 3),
        }
        if at.lonlat_deg is not None:
            fields["lonlat_deg"] = _numbers(at.lonlat_deg[row].tolist(), 9)
        places[target] = fields
    if confirmed is not None:
        for row, kind, probability in zip(
            confirmed.row.tolist(), confirmed.kind, confirmed.probability.tolist(), strict=True
        ):
            places[int(at.target[row])] |= {"confirmed": kind, "human": _number(probability, 4)}
    return places


def _ground(grounded: AerialLocations, result: FrameResult | None, about: About) -> dict[str, Any]:
    fix, marks = grounded.fix, grounded.marks
    degrees = result.mark_lonlat_deg if result is not None else None
    landmarks = []
    for row, landmark in enumerate(marks.landmark.tolist()):
        known = 0 <= landmark < len(about.landmarks)
        fields: dict[str, Any] = {
            "name": about.landmarks[landmark] if known else str(landmark),
            "image_px": _numbers(marks.image_px[row].tolist(), 2),
            "east_north_m": _numbers(marks.east_north_m[row].tolist(), 3),
        }
        if degrees is not None:
            fields["lonlat_deg"] = _numbers(degrees[row].tolist(), 9)
        landmarks.append(fields)
    return {
        "by": fix.by,
        "landmarks_used": sum(fix.is_used),
        "cause": fix.cause,
        "changes": list(fix.changes),
        "landmarks": landmarks,
    }


def _adjustment(moved: Adjustment) -> dict[str, Any]:
    return {
        "frame": moved.frame,
        "knob": moved.parameter,
        "old": _number(moved.old, 6),
        "new": _number(moved.new, 6),
        "cause": moved.cause,
    }


def utc(utc_s: float) -> str | None:
    """ISO 8601 to the millisecond; None where no such time is known."""
    return iso_utc(np.array([utc_s]))[0] if 0 <= utc_s < _LATEST_UTC_S else None


def _compass_deg(heading_rad: float) -> float:
    return compass_deg(heading_rad) if math.isfinite(heading_rad) else math.nan


def _number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None


def _numbers(values: Sequence[float], digits: int) -> list[float] | None:
    """None if any number is unknown."""
    return [round(float(v), digits) for v in values] if all(map(math.isfinite, values)) else None


def _encoded(fields: dict[str, Any]) -> bytes:
    # ASCII: special characters of names, also line ends, are escaped and cannot break a line.
    return (json.dumps(fields, separators=(",", ":"), allow_nan=False) + "\n").encode("ascii")


def _parts(fields: dict[str, Any], most_bytes: int) -> list[bytes]:
    """The same in several lines; fields of the whole frame are in the first."""
    first = {**fields, "part": 1, "parts": 1_000_000}
    rest = {name: fields[name] for name in ("frame", "time_s", "utc", "age_s", "cause")}
    rest |= {"part": 1_000_000, "parts": 1_000_000}
    lists = {name: fields[name] for name in ("targets", "people")}
    parts = [first | {name: None if rows is None else [] for name, rows in lists.items()}]
    room = most_bytes - len(_encoded(parts[0]))
    for name, rows in lists.items():
        for row in rows or ():
            size = len(json.dumps(row, separators=(",", ":"))) + 1
            if size > room and (parts[-1]["targets"] or parts[-1]["people"] or len(parts) == 1):
                parts.append({**rest, **{name: None if rows is None else [] for name, rows in lists.items()}})
                room = most_bytes - len(_encoded(parts[-1]))
            parts[-1][name].append(row)
            room -= size
    return [_encoded({**part, "part": k, "parts": len(parts)}) for k, part in enumerate(parts, 1)]
