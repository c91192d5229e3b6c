"""Events of targets that enter, leave or dwell in zones, or cross lines, on the ground or in fixed pictures."""

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.zone_files import make_zone, read_zones, zone_rings
from torchvision_dddas.types import FrameResult, Zone, ZoneEvent, most_common

Places = Sequence[Sequence[float]] | np.ndarray
_DRIFT_PX = 10.0  # largest drift of the summed registrations of a fixed camera
_FORGET_S = 60.0  # a target not seen for this long has gone
_SPEED_S = 1.0  # time span of the speed if no filter gives it
_SIGMAS = 4.0  # margin in standard deviations of the jitter
_APART_S = 0.5  # the jitter of places this far apart in time is independent
# Standard deviation of a place without a covariance; in the picture, as a share of the box's height.
_UNKNOWN_M, _BOX_SHARE = 1.0, 0.2
_FAR_M, _NEAR_M = 1e6, 1e5  # distances from the run of a zone with swapped coordinates, as given and swapped back
_MOST_SHARE = 0.25  # widest margin as a share of a zone's size


@dataclass(frozen=True)
class _Moment:
    """A target at a moment: its place at_m, at_px (2,) and velocity_m_s (2,); NaN if unknown.

    sigma: rough standard deviations of the place in metres and in pixels, used before its jitter is known.
    """

    frame: int
    time_s: float
    at_m: np.ndarray
    at_px: np.ndarray
    velocity_m_s: np.ndarray
    sigma: tuple[float, float]

    def until(self, later: "_Moment", share: float) -> "_Moment":
        """Return the moment at a share of the way to a later moment."""
        time_s = self.time_s + share * (later.time_s - self.time_s)
        at_m = self.at_m + share * (later.at_m - self.at_m)
        at_px = self.at_px + share * (later.at_px - self.at_px)
        return _Moment(later.frame, time_s, at_m, at_px, later.velocity_m_s, later.sigma)


@dataclass
class _Stay:
    """A target at a zone. first, last: its first and last moment. at: (2,) its last place. inside: None until clear.

    passed: when it last passed the border. distances: first time and number of its sightings on this side, and the sum
    of their distances. net: passages of the line to the right minus to the left since the target was last clear of it.
    """

    first: _Moment
    last: _Moment
    at: np.ndarray
    began_inside: bool
    inside: bool | None = None
    distances: tuple[float, int, float] = (0.0, 0, 0.0)
    passed: _Moment | None = None
    net: int = 0
    since_s: float = math.nan
    dwells: bool = False
    is_counted: bool = False

    def is_clear(self, time_s: float, distance: float) -> bool:
        """Return whether the target is clear of the border by its distance, or by the mean since the last passage."""
        begun_s, many, total = self.distances if self.distances[1] else (time_s, 0, 0.0)
        self.distances = begun_s, many + 1, total + distance
        mean, independent = (total + distance) / (many + 1), min(many, max(time_s - begun_s, 0) / _APART_S) + 1
        return distance > 1 or min(distance, mean) * math.sqrt(independent) > 1


@dataclass
class _ZoneTarget:
    """A target with its recent moments. jitter: jitter of its places on the ground and in the picture."""

    trail: deque[_Moment] = field(default_factory=deque)
    classes: Counter[tuple[str, int]] = field(default_factory=Counter)
    stays: dict[str, _Stay] = field(default_factory=dict)
    jitter: tuple[geometry.Jitter, geometry.Jitter] = field(
        default_factory=lambda: (geometry.Jitter(), geometry.Jitter())
    )


