"""The operator's view of a live run: the annotated picture, the map and the list of targets.

The run hands over references and does not wait. Pictures are drawn and encoded in the threads of the server, and only
while somebody watches.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.geometry import circular_error_90, error_category
from torchvision_dddas.io.maps.ground_tracks import ring_m, semi_axes
from torchvision_dddas.io.maps.map_picture import view_of
from torchvision_dddas.io.output import MapSite
from torchvision_dddas.io.overlay import (
    PERSON,
    TRAIL_LENGTH,
    RunPictures,
    identity_colour,
    label,
    line_width,
    rectangle,
)
from torchvision_dddas.io.streams import About
from torchvision_dddas.io.zone_files import zone_rings
from torchvision_dddas.live.team import give_way
from torchvision_dddas.types import Frame, FrameResult, TrackedFrame, Zone, is_sampled

MOST_WATCHERS = 4
"""Pictures are sent to at most so many clients at a time."""
MOST_TARGETS = 100
"""Targets on the page; it tells how many there are beyond."""

_BOUNDARY = b"--picture\r\n"
PICTURES = "multipart/x-mixed-replace; boundary=picture"
"""The content type of `OperatorView.pictures`."""
_LONGEST_PX, _QUALITY = 960, 70  # longest side and JPEG quality of the encoded picture
_APART_S = 0.125  # least time between two pictures
_MOST_WAITING = 16  # pictures that wait for their results
_IDLE_S = 0.5  # without a new picture, clients are checked this often
_WAY_APART_S, _WAY_PLACES = 1.0, 60  # the map shows one place of each track per second, for a minute
_KINDS = {"moving": "mover", "given": "target"}


class OperatorView:
    """The newest result of a run for the page, and a stream of annotated pictures.

    The run calls `take` and `show`. Threads of the server call the rest. session: distinguishes this run from
    others on the same port.
    """

    def __init__(self, report: Callable[[str], object] = lambda words: None) -> None:
        """report: is called once if pictures cannot be drawn."""
        self.session = str(time.time_ns())
        self._report, self._has_failed = report, False
        self._changed, self._encoding = threading.Condition(), threading.Lock()
        self._interval, self._closed, self._watchers = 1, False, 0
        self._site: MapSite | None = None
        self._zones: Sequence[Zone] = ()
        self._about = About()
        self._images: dict[int, np.ndarray] = {}  # by frame number, until the result comes
        self._due_s = self._way_due_s = -math.inf
        self._newest: tuple[FrameResult, TrackedFrame | None] | None = None
        self._recent = deque[FrameResult](maxlen=TRAIL_LENGTH)
        self._ways: dict[int, deque[tuple[float, float, float]]] = {}  # monotonic time, east, north
        self._drawable: tuple[tuple[FrameResult, ...], TrackedFrame | None, np.ndarray] | None = None
        self._encoded: tuple[object, bytes] = None, b""

    def begin(self, interval: int, about: About, site: MapSite | None, zones: Sequence[Zone]) -> None:
        """Prepare for the results of a run. site: None if nothing is located."""
        self._interval, self._about, self._site, self._zones = interval, about, site, zones

    def close(self) -> None:
        """End the streams of pictures."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def take(self, frame: Frame) -> None:
        """Keep the picture of a frame until its result comes, if somebody watches and the rate allows it."""
        now_s = time.monotonic()
        if not self._watchers or now_s < self._due_s or not is_sampled(frame.number, self._interval):
            return
        if len(self._images) < _MOST_WAITING:
            self._due_s = _APART_S + (self._due_s if now_s - self._due_s < _APART_S else now_s)
            self._images[frame.number] = frame.image

    def show(self, result: FrameResult, people: TrackedFrame | None) -> None:
        """Show a result as the newest one."""
        self._recent.append(result)
        image = self._images.get(result.number)
        if self._images:
            self._images = {k: kept for k, kept in self._images.items() if k > result.number and self._watchers}
        with self._changed:
            self._newest = result, people
            if image is not None and result.frame is not None:
                self._drawable = tuple(self._recent), people, image
                self._changed.notify_all()
            if result.locations is not None and (now_s := time.monotonic()) >= self._way_due_s:
                self._way_due_s = now_s + _WAY_APART_S
                places = result.locations.positions
                for target, (east, north) in zip(places.target.tolist(), places.east_north_m.tolist(), strict=True):
                    self._ways.setdefault(target, deque(maxlen=_WAY_PLACES)).append((now_s, east, north))
                for target in [k for k, way in self._ways.items() if now_s - way[-1][0] > _WAY_APART_S * _WAY_PLACES]:
                    del self._ways[target]

    @property
    def is_full(self) -> bool:
        """Whether no further client can watch."""
        return self._watchers >= MOST_WATCHERS

    def pictures(self) -> Generator[bytes]:
        """Yield the body of an endless response of type PICTURES; b"" while there is no new picture.

        A slow client misses pictures, and gets the newest one next. The response is empty if too many clients watch.
        """
        give_way()
        with self._changed:
            if self.is_full:  # several clients asked at the same time
                return
            self._watchers += 1
        seen = None
        try:
            yield _BOUNDARY
            while not self._closed:
                with self._changed:
                    if self._drawable is seen and not self._closed:
                        self._changed.wait(_IDLE_S)
                    drawable = self._drawable
                if drawable is None or drawable is seen:
                    yield b""
                    continue
                seen = drawable
                try:
                    jpeg = self._jpeg(drawable)
                except Exception as error:  # a defect of this package must not end the stream in silence
                    if not self._has_failed:
                        self._has_failed = True
                        self._report(f"pictures cannot be drawn for the page, {type(error).__name__}: {error}")
                    continue
                # A browser shows a picture when the boundary after it has come.
                head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                yield head.encode() + jpeg + b"\r\n" + _BOUNDARY
        finally:
            with self._changed:
                self._watchers -= 1
                if not self._watchers:
                    self._drawable, self._encoded = None, (None, b"")

    def _jpeg(self, drawable: tuple[tuple[FrameResult, ...], TrackedFrame | None, np.ndarray]) -> bytes:
        """Return an annotated picture. Several clients share it."""
        with self._encoding:
            if self._encoded[0] is not drawable:
                picture = self._draw(*drawable)
                scale = _LONGEST_PX / max(picture.shape[:2])
                if scale < 1:
                    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
                self._encoded = drawable, encoded
            return self._encoded[1]

    def _draw(self, recent: Sequence[FrameResult], people: TrackedFrame | None, image: np.ndarray) -> np.ndarray:
        *before, result = recent
        pictures = RunPictures((image.shape[1], image.shape[0]), self._about.landmarks, self._zones)
        for earlier in before:
            pictures.show(earlier)
        return draw_result(pictures, result, people, image)

    def zones(self) -> list[dict[str, Any]]:
        """Return the zones on the ground in local metres."""
        origin_deg = None if self._site is None else self._site.origin_deg
        return [
            {
                "name": zone.name,
                "rings": [np.round(r, 2).tolist() for r in zone_rings(zone, origin_deg)],
                "line": zone.is_line,
            }
            for zone in self._zones
            if zone.unit != "px"
        ]

    def facts(self) -> dict[str, Any]:
        """Return what the page shows of the newest result; numbers may be NaN."""
        with self._changed:
            newest = self._newest
            ways = {target: [[east, north] for _, east, north in way] for target, way in self._ways.items()}
        if newest is None:
            return {"frame": 0, "utc": None, "targets": [], "more": 0, "map": None}
        result, people = newest
        rows = [*_target_rows(result), *(() if people is None else _people_rows(people))]
        return {
            "frame": result.number,
            "utc": self._about.utc(result.time_s),
            "targets": rows[:MOST_TARGETS],
            "more": max(len(rows) - MOST_TARGETS, 0),
            "map": None if self._site is None else _map_facts(result, ways, self._site),
        }


