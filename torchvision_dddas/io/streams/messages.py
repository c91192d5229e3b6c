"""Encode a frame as messages: a line of JSON (docs/stream.md lists its fields), MOTChallenge text, Cursor-on-Target."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from torchvision_dddas.geometry import GEOID_SIGMA_M, lonlat
from torchvision_dddas.io.maps.formats import MARK_STALE_S, STALE_S, event, event_uid, mark, own_event
from torchvision_dddas.io.maps.ground_tracks import iso_utc, semi_axes
from torchvision_dddas.io.output.tables import track_rows
from torchvision_dddas.io.output.zone_events import event_fields
from torchvision_dddas.io.tables import MOT_TRACKS, compass_deg
from torchvision_dddas.types import (
    AerialLocations,
    AppearanceUse,
    Camera,
    FrameResult,
    FusedTargets,
    TrackedFrame,
    Tracks,
)

PEOPLE_FROM = 1_000_000
"""Added to the identities of people, which are separate from those of targets: MOT text has no column for a kind."""

EVERY_S = 1.0
"""Seconds between two messages on a target."""

_FARTHEST_PX = 1e7
_STEEP_RAD = math.radians(80.0)  # a camera that looks lower below the horizon looks straight down
_LATEST_UTC_S = 253_402_300_799.0  # the end of the year 9999: ISO 8601 has four digits for a year


@dataclass
class About:
    """Facts of the run that messages need.

    start_utc_s: seconds since 1970 at time_s = 0, NaN without a known clock. A live run sets it at its first
    picture, and again when the machine's clock is set. geographic: whether targets get longitudes and latitudes.
    landmarks: their names. camera: the camera in the air. plane_above_ellipsoid_m, plane_above_sea_m: height of the
    local plane, up = 0.
    """

    start_utc_s: float = float("nan")
    geographic: bool = False
    landmarks: tuple[str, ...] = ()
    camera: Camera | None = None
    plane_above_ellipsoid_m: float = float("nan")
    plane_above_sea_m: float = float("nan")

    @property
    def source(self) -> str:
        """The camera's name; empty if no camera file gives one."""
        return "" if self.camera is None or self.camera.given == frozenset() else self.camera.name

    def utc(self, time_s: float) -> str | None:
        """Return ISO 8601 to the millisecond; None if the time is unknown."""
        utc_s = self.start_utc_s + time_s
        return iso_utc(np.array([utc_s]))[0] if 0 <= utc_s < _LATEST_UTC_S else None


def json_lines(
    about: About,
    result: FrameResult | None,
    people: TrackedFrame | None,
    age_s: float = math.nan,
    most_bytes: int = 0,
) -> list[bytes]:
    """Return the lines of a frame, ASCII with line ends: one line, or two if result and people are of different frames.

    result, people: as in Stream.write. age_s: time since the capture of the frame. most_bytes: limit of a
    line, 0 for none. A longer line is split into parts. Each part has some of the targets and people, its number
    `part`, from 1, and the count `parts`. A line of one target is never split. Numbers that are not finite are null.
    """
    apart = result is not None and people is not None and result.tracked.number != people.number
    lines = []
    for targets, persons in [(result, None), (None, people)] if apart else [(result, people)]:
        fields = _frame(about, targets, persons, age_s)
        line = _encode(fields)
        lines += [line] if not 0 < most_bytes < len(line) else _split(fields, most_bytes)
    return lines


def _frame(about: About, result: FrameResult | None, people: TrackedFrame | None, age_s: float) -> dict[str, Any]:
    tracked = result.tracked if result is not None else people
    assert tracked is not None
    located = result.locations if result is not None else None
    time_s = math.nan
    if tracked.frame is not None:
        time_s = tracked.frame.time_s
    elif located is not None:
        time_s = located.time_s
    adjustments = (*tracked.adjustments, *(located.adjustments if located is not None else ()))
    events = () if result is None else result.events
    return {
        "frame": tracked.number,
        "time_s": _number(time_s, 4),
        "utc": about.utc(time_s),
        "age_s": _number(age_s, 4),
        "cause": tracked.cause,
        "targets": None if result is None else _targets(result),
        "people": None if people is None else list(_boxes(people)),
        "ground": None if result is None else _ground(result, about),
        "appearance": None if result is None else _appearance(result.tracks.appearance),
        "adjustments": [
            {
                "frame": one.frame,
                "knob": one.parameter,
                "old": _number(one.old, 6),
                "new": _number(one.new, 6),
                "cause": one.cause,
            }
            for one in dict.fromkeys(adjustments)
        ],
        **({} if result is None else _correction(result.tracks)),
        **({} if result is None or result.fused is None else {"fused": _fused(result.fused)}),
        **({"events": [event_fields(event, about.start_utc_s) for event in events]} if events else {}),
    }


