"""PX4's ULog: topics with their own time stamps."""

import contextlib
import io
import math
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.attitude import angles, axes_of_quaternion, heading_at
from torchvision_dddas.io.telemetry.log import Log, assemble
from torchvision_dddas.types import Telemetry

MAGIC = b"ULog\x01\x12\x35"
_TOPICS = (
    "vehicle_global_position",
    "vehicle_local_position",
    "vehicle_gps_position",
    "sensor_gps",
    "vehicle_attitude",
    "home_position",
    "gimbal_device_attitude_status",
    "mount_orientation",
)
_DEGREE_M = 111_320.0
_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64

Topic = dict[str, np.ndarray]


@np.errstate(invalid="ignore")  # where a log is damaged a number may be any bits
def read_ulog(path: Path, clock_offset_s: float) -> Telemetry:
    """Positions, heights and attitudes of a PX4 log; times since the first. Raises InputError if it has none."""
    log = Log(path, "PX4 log", "sample", bridge_s=1.0)
    topics = _topics(log)
    local = topics.get("vehicle_local_position")
    _add_place(log, topics, local)
    if local is not None:
        _add_local(log, local, topics.get("home_position"))
    yaw = np.zeros((0, 2))
    if (attitude := topics.get("vehicle_attitude")) is not None:
        heading, _, _ = angles(axes_of_quaternion(_rows(attitude, "q", 4)))
        yaw = np.stack([_seconds(attitude), heading], axis=1)[np.isfinite(heading)]
        _add(log, "vehicle_heading_rad", yaw[:, 0], yaw[:, 1])
    _add_camera(log, topics, yaw)
    return assemble(log, clock_offset_s, _clock(topics), from_first=True)


class _Onwards(io.BufferedReader):
    """A file that seeks back by no more than was read.

    pyulog 1.3 seeks back by the announced length of a damaged message; at the end of the file it would loop forever.
    """

    _short = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._short = max((size or 0) - len(data), 0)
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        return super().seek(offset + self._short if whence == io.SEEK_CUR and offset < 0 else offset, whence)