def draw_result(
    pictures: RunPictures, result: FrameResult, people: TrackedFrame | None, image: np.ndarray
) -> np.ndarray:
    """Return the picture of a frame with its targets and people, (H, W, 3) uint8 BGR. image: the frame's picture."""
    assert result.frame is not None
    tracked = replace(result.tracked, frame=replace(result.frame, image=image))
    picture = pictures(replace(result, tracked=tracked))
    if people is not None:
        for identity, box in zip(people.tracks.identity.tolist(), people.tracks.box_px, strict=True):
            rectangle(picture, box, PERSON, line_width(picture))
            label(picture, box, f"person {identity}", PERSON)
    return picture


def _target_rows(result: FrameResult) -> Iterator[dict[str, Any]]:
    """Yield a row of the list for each target: number, colour, class or kind, speed, place, and error of the place."""
    tracked, located = result.tracked, result.locations
    tracks, found = tracked.tracks, tracked.detections
    placed = dict[int, dict[str, Any]]()
    if located is not None:
        at = located.positions
        error_m = circular_error_90(semi_axes(at.covariance_m2, 1.0)[0])
        columns = (at.target.tolist(), error_m.tolist(), error_category(error_m), np.hypot(*located.velocity_m_s.T))
        for row, (target, error, category, speed) in enumerate(zip(*columns, strict=True)):
            place = _metres_text(at.east_north_m[row])
            if at.lonlat_deg is not None:
                place = "{1:.5f}, {0:.5f}".format(*at.lonlat_deg[row])
            placed[target] = {"place": place, "error": str(category), "error_m": round(error, 1)}
            placed[target] |= {"speed": f"{speed:.1f} m/s"} if math.isfinite(speed) else {}
        if (confirmed := result.confirmed) is not None:
            for row, kind in zip(confirmed.row.tolist(), confirmed.kind, strict=True):
                placed[int(at.target[row])]["confirmed"] = kind.replace("_", " ")
    rows = zip(tracks.identity.tolist(), tracks.box_px, tracks.row.tolist(), tracks.label, strict=True)
    for identity, box, row, name in sorted(rows, key=lambda one: one[0]):
        speed_px = float(found.speed_px[row]) if row >= 0 else math.nan
        facts = {"place": _pixel_text(box), "error": "", "error_m": math.nan, "confirmed": ""}
        facts["speed"] = f"{speed_px:.1f} px/frame" if math.isfinite(speed_px) else ""
        facts |= placed.get(identity, {})
        words = name or _KINDS.get(found.kind, found.kind), facts.pop("confirmed"), "" if row >= 0 else "not seen now"
        kind = ", ".join(str(word) for word in words if word)
        yield {"id": f"{identity}", "colour": _hex(identity_colour(identity)), "kind": kind, **facts}


