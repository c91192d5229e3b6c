"""Logs of autopilots: MAVLink messages as a ground station received them, and PX4's ULog.

Both become topics, tables of messages of one kind, from which places, heights, speeds and attitudes are taken.
"""

import binascii
import contextlib
import io
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.attitude import angles, axes_of_quaternion, heading_at
from torchvision_dddas.io.telemetry.record import Log, build_record
from torchvision_dddas.types import Telemetry

Topic = dict[str, np.ndarray]
"""Field -> (N,) values of the messages of one kind; time_s, and their places in the file as `where`."""

_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64


def _column(topic: Topic, name: str) -> np.ndarray:
    """A field as floats; NaN where the log lacks it."""
    return topic[name].astype(float) if name in topic else np.full(len(topic["time_s"]), np.nan)


def _add(log: Log, topic: Topic, **values: np.ndarray) -> None:
    log.add_all(topic["time_s"], topic["where"], values)


def _gimbal(quaternion: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray, ...]:
    """Heading, pitch, roll, and whether the heading is against north, of MAVLink's gimbal protocol, version 2."""
    flags = flags.astype(int)
    is_absolute = (flags & _YAW_IN_EARTH > 0) | ((flags & _YAW_LOCK > 0) & (flags & _YAW_IN_VEHICLE == 0))
    return *angles(axes_of_quaternion(quaternion)), is_absolute


def _add_camera(log: Log, topic: Topic, vehicle: Topic | None, attitude: tuple[np.ndarray, ...]) -> None:
    """Add a gimbal's attitude. vehicle: times, and headings as `yaw`. attitude: as `_gimbal` returns it."""
    heading, pitch, roll, is_absolute = attitude
    known_s, yaw = (vehicle["time_s"], vehicle["yaw"]) if vehicle is not None else (np.zeros(0), np.zeros(0))
    heading = np.where(is_absolute, heading, heading + heading_at(topic["time_s"], known_s, yaw))
    _add(log, topic, heading_rad=heading, pitch_rad=pitch, roll_rad=roll)


def _note_mount(log: Log) -> None:
    log.note("the mount's pitch and roll are taken against the horizon, its yaw against the vehicle")


# --------------------------------------------------------------------------------------------------------------------
# MAVLink telemetry logs: messages, each after the time at which it was received.

_V1, _V2 = 0xFE, 0xFD
_MAGIC = re.compile(bytes([0x5B, _V1, _V2, 0x5D]))  # either of them
_SIGNED = 0x01
_MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_V2_MIRRORED, _SIGNED_MIRRORED = _MIRROR[_V2], _MIRROR[_SIGNED]
# Times outside 2000 to 2200 are no clock.
_CLOCK_US = (946_684_800_000_000, 7_258_118_400_000_000)
_PLACES = ("GLOBAL_POSITION_INT", "GPS_RAW_INT")
_WANTED = (
    *(*_PLACES, "VFR_HUD", "ATTITUDE", "MOUNT_STATUS", "MOUNT_ORIENTATION"),
    *("GIMBAL_DEVICE_ATTITUDE_STATUS", "CAMERA_FOV_STATUS"),
)
_UNKNOWN_16 = 0xFFFF