def _topics(log: Log) -> dict[str, Topic]:
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(
            f"telemetry {log.path} is a PX4 log, which needs pyulog: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    try:
        # It prints what it finds damaged.
        with contextlib.redirect_stdout(io.StringIO()), _Onwards(io.FileIO(log.path)) as file:
            read = ULog(file, list(_TOPICS))
    except Exception as error:
        raise log.refuse(f"the PX4 log is damaged from its beginning and cannot be read ({error})") from None
    if read.file_corruption:
        log.note("the log is damaged: what could not be read is left out")
    elif (byte := _cut(log.path.read_bytes())) is not None:
        log.note(f"byte {byte}: the file ends within a message; it was cut off")
    if read.dropouts:
        lost_s = sum(part.duration for part in read.dropouts) / 1000
        log.note(f"the logger fell behind {len(read.dropouts)} times and lost {lost_s:.3g} s in all")
    topics: dict[str, Topic] = {}
    for topic in read.data_list:
        if topic.name not in topics and len(topic.data.get("timestamp", ())):
            topics[topic.name] = topic.data
    if not topics:
        raise log.refuse("the PX4 log has no position, height or attitude")
    return topics


def _cut(content: bytes) -> int | None:
    """Start of an incomplete last message, or None; messages follow a header of 16 bytes, length first."""
    place = 16
    while place < len(content):
        end = place + 3 + int.from_bytes(content[place : place + 2], "little")
        if end > len(content) or place + 3 > len(content):
            return place
        place = end
    return None


def _seconds(topic: Topic) -> np.ndarray:
    return topic["timestamp"].astype(float) / 1e6


def _rows(topic: Topic, name: str, count: int) -> np.ndarray:
    unknown = np.full(len(topic["timestamp"]), np.nan)
    return np.stack([topic.get(f"{name}[{i}]", unknown) for i in range(count)], axis=1).astype(float)


def _column(topic: Topic, name: str) -> np.ndarray:
    return topic[name].astype(float) if name in topic else np.full(len(topic["timestamp"]), np.nan)


def _valid(topic: Topic, name: str) -> np.ndarray:
    """A flag; true if the log lacks it."""
    if name not in topic:
        return np.ones(len(topic["timestamp"]), bool)
    return topic[name].astype(bool)


def _add(log: Log, quantity: str, times: np.ndarray, values: np.ndarray) -> None:
    log.samples.setdefault(quantity, []).extend(
        zip(times.tolist(), np.asarray(values, float).tolist(), range(1, len(times) + 1), strict=True)
    )


def _add_place(log: Log, topics: dict[str, Topic], local: Topic | None) -> None:
    """The position from the best topic: global estimate, local estimate about its origin, GPS receiver."""
    fused, gps = topics.get("vehicle_global_position"), topics.get("vehicle_gps_position", topics.get("sensor_gps"))
    if fused is not None:
        times, longitude, latitude, height = (
            _seconds(fused),
            *(_column(fused, name) for name in ("lon", "lat", "alt")),
        )
        known = _valid(fused, "lat_lon_valid")
    elif local is not None and np.nanmax(np.abs(_column(local, "ref_lat")), initial=0) > 0:
        times, latitude0 = _seconds(local), _column(local, "ref_lat")
        latitude = latitude0 + _column(local, "x") / _DEGREE_M
        longitude = _column(local, "ref_lon") + _column(local, "y") / (_DEGREE_M * np.cos(np.radians(latitude0)))
        height = _column(local, "ref_alt") - _column(local, "z")
        known = _valid(local, "xy_valid") & _valid(local, "xy_global") & (latitude0 != 0)
    elif gps is not None:
        times = _seconds(gps)
        if "latitude_deg" in gps:  # since PX4 1.14 in degrees and metres
            longitude, latitude, height = (
                _column(gps, name) for name in ("longitude_deg", "latitude_deg", "altitude_msl_m")
            )
        else:
            longitude, latitude, height = (
                _column(gps, "lon") / 1e7,
                _column(gps, "lat") / 1e7,
                _column(gps, "alt") / 1e3,
            )
        known = _column(gps, "fix_type") >= 2
    else:
        return
    known &= (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)
    for name, values in (("longitude_deg", longitude), ("latitude_deg", latitude), ("above_sea_m", height)):
        _add(log, name, times, np.where(known, values, np.nan))


def _add_local(log: Log, local: Topic, home: Topic | None) -> None:
    """Height above take-off, or above ground if a range finder measures it throughout; speed."""
    times = _seconds(local)
    height = -_column(local, "z")
    if home is not None and np.isfinite(home_z := float(_column(home, "z")[-1])):
        height = height + home_z
    height = np.where(_valid(local, "z_valid"), height, np.nan)
    ranged = _valid(local, "dist_bottom_valid") if "dist_bottom_valid" in local else np.zeros(len(times), bool)
    if ranged.mean() > 0.95:
        height = np.where(ranged, _column(local, "dist_bottom"), np.nan)
        log.note("the altitude above ground is that of the range finder")
    _add(log, "altitude_m", times, height)
    speed = np.hypot(_column(local, "vx"), _column(local, "vy"))
    _add(log, "speed_m_s", times, np.where(_valid(local, "v_xy_valid"), speed, np.nan))


def _add_camera(log: Log, topics: dict[str, Topic], yaw: np.ndarray) -> None:
    if (gimbal := topics.get("gimbal_device_attitude_status")) is not None:
        heading, pitch, roll = angles(axes_of_quaternion(_rows(gimbal, "q", 4)))
        flags = gimbal.get("device_flags", np.zeros(len(heading), int)).astype(int)
        turned = (flags & _YAW_IN_EARTH > 0) | ((flags & _YAW_LOCK > 0) & (flags & _YAW_IN_VEHICLE == 0))
        times = _seconds(gimbal)
    elif (mount := topics.get("mount_orientation")) is not None:
        roll, pitch, heading = _rows(mount, "attitude_euler_angle", 3).T
        pitch, turned, times = -pitch, np.zeros(len(roll), bool), _seconds(mount)
        log.note("the mount's pitch and roll are taken against the horizon, its yaw against the vehicle")
    else:
        return
    heading = np.where(turned, heading, heading + heading_at(times, yaw[:, 0], yaw[:, 1]))
    for name, values in (("heading_rad", heading), ("pitch_rad", pitch), ("roll_rad", roll)):
        _add(log, name, times, values)


def _clock(topics: dict[str, Topic]) -> float:
    """Seconds since 1970 at the autopilot's start, by GPS time."""
    gps = topics.get("vehicle_gps_position", topics.get("sensor_gps"))
    if gps is None or "time_utc_usec" not in gps:
        return math.nan
    utc_s = _column(gps, "time_utc_usec") / 1e6
    is_known = utc_s > 946_684_800
    return float(np.median((utc_s - _seconds(gps))[is_known])) if is_known.any() else math.nan