class Zones:
    """Find events of targets at zones: entering, leaving, dwelling, and crossing a line.

    >>> zones = td.Zones(polygons={"door": [[0, 0], [100, 0], [100, 80]]}, unit="px", dwell_s=5.0)
    >>> zones.notes
    []
    """

    def __init__(
        self,
        file: str | Path | None = None,
        *,
        polygons: Mapping[str, Places] | Sequence[Places] = (),
        lines: Mapping[str, Places] | Sequence[Places] = (),
        unit: str = "deg",
        dwell_s: float = 10.0,
    ) -> None:
        """file: GeoJSON or KML. polygons, lines: outlines and lines of places (N, 2), by name or as a list.

        unit: unit of the points, deg (longitude and latitude in WGS84), m (local metres of the run), or px.
        dwell_s: seconds inside after which a target dwells. Raise InputError as `read_zones` and `make_zone` do.
        """
        self.zones, self.notes = ([], []) if file is None else read_zones(file)
        for kind, given in (("zone", polygons), ("line", lines)):
            named = given if isinstance(given, Mapping) else {f"{kind} {k}": one for k, one in enumerate(given, 1)}
            self.zones += [make_zone(name, [one], kind == "line", unit, dwell_s) for name, one in named.items()]
        if len({zone.name for zone in self.zones}) < max(len(self.zones), 1):
            raise InputError("zones need at least one polygon or line, each with a unique name")
        self._targets: dict[int, _ZoneTarget] = {}
        self._origin: tuple[float, float] | None = None
        self._edges: dict[str, geometry.Edges] = {}
        self._widest: dict[str, float] = {}
        self._moved = np.eye(3)
        self._is_first, self._is_order_checked = True, False

    def check(self, is_located: bool, origin_deg: tuple[float, float] | None) -> None:
        """Raise InputError for zones on the ground if a run has no such places."""
        kinds = {zone.unit: zone.name for zone in self.zones}
        for unit in ("deg", "m") if not is_located else ():
            if unit in kinds:
                raise InputError(
                    f"{kinds[unit]} is on the ground, and this run locates nothing; give telemetry or landmarks, or "
                    'zones in pixels ("unit": "px")'
                )
        if "deg" in kinds and origin_deg is None:
            raise InputError(
                f"{kinds['deg']} is in degrees, and this run in local metres; give telemetry or landmarks in degrees, "
                'or zones in metres ("unit": "m")'
            )

    def mark(self, results: Iterable[FrameResult]) -> Iterator[FrameResult]:
        """Return the results with their events."""
        return (replace(result, events=(*result.events, *self.update(result))) for result in results)

    def update(self, result: FrameResult) -> list[ZoneEvent]:
        """Return the events that the result of the next frame settles, by zone.

        Raise InputError for zones on the ground if the results have no such places.
        """
        self._settle(result)
        moments = self._look(result)
        events: list[ZoneEvent] = []
        for zone in self.zones:
            in_px, edges = zone.unit == "px", self._edges[zone.name]
            points = {n: m.at_px * (1, -1) if in_px else m.at_m for n, m in moments.items()}
            targets = [number for number, point in points.items() if np.isfinite(point).all()]
            if not targets:
                continue
            at = np.array([points[number] for number in targets])
            inside = geometry.is_inside(at, edges) if not zone.is_line else np.zeros(len(at), bool)
            distance = np.hypot(*(geometry.nearest_on(at, edges) - at).T)
            for row, number in enumerate(targets):
                jitter = self._targets[number].jitter[in_px].sigma
                margin = moments[number].sigma[in_px] if math.isnan(jitter) else _SIGMAS * jitter
                share = float(distance[row]) / max(min(margin, self._widest[zone.name]), 1e-9)
                events += self._step(zone, number, moments[number], at[row], bool(inside[row]), share)
        return events

    def _step(
        self, zone: Zone, number: int, now: _Moment, at: np.ndarray, inside: bool, distance: float
    ) -> Iterator[ZoneEvent]:
        """Yield the events of a target at a zone in a frame. distance: from its place `at` to the zone, in margins."""
        target = self._targets[number]
        stay = target.stays.setdefault(zone.name, _Stay(now, now, at, inside))
        net, share = geometry.crossings(stay.at, at, self._edges[zone.name])
        if share == share:
            stay.passed, stay.net = stay.last.until(now, share), stay.net + net
            stay.distances = (0.0, 0, 0.0)
        stay.last, stay.at = now, at
        is_clear = stay.is_clear(now.time_s, distance)
        if is_clear and zone.is_line:
            if stay.net and stay.passed is not None:
                yield self._event("cross", zone, number, stay.passed, "to_right" if stay.net > 0 else "to_left")
            stay.net = 0
        elif is_clear and inside is not stay.inside:
            was_inside = stay.began_inside if stay.inside is None else stay.inside
            kind = "enter" if not was_inside else "present" if inside else "leave"
            passed = stay.passed if stay.passed and inside != was_inside else stay.first
            if inside or was_inside:
                stayed_s = math.nan if inside else passed.time_s - stay.since_s
                yield self._event(kind, zone, number, passed, inside_s=stayed_s)
            stay.inside, stay.since_s, stay.dwells = inside, passed.time_s, False
        if stay.inside and not stay.dwells and now.time_s - stay.since_s >= zone.dwell_s:
            stay.dwells = True
            yield self._event("dwell", zone, number, now, inside_s=now.time_s - stay.since_s)

    def _event(
        self, kind: str, zone: Zone, number: int, at: _Moment, direction: str = "", inside_s: float = math.nan
    ) -> ZoneEvent:
        target = self._targets[number]
        stay, (label, class_id) = target.stays[zone.name], most_common(target.classes)
        is_first, stay.is_counted = not stay.is_counted, True
        first, last = target.trail[0], target.trail[-1]
        lapse = last.time_s - first.time_s or math.nan
        speed_m_s = float(np.hypot(*at.velocity_m_s))
        if math.isnan(speed_m_s):
            speed_m_s = float(np.hypot(*(last.at_m - first.at_m))) / lapse
        speed_px_s = float(np.hypot(*(last.at_px - first.at_px))) / lapse if zone.unit == "px" else math.nan
        degrees = np.full(2, np.nan)
        if self._origin is not None:
            degrees = geometry.lonlat(at.at_m[None], self._origin)[0]
        return ZoneEvent(
            *(kind, zone.name, number, at.frame, at.time_s, label, class_id, is_first, direction, inside_s),
            *(speed_m_s, speed_px_s, at.at_m, degrees, at.at_px),
        )

    def _look(self, result: FrameResult) -> dict[int, _Moment]:
        """Return the targets that were seen in a frame."""
        tracks, located, time_s = result.tracks, result.locations, result.time_s
        moments: dict[int, _Moment] = {}
        if not math.isfinite(time_s):
            return moments
        feet = tracks.foot_px
        rows = {} if located is None else {n: k for k, n in enumerate(located.positions.target.tolist())}
        for k in np.flatnonzero(tracks.row >= 0).tolist():
            number, sigma_m = int(tracks.identity[k]), _UNKNOWN_M
            at_m = velocity = np.full(2, np.nan)
            if located is not None and (row := rows.get(number)) is not None:
                at_m, velocity = located.positions.east_north_m[row], located.velocity_m_s[row]
                if np.isfinite(located.relative_m2[row]).all():
                    sigma_m = math.sqrt(np.trace(located.relative_m2[row]) / 2)
            sigma = sigma_m, _BOX_SHARE * float(tracks.box_px[k, 3])
            moments[number] = now = _Moment(result.number, time_s, at_m, feet[k], velocity, sigma)
            target = self._targets.setdefault(number, _ZoneTarget())
            target.classes[str(tracks.label[k] or ""), int(tracks.class_id[k])] += 1
            for jitter, at in zip(target.jitter, (now.at_m, now.at_px), strict=True):
                if np.isfinite(at).all():
                    jitter.add(time_s, at)
            target.trail.append(now)
            while len(target.trail) > 2 and now.time_s - target.trail[1].time_s >= _SPEED_S:
                target.trail.popleft()
        self._targets = {n: t for n, t in self._targets.items() if time_s - t.trail[-1].time_s <= _FORGET_S}
        return moments

    def _settle(self, result: FrameResult) -> None:
        """Convert the zones to the plane of the results, again if the origin changes."""
        located = result.locations
        origin = None if located is None else located.positions.origin_deg
        if not self._edges or origin != self._origin:
            self.check(located is not None, origin)
            for zone in self.zones:
                self._place(zone, origin)
            if origin is not None and not self._is_order_checked:
                self._check_order(origin)
            self._origin, self._targets = origin, {}
        if self._is_first and result.frame is not None:
            self._is_first = False
            high, wide = result.frame.image.shape[:2]
            for zone in self.zones:
                low, top = (end(np.concatenate(zone.rings), axis=0) for end in (np.min, np.max))
                if zone.unit == "px" and ((top < 0) | (low > (wide - 1, high - 1))).any():
                    self.notes.append(
                        f"{zone.name} lies outside the pictures of {wide}x{high} px: no target can be seen there"
                    )
        self._check_camera(result.tracked.now_from_before)

    def _place(self, zone: Zone, origin: tuple[float, float] | None) -> None:
        rings = zone_rings(zone, origin)
        self._edges[zone.name] = geometry.edges_of(rings, not zone.is_line)
        sizes = []
        for ring in rings:
            start, end = geometry.edges_of([ring], not zone.is_line)
            length = float(np.hypot(*(end - start).T).sum())
            # Twice the area over the border's length is the radius of a disc, or half the side of a square.
            sizes.append(length if zone.is_line else 2 * geometry.area_of(ring) / max(length, 1e-9))
        self._widest[zone.name] = _MOST_SHARE * min(sizes)

    def _check_order(self, origin: tuple[float, float]) -> None:
        """Note the first zone that lies far from the run, but near to it with latitude and longitude swapped."""
        self._is_order_checked = True
        for zone in self.zones:
            middle = np.concatenate(zone.rings).mean(axis=0)
            if zone.unit != "deg" or abs(middle[0]) > 90:
                continue
            given_m, swapped_m = geometry.great_circle_m(np.array([middle, middle[::-1]]), np.array(origin)).tolist()
            if given_m > _FAR_M and swapped_m < _NEAR_M:
                self.notes.append(
                    f"{zone.name} lies {given_m / 1000:.0f} km from the run, and {swapped_m / 1000:.1f} km with "
                    "latitude and longitude swapped: write the longitude first"
                )
                return

    def _check_camera(self, motion: np.ndarray | None) -> None:
        """Note once how far a camera with zones in pixels has moved, if the distance matters."""
        in_px = [zone for zone in self.zones if zone.unit == "px"]
        if motion is None or not in_px or not np.isfinite(self._moved).all():
            return
        self._moved = motion @ self._moved
        for zone in in_px:
            middle = np.concatenate(zone.rings).mean(axis=0)
            shift = float(np.hypot(*(geometry.transfer(self._moved, middle[None])[0] - middle)))
            if shift > max(self._widest[zone.name], _DRIFT_PX):
                self.notes.append(
                    f"the camera moves: {zone.name} is {shift:.0f} px off the ground that it showed at first. Zones in "
                    "pixels are for a fixed camera; give zones on the ground with telemetry or landmarks"
                )
                self._moved = np.full((3, 3), np.nan)
                return