def read_tlog(path: Path, clock_offset_s: float) -> Telemetry:
    """Positions and attitudes of the vehicle with the most messages; times since the first one.

    Raises InputError if no vehicle reports any.
    """
    log = Log(path, "MAVLink log", "byte", bridge_s=2.0)
    topics = _mavlink_topics(log)
    if (fused := topics.get("GLOBAL_POSITION_INT")) is not None:
        _add_degrees_e7(log, fused, fused["lon"], fused["lat"])
        speed = np.hypot(fused["vx"], fused["vy"]) / 100
        _add(log, fused, above_sea_m=fused["alt"] / 1e3, altitude_m=fused["relative_alt"] / 1e3, speed_m_s=speed)
    elif (gps := topics.get("GPS_RAW_INT")) is not None:
        is_fixed = gps["fix_type"] >= 2
        _add_degrees_e7(log, gps, np.where(is_fixed, gps["lon"], 0), np.where(is_fixed, gps["lat"], 0))
        height = np.where(gps["fix_type"] >= 3, gps["alt"] / 1e3, np.nan)
        speed = np.where(is_fixed & (gps["vel"] != _UNKNOWN_16), gps["vel"] / 100, np.nan)
        _add(log, gps, above_sea_m=height, speed_m_s=speed)
    if "speed_m_s" not in log.samples and (hud := topics.get("VFR_HUD")) is not None:
        _add(log, hud, speed_m_s=hud["groundspeed"])
    vehicle = topics.get("ATTITUDE")
    if vehicle is None and fused is not None and (is_known := fused["hdg"] != _UNKNOWN_16).any():
        vehicle = {name: values[is_known] for name, values in fused.items()}
        vehicle["yaw"] = np.radians(vehicle["hdg"] / 100)
    if vehicle is not None:
        _add(log, vehicle, vehicle_heading_rad=vehicle["yaw"])
    if (view := topics.get("CAMERA_FOV_STATUS")) is not None:
        is_known = (view["hfov"] > 0) & (view["hfov"] < 180)
        log.add_all(view["time_s"][is_known], view["where"][is_known], {"hfov_rad": np.radians(view["hfov"][is_known])})
    if (gimbal := topics.get("GIMBAL_DEVICE_ATTITUDE_STATUS")) is not None:
        _add_camera(log, gimbal, vehicle, _gimbal(gimbal["q"], gimbal["flags"]))
    elif (mount := topics.get("MOUNT_ORIENTATION")) is not None:
        absolute = mount["yaw_absolute"]
        is_absolute = np.isfinite(absolute) & (absolute != 0)
        heading = np.radians(np.where(is_absolute, absolute, mount["yaw"]))
        _add_camera(log, mount, vehicle, (heading, -np.radians(mount["pitch"]), np.radians(mount["roll"]), is_absolute))
    elif (mount := topics.get("MOUNT_STATUS")) is not None:
        pitch, roll, heading = (np.radians(mount[f"pointing_{axis}"] / 100) for axis in "abc")
        _note_mount(log)
        _add_camera(log, mount, vehicle, (heading, -pitch, roll, np.zeros(len(roll), bool)))
    return build_record(log, clock_offset_s, 0.0, from_first=True)  # its times are since 1970


def _add_degrees_e7(log: Log, topic: Topic, longitude: np.ndarray, latitude: np.ndarray) -> None:
    is_known = (np.abs(latitude) <= 90e7) & (np.abs(longitude) <= 180e7)
    degrees = (np.where(is_known, values / 1e7, np.nan) for values in (longitude, latitude))
    _add(log, topic, **dict(zip(("longitude_deg", "latitude_deg"), degrees, strict=True)))


