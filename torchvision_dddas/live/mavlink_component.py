"""The MAVLink components of a run: an onboard computer, and a camera whose targets a ground station chooses.

Source: the Camera Protocol v2 and the heartbeat protocol of the MAVLink specification (common.xml).
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from torchvision_dddas.geometry import shared_px
from torchvision_dddas.io.mavlink_link import MavlinkLink, Notify
from torchvision_dddas.runtime import VERSION
from torchvision_dddas.types import FrameResult, Tracks

_HEARTBEAT_S, _LISTEN_S = 1.0, 2.0
_IMAGE_STATUS, _GEO_STATUS, _CAMERA, _VIDEO = 275, 276, 259, 269
_DEFAULT_S, _SHORTEST_S = 0.5, 0.1  # of the tracking status
_REACH = 0.03  # a click selects a target within this share of the picture's width
_LOST_S = 5.0  # a chosen target that is not seen for this time is given up
_VIDEO_TYPES = {"rtsp": 0, "udp": 3, "tcp": 2}  # VIDEO_STREAM_TYPE, by the scheme of the address


def is_autopilot(message: Any) -> bool:
    """Return whether a message is the heartbeat of an autopilot, and not of a station or a part of a vehicle."""
    return message.get_type() == "HEARTBEAT" and message.get_srcComponent() == 1 and message.autopilot != 8


class MavlinkComponent:
    """An onboard computer and a camera on a link. Call `show` with each result, and `tick` several times a second.

    system: the vehicle's number; 0 until a vehicle is heard. chosen: identity of the target that a ground station
    chose; 0 without a choice. has_begun: whether the components have listened, and have their numbers. video_uri:
    address of the annotated stream; "" without a stream. is_geographic: whether targets are located in degrees.
    """

    def __init__(
        self, link: MavlinkLink, size_px: tuple[int, int], rate_hz: float, notify: Notify, system: int = 0
    ) -> None:
        self.link, self.system, self.chosen, self.video_uri, self.is_geographic = link, system, 0, "", False
        self.component, self.camera = 191, 100
        self._given, self._size_px, self._rate_hz, self._notify = system, size_px, rate_hz, notify
        self._result: FrameResult | None = None
        self._seen_s, self._now_s, self._heard_s = -math.inf, math.inf, math.inf  # no time is known before a tick
        self._start_s: float | None = None
        self._taken = set[tuple[int, int]]()  # systems and components of others
        self._intervals_s = dict.fromkeys((_IMAGE_STATUS, _GEO_STATUS), _DEFAULT_S)
        self._due_s = dict.fromkeys((0, _IMAGE_STATUS, _GEO_STATUS), -math.inf)  # 0: heartbeats
        self.has_begun = False
        self._answers: dict[int, Callable[[], Any]] = {
            _CAMERA: self._camera_information,
            _VIDEO: self._video_information,
            _IMAGE_STATUS: self._image_status,
            _GEO_STATUS: self._geo_status,
        }
        link.subscribe(self._hear)

    def show(self, result: FrameResult, size_px: tuple[int, int]) -> None:
        """Take the newest result, and the size of its picture."""
        self._result, self._size_px = result, size_px
        if self.chosen and self.chosen in result.tracks.identity:
            self._seen_s = self._now_s

    def tick(self, now_s: float) -> None:
        """Send the messages that are due at a time of a steady clock."""
        self._now_s = now_s
        self._start_s = self._start_s or now_s
        if not self.has_begun:
            # Listen first, because other computers and cameras on the vehicle may have the usual numbers.
            waited_s = now_s - min(self._heard_s, self._start_s + _LISTEN_S)
            if waited_s < _LISTEN_S:
                return
            self.system, self.has_begun = self.system or 1, True
            self.component = self._free(191, 194)
            self.camera = self._free(100, 105)
        if self._is_due(0, _HEARTBEAT_S):
            for component, kind in ((self.component, 18), (self.camera, 30)):  # onboard controller, camera
                self._send(self.link.dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3), component)
        if self.chosen and now_s - self._seen_s > _LOST_S:
            self._notify("target", f"target {self.chosen}, which a ground station chose, is lost")
            self._stop()
        for number in (_IMAGE_STATUS, _GEO_STATUS):
            if self.chosen and self._is_due(number, self._intervals_s[number]):
                self._answer(number)

    def _is_due(self, what: int, interval_s: float) -> bool:
        if self._now_s < self._due_s[what]:
            return False
        self._due_s[what] = self._now_s + interval_s
        return True

    def _free(self, first: int, last: int) -> int:
        return next((n for n in range(first, last + 1) if (self.system, n) not in self._taken), last)

    def _send(self, message: Any, component: int) -> None:
        self.link.send(message, self.system, component)

    def _answer(self, number: int) -> bool:
        """Send a message by its number. Return whether there is one now."""
        message = self._answers[number]() if number in self._answers else None
        if message is not None:
            self._send(message, self.camera)
        return message is not None

    def _stop(self) -> None:
        self.chosen = 0
        self._answer(_IMAGE_STATUS)

    # Messages that come in, in the receiving thread.

    def _hear(self, utc_s: float, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if not self.has_begun:
                self._taken.add((message.get_srcSystem(), message.get_srcComponent()))
            system = message.get_srcSystem()
            if is_autopilot(message) and self._given in (0, system) and self._heard_s == math.inf:
                self.system, self._heard_s = system, self._now_s
        elif kind in ("COMMAND_LONG", "COMMAND_INT") and self.has_begun and message.target_system in (0, self.system):
            of_camera = message.target_component in (0, self.camera)
            result = self._obey(message) if of_camera else None
            component = message.target_component or self.camera
            if result is None and component in (self.component, self.camera) and message.target_component:
                result = 3  # unsupported; nobody answers that to a command for all components
            if result is not None:
                sender = message.get_srcSystem(), message.get_srcComponent()
                ack = self.link.dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
                self._send(ack, component)

    def _obey(self, message: Any) -> int | None:
        """Follow a command to the camera. Return its MAV_RESULT, or None for an unknown command."""
        command, number = message.command, message.param1
        if command in (512, 521, 2504):  # REQUEST_MESSAGE, and the older requests of its two descriptions
            number = {521: _CAMERA, 2504: _VIDEO}.get(command, number)
            return 0 if math.isfinite(number) and self._answer(int(number)) else None
        if command == 511 and number in self._intervals_s:  # SET_MESSAGE_INTERVAL
            interval_s = message.param2 / 1e6
            if not math.isfinite(interval_s):
                return 2
            chosen_s = _DEFAULT_S if interval_s == 0 else math.inf if interval_s < 0 else max(interval_s, _SHORTEST_S)
            self._intervals_s[int(number)] = chosen_s
            self._due_s[int(number)] = self._now_s if chosen_s < math.inf else math.inf
            return 0
        if command == 2010:  # CAMERA_STOP_TRACKING
            self._stop()
            return 0
        if command not in (2004, 2005):  # CAMERA_TRACK_POINT, CAMERA_TRACK_RECTANGLE
            return None
        params = [message.param1, message.param2, message.param3, message.param4]
        corners = np.array(params if command == 2005 else params[:2], float)
        if not ((corners >= 0) & (corners <= 1)).all():
            return 2  # denied
        result, size = self._result, np.array(self._size_px)
        tracks = Tracks(0) if result is None else result.tracks
        if command == 2004:
            radius = params[2] if math.isfinite(params[2]) and params[2] > 0 else _REACH
            found = track_at(tracks, corners * size, float(np.clip(radius, 0, 1)) * size[0])
        else:
            found = track_in(tracks, np.r_[corners[:2], corners[2:] - corners[:2]] * np.r_[size, size])
        if not found:
            self._notify("target", f"system {message.get_srcSystem()} chose a place without a target")
            return 4
        self._notify("target", f"system {message.get_srcSystem()} chose target {found}")
        self.chosen, self._seen_s = found, self._now_s
        self._due_s |= {n: self._now_s for n, s in self._intervals_s.items() if s < math.inf}
        return 0

    # Messages that go out.

    def _camera_information(self) -> Any:
        d, nan = self.link.dialect, math.nan
        flags = d.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT | d.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
        flags |= d.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS if self.is_geographic else 0
        flags |= d.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM if self.video_uri else 0
        names = [list(name.encode().ljust(32, b"\0")) for name in ("torchvision_dddas", "target tracker")]
        numbers = [int(part) for part in VERSION.split("+")[0].split(".")[:3] if part.isdecimal()]
        version = sum(number % 256 << 8 * place for place, number in enumerate(numbers))
        time_ms = int(1000 * self._now_s) % 2**32
        return d.MAVLink_camera_information_message(
            time_ms, *names, version, nan, nan, nan, *self._size_px, 0, flags, 0, b""
        )

    def _video_information(self) -> Any:
        scheme, _, rest = self.video_uri.partition(":")
        kind = _VIDEO_TYPES.get(scheme)
        # For a stream of UDP datagrams, the specification wants the port alone: the ground station listens there.
        uri = rest.rpartition(":")[2] if scheme == "udp" else self.video_uri
        if kind is None or len(uri) > 160:
            return None
        return self.link.dialect.MAVLink_video_stream_information_message(
            1, 1, kind, 1, self._rate_hz, *self._size_px, 0, 0, 0, b"annotated", uri.encode()
        )

    def _image_status(self) -> Any:
        build, nan = self.link.dialect.MAVLink_camera_tracking_image_status_message, math.nan
        result = self._result
        row = np.zeros(0, int) if result is None else np.flatnonzero(result.tracks.identity == self.chosen)
        if result is None or not self.chosen or not len(row):
            return build(2 if self.chosen else 0, 0, 0, nan, nan, nan, nan, nan, nan, nan)  # lost for now, or idle
        left, top, width, height = result.tracks.box_px[row[0]].tolist()
        corners = np.array([left, top, left + width, top + height]) / np.tile(self._size_px, 2)
        data = 4 | (2 if self.video_uri else 0)  # in this status, and drawn in the stream
        status = 1 if result.tracks.row[row[0]] >= 0 else 1 | 8  # active, and coasting for a box that bridges a gap
        return build(status, 2, data, nan, nan, nan, *np.clip(corners, 0, 1).tolist())

    def _geo_status(self) -> Any:
        located = None if self._result is None else self._result.locations
        if located is None or located.positions.lonlat_deg is None:
            return None
        rows = np.flatnonzero(located.positions.target == self.chosen)
        if not len(rows) or not np.isfinite(located.positions.lonlat_deg[rows[0]]).all():
            return None
        places, row, nan = located.positions, int(rows[0]), math.nan
        assert places.lonlat_deg is not None
        longitude, latitude = (round(1e7 * v) for v in places.lonlat_deg[row].tolist())
        covariance = places.covariance_m2[row]
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) if np.isfinite(covariance).all() else nan
        east, north = located.velocity_m_s[row].tolist()
        distance = nan
        if located.fix.pose is not None:
            distance = float(np.linalg.norm(located.fix.pose.place_m - np.append(places.east_north_m[row], 0.0)))
        course = math.atan2(east, north) if math.hypot(east, north) > 0.1 else nan
        above_sea_m = float(places.above_sea_m[row])
        motion = north, east, nan, nan, distance, course, nan
        build = self.link.dialect.MAVLink_camera_tracking_geo_status_message
        return build(1, latitude, longitude, above_sea_m, sigma_m, nan, *motion)


def track_at(tracks: Tracks, point_px: np.ndarray, radius_px: float) -> int:
    """Return the identity of the target at a point: the smallest box that holds it, else the nearest one in reach."""
    low, high = tracks.box_px[:, :2], tracks.box_px[:, :2] + tracks.box_px[:, 2:]
    away = np.linalg.norm(np.maximum(np.maximum(low - point_px, point_px - high), 0), axis=1)
    order = np.lexsort((tracks.box_px[:, 2:].prod(axis=1), away))
    return int(tracks.identity[order[0]]) if len(order) and away[order[0]] <= radius_px else 0


def track_in(tracks: Tracks, box_px: np.ndarray) -> int:
    """Return the identity of the target that shares the largest part with a box; 0 if no target does."""
    if not len(tracks):
        return 0
    shared = shared_px(box_px, tracks.box_px)
    share = shared / np.maximum(tracks.box_px[:, 2:].prod(axis=1) + box_px[2:].prod() - shared, 1e-9)
    return int(tracks.identity[share.argmax()]) if share.max() > 0 else 0
