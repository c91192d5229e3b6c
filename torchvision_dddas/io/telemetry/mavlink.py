"""MAVLink messages of a ground station's log, each behind the time at which it came."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.log import Log

Said = list[tuple[float, Any, int]]
"""Time at which each came, message, and its first byte."""

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
# Of a log that begins or ends outside these the clock is none: 2000 and 2200.
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


def looks_like_tlog(head: bytes) -> bool:
    """Whether a message stands behind eight bytes of time, and the next one behind it."""
    for place in range(min(len(head), 1024)):
        end = _end(head, place)
        if end is not None and _CLOCK_US[0] < int.from_bytes(head[place : place + 8], "big") < _CLOCK_US[1]:
            return end >= len(head) - 8 or head[end + 8] in (_V1, _V2)
    return False


def messages(log: Log) -> dict[str, Said]:
    """Those that tell something, by name: time, message and byte; of one vehicle."""
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
        raise log.refuse(f"none of its {count} MAVLink messages tells a place, a height or an attitude")
    chosen = systems.most_common(1)[0][0]
    others = sorted({system for system, name in said if name == "GLOBAL_POSITION_INT"} - {chosen})
    if others:
        log.note(f"several vehicles report: system {chosen} is taken, left out are {', '.join(map(str, others))}")
    return {name: rows for (system, name), rows in said.items() if system == chosen}


def _frames(log: Log, content: bytes, decoder: Any) -> Iterator[tuple[int, int, int]]:
    """Where each message's time begins, where it ends, and its number. Steps over what is none."""
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
    """Where a message would end that begins here; None if none does."""
    if place + 12 > len(content):
        return None
    if content[place + 8] == _V1:
        return place + 8 + 8 + content[place + 9]
    if content[place + 8] == _V2:
        return place + 8 + 12 + content[place + 9] + (13 if content[place + 10] & _SIGNED else 0)
    return None


def _follows(content: bytes, place: int, end: int, decoder: Any) -> bool:
    """Whether the next message begins where this one ends; else whether its checksum is right."""
    if end == len(content) or (end + 8 < len(content) and content[end + 8] in (_V1, _V2)):
        return True
    try:
        return "UNKNOWN" not in decoder.decode(bytearray(content[place + 8 : end])).get_type()
    except Exception:
        return False