def _mavlink_topics(log: Log) -> dict[str, Topic]:
    """The messages of the vehicle that reports most, by name, at the times of `_sending_times`."""
    try:
        from pymavlink.dialects.v20 import all as dialect
    except ImportError:
        raise InputError(
            f"telemetry {log.path} is a MAVLink log, which needs pymavlink: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    numbers = {getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in _WANTED}
    decoder = dialect.MAVLink(None)
    content = log.path.read_bytes()
    rows: list[tuple[float, Any, int]] = []
    bad: list[int] = []
    count = 0
    extras = {number: _MIRROR[kind.crc_extra : kind.crc_extra + 1] for number, kind in dialect.mavlink_map.items()}
    for place, end, number in _frames(log, content, extras):
        count += 1
        if number in numbers:
            try:
                message = decoder.decode(bytearray(content[place + 8 : end]))
                rows.append((int.from_bytes(content[place : place + 8], "big") / 1e6, message, place))
            except (dialect.MAVError, ValueError, TypeError):
                bad.append(place)
    if bad:
        log.note(f"{len(bad)} of {count} messages are damaged and left out, the first at byte {bad[0]}")
    systems: Counter[int] = Counter()
    for _, message, _ in rows:
        systems[message.get_srcSystem()] += 100 if message.get_type() in _PLACES else 1
    if not rows:
        raise log.refuse(f"none of its {count} MAVLink messages has a position, a height or an attitude")
    chosen = systems.most_common(1)[0][0]
    others = {m.get_srcSystem() for _, m, _ in rows if m.get_type() == "GLOBAL_POSITION_INT"} - {chosen}
    if others:
        names = ", ".join(map(str, sorted(others)))
        log.note(f"several vehicles report: system {chosen} is taken, left out are {names}")
    rows = [row for row in rows if row[1].get_srcSystem() == chosen]
    times = _sending_times(log, rows)
    topics = {}
    for name in {message.get_type() for _, message, _ in rows}:
        index = [i for i, (_, message, _) in enumerate(rows) if message.get_type() == name]
        messages = [rows[i][1] for i in index]
        topics[name] = {
            field: np.array([getattr(m, field) for m in messages]) for field in messages[0].get_fieldnames()
        }
        topics[name] |= {"time_s": times[index], "where": np.array([rows[i][2] for i in index])}
    return topics


def _sending_times(log: Log, rows: list[tuple[float, Any, int]]) -> np.ndarray:
    """When the vehicle sent each message, by its own clock. rows: time of reception, message and its first byte.

    Messages arrive in bursts, a second late or more; at 20 m/s that is 20 m. The smallest delay counts as zero. A
    message without a time has that of the one before. If the clocks drift apart, the times of reception are kept.
    """
    came = np.array([came_s for came_s, *_ in rows])
    sent = np.array([getattr(message, "time_boot_ms", np.nan) / 1e3 for _, message, _ in rows])
    is_known = np.isfinite(sent)
    if is_known.sum() < 2:
        return came
    apart, span_s = (came - sent)[is_known], float(np.ptp(sent[is_known]))
    alike = np.abs(apart - np.median(apart)) < 5 + 0.01 * span_s
    if alike.mean() < 0.9:  # a few may be damaged: no checksum covers the times
        log.note("the vehicle's clock and the station's drift apart: times are those of reception")
        return came
    log.jitter_s = math.inf  # messages are sorted by time
    latest = np.maximum.accumulate(np.where(is_known, np.arange(len(sent)), np.argmax(is_known)))
    return sent[latest] + np.percentile(apart[alike], 1)


def looks_like_tlog(head: bytes) -> bool:
    """Whether eight bytes of time are followed by a message, and that by the next one."""
    for place in range(min(len(head), 1024)):
        end = _end(head, place)
        if end is not None and _CLOCK_US[0] < int.from_bytes(head[place : place + 8], "big") < _CLOCK_US[1]:
            return end >= len(head) - 8 or head[end + 8] in (_V1, _V2)
    return False


def _frames(log: Log, content: bytes, extras: Mapping[int, bytes]) -> Iterator[tuple[int, int, int]]:
    """Start (of its time), end and number of each message; other bytes are skipped. extras: see `_is_whole`."""
    place, lost, lost_first = 0, 0, 0
    mirrored = content.translate(_MIRROR)
    while place + 16 <= len(content):
        end = _end(content, place)
        if end is not None and end > len(content):
            break
        if end is not None:
            code = content[place + 15 : place + 18] if content[place + 8] == _V2 else content[place + 13 : place + 14]
            number = int.from_bytes(code, "little")
            is_followed = end == len(content) or (end + 8 < len(content) and content[end + 8] in (_V1, _V2))
            if is_followed or (number in extras and _is_whole(mirrored, place + 8, end, extras[number])):
                yield place, end, number
                place = end
                continue
        nearest = _MAGIC.search(content, place + 9)
        following = nearest.start() - 8 if nearest is not None else len(content)
        lost, lost_first = lost + following - place, lost_first or place
        place = following
    if place < len(content):
        log.note(f"byte {place}: the file ends within a message; it was cut off")
    if lost:
        log.note(f"byte {lost_first}: {lost} bytes are no MAVLink messages and left out")


def _end(content: bytes, place: int) -> int | None:
    """End of the message that begins here, or None."""
    if place + 12 > len(content):
        return None
    if content[place + 8] == _V1:
        return place + 16 + content[place + 9]
    if content[place + 8] == _V2:
        return place + 20 + content[place + 9] + (13 if content[place + 10] & _SIGNED else 0)
    return None


def _is_whole(mirrored: bytes, begin: int, end: int, extra: bytes) -> bool:
    """Whether the checksum of a message is right, CRC-16/MCRF4XX.

    mirrored: the log with the bits of each byte in reverse, to which the checksum of `binascii` is the same, and fast:
    every byte may look like the beginning of a message. extra: what its kind adds to the checksum, in reverse as well.
    """
    if mirrored[begin] == _V2_MIRRORED and mirrored[begin + 2] & _SIGNED_MIRRORED:
        end -= 13
    found = binascii.crc_hqx(extra, binascii.crc_hqx(mirrored[begin + 1 : end - 2], 0xFFFF))
    return mirrored[end - 2 : end] == found.to_bytes(2, "big")


# --------------------------------------------------------------------------------------------------------------------
# PX4's ULog: topics with their own time stamps.

PX4_RADIUS_M = 6_371_000.0  # of the Earth in PX4's MapProjection (CONSTANTS_RADIUS_OF_EARTH)
MAGIC = b"ULog\x01\x12\x35"
_TOPICS = (
    *("vehicle_global_position", "vehicle_local_position", "vehicle_gps_position", "sensor_gps", "vehicle_attitude"),
    *("home_position", "gimbal_device_attitude_status", "mount_orientation"),
)


@np.errstate(invalid="ignore")  # where a log is damaged a number may be any bits
def read_ulog(path: Path, clock_offset_s: float) -> Telemetry:
    """Positions, heights and attitudes of a PX4 log; times since the first. Raises InputError if it has none."""
    log = Log(path, "PX4 log", "sample", bridge_s=1.0)
    topics = _px4_topics(log)
    local = topics.get("vehicle_local_position")
    gps = topics.get("vehicle_gps_position", topics.get("sensor_gps"))
    _add_px4_place(log, topics.get("vehicle_global_position"), local, gps)
    if local is not None:
        _add_px4_local(log, local, topics.get("home_position"))
    if (vehicle := topics.get("vehicle_attitude")) is not None:
        yaw, _, _ = angles(axes_of_quaternion(_vector(vehicle, "q", 4)))
        is_known = np.isfinite(yaw)
        vehicle = {"time_s": vehicle["time_s"][is_known], "yaw": yaw[is_known], "where": 1 + np.arange(is_known.sum())}
        _add(log, vehicle, vehicle_heading_rad=vehicle["yaw"])
    if (gimbal := topics.get("gimbal_device_attitude_status")) is not None:
        flags = gimbal.get("device_flags", np.zeros(len(gimbal["time_s"])))
        _add_camera(log, gimbal, vehicle, _gimbal(_vector(gimbal, "q", 4), flags))
    elif (mount := topics.get("mount_orientation")) is not None:
        roll, pitch, heading = _vector(mount, "attitude_euler_angle", 3).T
        _note_mount(log)
        _add_camera(log, mount, vehicle, (heading, -pitch, roll, np.zeros(len(roll), bool)))
    clock_s = math.nan  # seconds since 1970 at the autopilot's start, by GPS time
    if gps is not None:
        utc_s = _column(gps, "time_utc_usec") / 1e6
        if (is_known := utc_s > 946_684_800).any():
            clock_s = float(np.median((utc_s - gps["time_s"])[is_known]))
    return build_record(log, clock_offset_s, clock_s, from_first=True)


# The beginning of a message: its length, up to about 10,000, and a kind that pyulog knows.
_HEADER = re.compile(rb"(?:[^\0][\0-\x27]|\0[\1-\x27])[ABCDFILMOPQRS]", re.DOTALL)


class _Onwards(io.BytesIO):
    """The bytes of a log, of which those between damage and the next beginning of a message are left out.

    pyulog 1.3 seeks back from a damaged message to the byte behind its first, which takes seconds a megabyte; and at
    the end of the file by its announced length, though it read less, which would loop forever.
    """

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self._content, self._asked, self._short = content, 0, 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._asked = size or 0
        self._short = max(self._asked - len(data), 0)
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        if whence != io.SEEK_CUR or offset >= 0:
            return super().seek(offset, whence)
        place = self.tell() + offset + self._short
        if offset == -2 - self._asked:  # behind the first byte of a message, the last that was read
            following = _HEADER.search(self._content, place)
            place = len(self._content) if following is None else following.start()
        return super().seek(place)


def _px4_topics(log: Log) -> dict[str, Topic]:
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(
            f"telemetry {log.path} is a PX4 log, which needs pyulog: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    content = log.path.read_bytes()
    try:
        # It prints what it finds damaged.
        with contextlib.redirect_stdout(io.StringIO()):
            read = ULog(_Onwards(content), list(_TOPICS))
    except Exception as error:
        raise log.refuse(f"the PX4 log is damaged from its beginning and cannot be read ({error})") from None
    if read.file_corruption:
        log.note("the log is damaged: what could not be read is left out")
    elif (byte := _cut(content)) is not None:
        log.note(f"byte {byte}: the file ends within a message; it was cut off")
    if read.dropouts:
        lost_s = sum(part.duration for part in read.dropouts) / 1000
        log.note(f"the logger fell behind {len(read.dropouts)} times and lost {lost_s:.3g} s in all")
    topics: dict[str, Topic] = {}
    for topic in read.data_list:
        stamps = topic.data.get("timestamp", ())
        if topic.name not in topics and len(stamps):
            own = {"time_s": stamps.astype(float) / 1e6, "where": 1 + np.arange(len(stamps))}
            topics[topic.name] = {**topic.data, **own}
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


def _vector(topic: Topic, name: str, count: int) -> np.ndarray:
    return np.stack([_column(topic, f"{name}[{i}]") for i in range(count)], axis=1)


def _flag(topic: Topic, name: str) -> np.ndarray:
    """Whether something is valid; true if the log lacks the flag."""
    return topic[name].astype(bool) if name in topic else np.ones(len(topic["time_s"]), bool)


def _add_px4_place(log: Log, fused: Topic | None, local: Topic | None, gps: Topic | None) -> None:
    """The position from the best topic: global estimate, local estimate about its origin, GPS receiver."""
    if fused is not None:
        topic, known = fused, _flag(fused, "lat_lon_valid")
        longitude, latitude, height = (_column(fused, name) for name in ("lon", "lat", "alt"))
    elif local is not None and np.nanmax(np.abs(_column(local, "ref_lat")), initial=0) > 0:
        topic, latitude0 = local, _column(local, "ref_lat")
        longitude, latitude = px4_lonlat(_column(local, "y"), _column(local, "x"), _column(local, "ref_lon"), latitude0)
        height = _column(local, "ref_alt") - _column(local, "z")
        known = _flag(local, "xy_valid") & _flag(local, "xy_global") & (latitude0 != 0)
    elif gps is not None:
        # Since PX4 1.14 in degrees and metres.
        in_degrees = {"longitude_deg": 1.0, "latitude_deg": 1.0, "altitude_msl_m": 1.0}
        units = in_degrees if "latitude_deg" in gps else {"lon": 1e7, "lat": 1e7, "alt": 1e3}
        topic, known = gps, _column(gps, "fix_type") >= 2
        longitude, latitude, height = (_column(gps, name) / unit for name, unit in units.items())
    else:
        return
    known = known & (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)
    values = {"longitude_deg": longitude, "latitude_deg": latitude, "above_sea_m": height}
    _add(log, topic, **{name: np.where(known, column, np.nan) for name, column in values.items()})


def px4_lonlat(
    east_m: np.ndarray, north_m: np.ndarray, longitude0_deg: np.ndarray, latitude0_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes and latitudes of PX4's local positions, which are azimuthal equidistant about an origin on its sphere.

    The inverse of what PX4's MapProjection does to the global position.
    """
    latitude0, distance = np.radians(latitude0_deg), np.hypot(east_m, north_m) / PX4_RADIUS_M
    over = 1 / PX4_RADIUS_M * np.sinc(distance / np.pi)  # sin(distance) / distance, 1 at the origin
    east, north = east_m * over, north_m * over
    latitude = np.arcsin(np.clip(np.cos(distance) * np.sin(latitude0) + north * np.cos(latitude0), -1, 1))
    turned = np.arctan2(east, np.cos(latitude0) * np.cos(distance) - np.sin(latitude0) * north)
    longitude = longitude0_deg + np.degrees(turned)
    return np.where(np.abs(longitude) > 180, (longitude + 180) % 360 - 180, longitude), np.degrees(latitude)


def _add_px4_local(log: Log, local: Topic, home: Topic | None) -> None:
    """Height above take-off, or above ground if a range finder measures it throughout; speed."""
    height = -_column(local, "z")
    if home is not None and np.isfinite(home_z := float(_column(home, "z")[-1])):
        height = height + home_z
    height = np.where(_flag(local, "z_valid"), height, np.nan)
    if "dist_bottom_valid" in local and (is_ranged := _flag(local, "dist_bottom_valid")).mean() > 0.95:
        height = np.where(is_ranged, _column(local, "dist_bottom"), np.nan)
        log.note("the altitude above ground is that of the range finder")
    speed = np.hypot(_column(local, "vx"), _column(local, "vy"))
    _add(log, local, altitude_m=height, speed_m_s=np.where(_flag(local, "v_xy_valid"), speed, np.nan))
