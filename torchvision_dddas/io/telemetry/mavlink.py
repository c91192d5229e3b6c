"""MAVLink telemetry logs of a ground station: messages, each after the time at which it was received."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.attitude import angles, axes_of_quaternion, heading_at
from torchvision_dddas.io.telemetry.log import Log, assemble
from torchvision_dddas.types import Telemetry

Said = list[tuple[float, Any, int]]
"""Time of reception, message, first byte."""

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
# Times outside 2000 to 2200 are no clock.
_CLOCK_US = (946_684_800_000_000, 7_258_118_400_000_000)
_WANTED = (
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "VFR_HUD",
    "ATTITUDE",
    "MOUNT_STATUS",
    "MOUNT_ORIENTATION",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
    "CAMERA_FOV_STATUS",
)
_UNKNOWN_16 = 0xFFFF
_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64


def read_tlog(path: Path, clock_offset_s: float) -> Telemetry:
    """Positions and attitudes of the vehicle with the most messages; times since the first one.

    Raises InputError if no vehicle reports any.
    """
    log = Log(path, "MAVLink log", "byte", bridge_s=2.0)
    said = _on_vehicle_clock(log, messages(log))
    get = said.get
    places = get("GLOBAL_POSITION_INT", [])
    for time_s, m, byte in places:
        _add_place(log, time_s, m.lon, m.lat, byte)
        log.add("above_sea_m", time_s, m.alt / 1e3, byte)
        log.add("altitude_m", time_s, m.relative_alt / 1e3, byte)
        log.add("speed_m_s", time_s, math.hypot(m.vx, m.vy) / 100, byte)
    if not places:
        for time_s, m, byte in get("GPS_RAW_INT", []):
            fixed = m.fix_type >= 2
            _add_place(log, time_s, m.lon if fixed else 0, m.lat if fixed else 0, byte)
            log.add("above_sea_m", time_s, m.alt / 1e3 if m.fix_type >= 3 else math.nan, byte)
            log.add("speed_m_s", time_s, m.vel / 100 if fixed and m.vel != _UNKNOWN_16 else math.nan, byte)
    for time_s, m, byte in get("VFR_HUD", []) if "speed_m_s" not in log.samples else []:
        log.add("speed_m_s", time_s, m.groundspeed, byte)
    yaws = [(t, m.yaw, byte) for t, m, byte in get("ATTITUDE", [])]
    yaws = yaws or [(t, math.radians(m.hdg / 100), byte) for t, m, byte in places if m.hdg != _UNKNOWN_16]
    for row in yaws:
        log.add("vehicle_heading_rad", *row)
    _add_camera(log, said, np.array([(t, yaw) for t, yaw, _ in yaws]).reshape(-1, 2))
    return assemble(log, clock_offset_s, 0.0, from_first=True)  # its times are since 1970


def _on_vehicle_clock(log: Log, said: dict[str, Said]) -> dict[str, Said]:
    """The same messages with the times at which the vehicle sent them, by its own clock.

    Messages arrive in bursts, a second late or more; at 20 m/s that is 20 m. The smallest delay counts as zero. A
    message without a time has that of the one before. If the clocks drift apart, the times of reception are kept.
    """
    rows = sorted(((byte, time_s, m) for of in said.values() for time_s, m, byte in of), key=lambda row: row[0])
    came = np.array([time_s for _, time_s, _ in rows])
    sent = np.array([getattr(message, "time_boot_ms", np.nan) / 1e3 for *_, message in rows])
    told = np.isfinite(sent)
    if told.sum() < 2:
        return said
    apart, span_s = (came - sent)[told], float(np.ptp(sent[told]))
    alike = np.abs(apart - np.median(apart)) < 5 + 0.01 * span_s
    if alike.mean() < 0.9:  # a few may be damaged: no checksum covers the times
        log.note("the vehicle's clock and the station's drift apart: times are those of reception")
        return said
    sent = sent[np.maximum.accumulate(np.where(told, np.arange(len(sent)), np.argmax(told)))]
    times = dict(zip((byte for byte, *_ in rows), (sent + np.percentile(apart[alike], 1)).tolist(), strict=True))
    log.jitter_s = math.inf  # messages are sorted by time
    return {name: [(times[byte], message, byte) for _, message, byte in of] for name, of in said.items()}


def _add_place(log: Log, time_s: float, longitude: int, latitude: int, byte: int) -> None:
    known = abs(latitude) <= 90e7 and abs(longitude) <= 180e7
    log.add("longitude_deg", time_s, longitude / 1e7 if known else math.nan, byte)
    log.add("latitude_deg", time_s, latitude / 1e7 if known else math.nan, byte)


def _add_camera(log: Log, said: dict[str, Said], yaw: np.ndarray) -> None:
    """The gimbal's orientation, from the best kind of message in the log."""
    for time_s, m, byte in said.get("CAMERA_FOV_STATUS", []):
        if 0 < m.hfov < 180:
            log.add("hfov_rad", time_s, math.radians(m.hfov), byte)
    if rows := said.get("GIMBAL_DEVICE_ATTITUDE_STATUS", []):
        heading, pitch, roll = angles(axes_of_quaternion(np.array([m.q for _, m, _ in rows], float)))
        earth = [
            bool(m.flags & _YAW_IN_EARTH) or (m.flags & _YAW_LOCK and not m.flags & _YAW_IN_VEHICLE) for _, m, _ in rows
        ]
        turned = np.array(earth, bool)
    elif rows := said.get("MOUNT_ORIENTATION", []):
        absolute = np.array([m.yaw_absolute for _, m, _ in rows], float)
        turned = np.isfinite(absolute) & (absolute != 0)
        heading = np.radians(np.where(turned, absolute, [m.yaw for _, m, _ in rows]))
        pitch, roll = (np.radians([getattr(m, name) for _, m, _ in rows]) for name in ("pitch", "roll"))
        pitch = -pitch
    elif rows := said.get("MOUNT_STATUS", []):
        pitch, roll, heading = (
            np.radians([getattr(m, f"pointing_{axis}") / 100 for _, m, _ in rows]) for axis in "abc"
        )
        pitch, turned = -pitch, np.zeros(len(rows), bool)
        log.note("the mount's pitch and roll are taken against the horizon, its yaw against the vehicle")
    else:
        return
    times = np.array([time_s for time_s, _, _ in rows])
    heading = np.where(turned, heading, heading + heading_at(times, yaw[:, 0], yaw[:, 1]))
    for name, values in (("heading_rad", heading), ("pitch_rad", pitch), ("roll_rad", roll)):
        for (time_s, _, byte), value in zip(rows, values.tolist(), strict=True):
            log.add(name, time_s, value, byte)