def _people_rows(people: TrackedFrame) -> Iterator[dict[str, Any]]:
    for identity, box in zip(people.tracks.identity.tolist(), people.tracks.box_px, strict=True):
        facts = {"speed": "", "place": _pixel_text(box), "error": "", "error_m": math.nan}
        yield {"id": f"{identity}", "colour": _hex(PERSON), "kind": "person", **facts}


def _map_facts(result: FrameResult, ways: dict[int, list[list[float]]], site: MapSite) -> dict[str, Any] | None:
    """Return what the map shows, in local metres: targets with 95 % ellipse and track, landmarks, the camera's view."""
    located = result.locations
    if located is None:
        return None
    at, fix, marks = located.positions, located.fix, located.marks
    axes, bearing = semi_axes(at.covariance_m2)
    rings = at.east_north_m[:, None] + ring_m(axes, bearing)
    targets = []
    for target, place, ring in zip(at.target.tolist(), at.east_north_m, rings, strict=True):
        if np.isfinite(place).all():
            is_known = np.isfinite(ring).all()
            way = [*ways.pop(target, ()), place]
            shape = {"ring": _rounded(ring) if is_known else [], "way": _rounded(way)}
            targets.append({"id": f"{target}", "colour": _hex(identity_colour(target)), **shape})
    lost = [
        {"id": f"{target}", "colour": _hex(identity_colour(target)), "ring": [], "way": _rounded(way), "lost": True}
        for target, way in ways.items()
    ]
    seen = np.flatnonzero(np.isfinite(marks.east_north_m).all(axis=1)).tolist()
    view = np.zeros((0, 2)) if site.camera is None or not fix.by else view_of(fix, site.camera)
    return {
        "targets": (targets + lost)[:MOST_TARGETS],
        "landmarks": [[site.names[marks.landmark[row]], *_rounded(marks.east_north_m[row])] for row in seen],
        "camera": None if fix.pose is None else _rounded(fix.pose.place_m[:2]),
        "view": _rounded(view),
        "cause": "" if fix.by else fix.cause,
    }


def _metres_text(place: np.ndarray) -> str:
    east, north = (f"{value:.1f} m".replace("-", "−") for value in place)
    return f"east {east}, north {north}"


def _pixel_text(box: np.ndarray) -> str:
    u, v = box[:2] + box[2:] / 2
    return f"pixel {u:.0f}, {v:.0f}"


def _rounded(places: Any) -> Any:
    return np.round(np.asarray(places, float), 2).tolist()


def _hex(colour: tuple[int, int, int]) -> str:
    return "#{2:02x}{1:02x}{0:02x}".format(*colour)