def _correction(tracks: Tracks) -> dict[str, Any]:
    """Return the mark of provisional tracks, or the provisional identities that settled tracks correct."""
    if tracks.provisional:
        return {"provisional": True}
    return {"corrects": list(tracks.corrects)} if tracks.corrects else {}


def _boxes(tracked: TrackedFrame) -> Iterator[dict[str, Any]]:
    """Yield the boxes that have an identity, then those without."""
    tracks, found = tracked.tracks, tracked.detections
    columns = (tracks.identity, tracks.row, tracks.box_px, tracks.score, tracks.link, tracks.label)
    identified = zip(*(column.tolist() for column in columns), strict=True)
    loose = (
        (None, row, found.box_px[row].tolist(), float(found.score[row]), math.nan, found.label[row])
        for row in tracked.untracked
    )
    for identity, row, box, score, link, label in [*identified, *loose]:
        fields = {
            "id": identity,
            "kind": found.kind,
            "seen": row >= 0,
            "box_px": _numbers(box, 2),
            "score": _number(score, 4),
            "link": _number(link, 3),
        }
        if label:
            fields["class"] = label
        if row >= 0:
            heading = float(found.heading_rad[row])
            fields["heading_deg"] = _number(compass_deg(heading) if math.isfinite(heading) else math.nan, 1)
            fields["speed_px_per_frame"] = _number(float(found.speed_px[row]), 3)
        yield fields


def _targets(result: FrameResult) -> list[dict[str, Any]]:
    """Return the boxes with their places and confirmations."""
    places: dict[int, dict[str, Any]] = {}
    if (located := result.locations) is not None:
        at = located.positions
        for row, target in enumerate(at.target.tolist()):
            covariance = at.covariance_m2[row]
            places[target] = {
                "east_north_m": _numbers(at.east_north_m[row], 3),
                "covariance_m2": _numbers([covariance[0, 0], covariance[0, 1], covariance[1, 1]], 6),
                "velocity_m_s": _numbers(located.velocity_m_s[row], 3),
            }
            if at.lonlat_deg is not None:
                places[target]["lonlat_deg"] = _numbers(at.lonlat_deg[row], 9)
        if (confirmed := result.confirmed) is not None:
            for row, kind, human in zip(confirmed.row.tolist(), confirmed.kind, confirmed.probability, strict=True):
                places[int(at.target[row])] |= {"confirmed": kind, "human": _number(human, 4)}
    return [fields | places.get(fields["id"], {}) for fields in _boxes(result.tracked)]


def _fused(fused: FusedTargets) -> dict[str, Any]:
    """Return the targets as fused over all platforms, at an earlier time."""
    degrees = None if fused.origin_deg is None else lonlat(fused.state[:, :2], fused.origin_deg)
    rows = []
    for row, target in enumerate(fused.target.tolist()):
        at, spread = fused.state[row], fused.covariance[row]
        fields = {
            "id": target,
            "east_north_m": _numbers(at[:2], 3),
            "covariance_m2": _numbers([spread[0, 0], spread[0, 1], spread[1, 1]], 6),
            "velocity_m_s": _numbers(at[2:], 3),
            "seen_by": fused.seen_by[row],
        }
        rows.append(fields if degrees is None else {**fields, "lonlat_deg": _numbers(degrees[row], 9)})
    return {"frame": fused.frame, "time_s": _number(fused.time_s, 4), "targets": rows}