# --------------------------------------------------------------------------------------------------------------------
# Messages in the file.


def looks_like_tlog(head: bytes) -> bool:
    """Whether eight bytes of time are followed by a message, and that by the next one."""
    for place in range(min(len(head), 1024)):
        end = _end(head, place)
        if end is not None and _CLOCK_US[0] < int.from_bytes(head[place : place + 8], "big") < _CLOCK_US[1]:
            return end >= len(head) - 8 or head[end + 8] in (_V1, _V2)
    return False


def messages(log: Log) -> dict[str, Said]:
    """The useful messages of one vehicle by name: time, message and byte."""
    try:
        from pymavlink.dialects.v20 import all as dialect
    except ImportError:
        raise InputError(
            f"telemetry {log.path} is a MAVLink log, which needs pymavlink: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    numbers = {getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in _WANTED}
    decoder = dialect.MAVLink(None)
    content = log.path.read_bytes()
    said: dict[tuple[int, str], Said] = {}
    bad: list[int] = []
    count = 0
    for place, end, number in _frames(log, content, decoder):
        count += 1
        if number in numbers:
            try:
                message = decoder.decode(bytearray(content[place + 8 : end]))
            except (dialect.MAVError, ValueError, TypeError):
                bad.append(place)
                continue
            time_s = int.from_bytes(content[place : place + 8], "big") / 1e6
            said.setdefault((message.get_srcSystem(), message.get_type()), []).append((time_s, message, place))
    if bad:
        log.note(f"{len(bad)} of {count} messages are damaged and left out, the first at byte {bad[0]}")
    reports = Counter({key: len(rows) for key, rows in said.items()})
    systems: Counter[int] = Counter()
    for (system, name), number in reports.items():
        systems[system] += number * (100 if name in ("GLOBAL_POSITION_INT", "GPS_RAW_INT") else 1)
    if not systems:
        raise log.refuse(f"none of its {count} MAVLink messages has a position, a height or an attitude")
    chosen = systems.most_common(1)[0][0]
    others = sorted({system for system, name in said if name == "GLOBAL_POSITION_INT"} - {chosen})
    if others:
        log.note(f"several vehicles report: system {chosen} is taken, left out are {', '.join(map(str, others))}")
    return {name: rows for (system, name), rows in said.items() if system == chosen}


def _frames(log: Log, content: bytes, decoder: Any) -> Iterator[tuple[int, int, int]]:
    """Start (of its time), end and number of each message; other bytes are skipped."""
    place, lost, lost_first = 0, 0, 0
    while place + 16 <= len(content):
        end = _end(content, place)
        if end is not None and end <= len(content) and _follows(content, place, end, decoder):
            number = content[place + 13]
            if content[place + 8] == _V2:
                number = int.from_bytes(content[place + 15 : place + 18], "little")
            yield place, end, number
            place = end
            continue
        if end is not None and end > len(content):
            break
        nearest = [found for magic in (_V1, _V2) if (found := content.find(bytes([magic]), place + 9)) >= 0]
        following = min(nearest, default=len(content) + 8) - 8
        lost, lost_first = lost + following - place, lost_first or place
        place = following
    if place < len(content):
        log.note(f"byte {min(place, len(content))}: the file ends within a message; it was cut off")
    if lost:
        log.note(f"byte {lost_first}: {lost} bytes are no MAVLink messages and left out")


def _end(content: bytes, place: int) -> int | None:
    """End of the message that begins here, or None."""
    if place + 12 > len(content):
        return None
    if content[place + 8] == _V1:
        return place + 8 + 8 + content[place + 9]
    if content[place + 8] == _V2:
        return place + 8 + 12 + content[place + 9] + (13 if content[place + 10] & _SIGNED else 0)
    return None


def _follows(content: bytes, place: int, end: int, decoder: Any) -> bool:
    """Whether another message follows, or the checksum is right."""
    if end == len(content) or (end + 8 < len(content) and content[end + 8] in (_V1, _V2)):
        return True
    try:
        return "UNKNOWN" not in decoder.decode(bytearray(content[place + 8 : end])).get_type()
    except Exception:
        return False