def _ground(result: FrameResult, about: About) -> dict[str, Any] | None:
    if result.locations is None:
        return None
    fix, marks, degrees = result.locations.fix, result.locations.marks, result.mark_lonlat_deg
    landmarks = []
    for row, landmark in enumerate(marks.landmark.tolist()):
        is_named = 0 <= landmark < len(about.landmarks)
        fields: dict[str, Any] = {
            "name": about.landmarks[landmark] if is_named else str(landmark),
            "image_px": _numbers(marks.image_px[row], 2),
            "east_north_m": _numbers(marks.east_north_m[row], 3),
        }
        if degrees is not None:
            fields["lonlat_deg"] = _numbers(degrees[row], 9)
        landmarks.append(fields)
    return {
        "by": fix.by,
        "landmarks_used": sum(fix.is_used),
        "cause": fix.cause,
        "changes": list(fix.changes),
        "landmarks": landmarks,
    }


def _appearance(use: AppearanceUse | None) -> dict[str, Any] | None:
    if use is None:
        return None
    return {name: _number(value, 4) if isinstance(value, float) else value for name, value in asdict(use).items()}


def _number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None


def _numbers(values: Sequence[float] | np.ndarray, digits: int) -> list[float] | None:
    """None if any number is unknown."""
    return [round(float(v), digits) for v in values] if all(map(math.isfinite, values)) else None


def _encode(fields: dict[str, Any]) -> bytes:
    # ASCII: special characters of names, including line ends, are escaped and cannot break a line.
    return (json.dumps(fields, separators=(",", ":"), allow_nan=False) + "\n").encode("ascii")


def _split(fields: dict[str, Any], most_bytes: int) -> list[bytes]:
    """Return the fields in several lines; fields of the whole frame are in the first."""
    lists = {name: fields[name] for name in ("targets", "people")}
    common = ("frame", "time_s", "utc", "age_s", "cause", "provisional")
    rest = {name: fields[name] for name in common if name in fields}

    def empty() -> dict[str, Any]:
        return {name: None if rows is None else [] for name, rows in lists.items()} | {"part": 10**6, "parts": 10**6}

    parts = [fields | empty()]
    room = most_bytes - len(_encode(parts[0]))
    for name, rows in lists.items():
        for row in rows or ():
            size = len(_encode(row))
            if size > room and (parts[-1]["targets"] or parts[-1]["people"] or len(parts) == 1):
                parts.append(rest | empty())
                room = most_bytes - len(_encode(parts[-1]))
            parts[-1][name].append(row)
            room -= size
    return [_encode(part | {"part": k, "parts": len(parts)}) for k, part in enumerate(parts, 1)]


def mot_lines(
    result: FrameResult | None, people: TrackedFrame | None, age_s: float = math.nan, most_bytes: int = 0
) -> list[bytes]:
    """Return `frame,identity,x,y,width,height,score,-1,-1,-1`, a line a box with an identity: targets, then people.

    One message per frame, or several of whole lines if it is longer than most_bytes. Infinite boxes are left out, and
    so are provisional tracks, which the text cannot mark.
    """
    text = ""
    result = None if result is not None and result.tracks.provisional else result
    for tracked, first in ((None if result is None else result.tracked, 0), (people, PEOPLE_FROM)):
        if tracked is not None:
            tracks = tracked.tracks
            shown = tracks[np.isfinite(tracks.score) & (np.abs(tracks.box_px) < _FARTHEST_PX).all(axis=1)]
            shown = replace(shown, identity=shown.identity + first)
            text += MOT_TRACKS.format_rows(track_rows(replace(tracked, tracks=shown)))
    messages = [b""]
    for line in text.encode("ascii").splitlines(keepends=True):
        if messages[-1] and 0 < most_bytes < len(messages[-1]) + len(line):
            messages.append(b"")
        messages[-1] += line
    return [message for message in messages if message]


class CotEvents:
    """Cursor-on-Target events of frames, given in order: at most one per second of each target and of the camera."""

    def __init__(self, about: About) -> None:
        self._about = about
        self._sent_s: dict[int, float] = {}
        self._marks = 0
        self._begun_utc_s: float | None = None  # stays when the clock is set, so that targets keep their uid
        self._own: tuple[float, np.ndarray] = -math.inf, np.full(2, np.nan)  # time and place of its last event

    def __call__(
        self, result: FrameResult | None, people: TrackedFrame | None = None, age_s: float = 0.0, most_bytes: int = 0
    ) -> list[bytes]:
        """Return the events of a frame, one message with a line end each; none without longitude and latitude."""
        located = None if result is None else result.locations
        degrees = None if located is None else located.positions.lonlat_deg
        if located is None or degrees is None or self._about.utc(located.time_s) is None:
            return []
        if self._begun_utc_s is None:
            self._begun_utc_s = self._about.start_utc_s
        at, now_s = located.positions, located.time_s
        # Forget targets sent a second ago, all where time went back. Rounded time stamps must not skip an event.
        self._sent_s = {target: sent for target, sent in self._sent_s.items() if 0 <= now_s - sent < EVERY_S - 1e-6}
        axes, _ = semi_axes(at.covariance_m2, chi2=1.0)
        time, stale = iso_utc(self._about.start_utc_s + np.array([now_s, now_s + STALE_S]))
        now, source = (time, stale), self._about.source
        messages = self._own_events(located, now)
        for row, target in enumerate(at.target.tolist()):
            longitude, latitude = degrees[row].tolist()
            if target in self._sent_s or not (abs(longitude) <= 180 and abs(latitude) <= 90):
                continue
            self._sent_s[target] = now_s
            sigma_m, velocity = axes[row], located.velocity_m_s[row]
            spread = located.velocity_covariance[row] if len(located.velocity_covariance) else None
            place = longitude, latitude, float(at.above_ellipsoid_m[row])
            messages.append(event(self._uid(target), target, now, place, sigma_m, velocity, spread, source).encode())
        for one in result.events if result is not None else ():
            if np.isfinite(one.lonlat_deg).all():
                self._marks += 1
                uid = f"{self._uid(one.target)}-{self._marks}"
                when = iso_utc(self._about.start_utc_s + np.array([one.time_s, one.time_s + MARK_STALE_S]))
                where = one.lonlat_deg[0], one.lonlat_deg[1]
                messages.append(mark(uid, one.describe(), (when[0], when[1]), where).encode())
        return messages

    def _uid(self, target: int | str) -> str:
        source = f"dddas-{self._about.source}".rstrip("-")
        return event_uid(source, self._begun_utc_s or 0.0, target)

    def _own_events(self, located: AerialLocations, when: tuple[str, str]) -> list[bytes]:
        """Return the camera's own event, at most once per second; no event if its pose is unknown."""
        fix, camera, origin, now_s = located.fix, self._about.camera, located.positions.origin_deg, located.time_s
        before_s, before_m = self._own
        lapse_s = now_s - before_s
        if fix.pose is None or camera is None or origin is None or 0 <= lapse_s < EVERY_S - 1e-6:
            return []
        place_m, (heading, pitch, roll) = fix.pose.place_m, fix.pose.angles_rad
        (longitude, latitude), up_m = lonlat(place_m[None, :2], origin)[0].tolist(), float(place_m[2])
        if not (abs(longitude) <= 180 and abs(latitude) <= 90):
            return []
        self._own = now_s, place_m[:2]
        sigma_m, height_sigma_m = math.nan, math.nan
        if fix.covariance is not None:
            sigma_m = float(semi_axes(fix.covariance[None, 3:5, 3:5], chi2=1.0)[0][0, 0])
            height_sigma_m = math.hypot(math.sqrt(max(float(fix.covariance[5, 5]), 0.0)), GEOID_SIGMA_M)
        moved_m = place_m[:2] - before_m
        # The errors of two places differ, so a short way gives no course.
        is_course_known = 0 < lapse_s < STALE_S and math.hypot(*moved_m) > 2 * sigma_m
        velocity = moved_m / lapse_s if is_course_known else np.full(2, np.nan)
        half_px, focal_px = np.array(camera.size_px) / 2, np.array(camera.focal_px) * fix.pose.focal
        view_rad = 2 * np.arctan(half_px / focal_px)
        range_m = up_m / math.sin(pitch) if up_m > 0 and math.sin(pitch) > 0.01 else math.nan
        where = longitude, latitude, self._about.plane_above_ellipsoid_m + up_m
        if pitch > _STEEP_RAD:  # the heading of the optical axis is noise, so take that of the picture's upper edge
            upper = -fix.pose.axes[:, 1]
            heading, roll = math.atan2(upper[0], upper[1]), 0.0
        name = self._about.source or "dddas"
        sigmas = sigma_m, height_sigma_m if math.isfinite(where[2]) else math.nan
        angles, view = (heading, pitch, roll), (float(view_rad[0]), float(view_rad[1]))
        return [own_event(self._uid("camera"), name, when, where, sigmas, angles, view, range_m, velocity).encode()]
