"""Read MAVLink telemetry logs. Each message follows the time at which a ground station received it."""

import binascii
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.autopilots import NAMES, Topics, add_topic, build_flight, start_clock
from torchvision_dddas.io.telemetry.record import Log, is_clock
from torchvision_dddas.types import Telemetry

_V1, _V2 = 0xFE, 0xFD
_MAGIC = re.compile(bytes([0x5B, _V1, _V2, 0x5D]))  # either byte
_SIGNED = 0x01
_MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_V2_MIRRORED, _SIGNED_MIRRORED = _MIRROR[_V2], _MIRROR[_SIGNED]
_LATEST_US = 7_258_118_400_000_000  # the year 2200; a computer without a clock begins in 1970
_PLACES = ("GLOBAL_POSITION_INT", "GPS_RAW_INT", "GPS2_RAW")
_OF_PARTS = ("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION", "MOUNT_STATUS", "CAMERA_FOV_STATUS")
HEARTBEAT, SYSTEM_TIME = 0, 2
_ENOUGH = 5  # useful messages of either kind that are read from a sender
# Kinds of senders in heartbeats (MAV_TYPE): ground stations and antenna trackers; and parts of a vehicle.
_STATIONS, _PARTS = {5, 6}, {18, 26, 27, *range(30, 35), *range(36, 43), 44, 48}
# Senders without a heartbeat: stations have a higher system number or this component, autopilots are component 1.
_LAST_VEHICLE, _STATION_COMPONENT, _AUTOPILOT = 250, 190, 1
# Clocks further apart than this differ by more than the delay of messages.
_APART_S = 60.0

Sender = tuple[int, int]
"""The numbers of the system and the component."""
Row = tuple[float, Any, int]
"""The time of reception, the message, and the place of its first byte."""


def read_tlog(path: Path, clock_offset_s: float) -> Telemetry:
    """Read positions and attitudes of one vehicle, never of a ground station. Times count from the first sample.

    Raise InputError if no vehicle reports any.
    """
    log = Log(path, "MAVLink log", "byte", bridge_s=2.0)
    topics, clock_s = _mavlink_topics(log)
    for fused in topics.get("GLOBAL_POSITION_INT", {}).values():
        fused["speed"] = np.hypot(fused["vx"], fused["vy"])
    return build_flight(log, topics, clock_offset_s, clock_s)


def _mavlink_topics(log: Log) -> tuple[Topics, float]:
    """Return the messages of one vehicle by name and sender, with their times of sending, and the clock at time 0."""
    try:
        from pymavlink.dialects.v20 import all as dialect
    except ImportError:
        raise InputError(
            f"telemetry {log.path} is a MAVLink log, which needs pymavlink: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    numbers = {n for n, kind in dialect.mavlink_map.items() if kind.msgname in (*NAMES, "HEARTBEAT", "SYSTEM_TIME")}
    decoder = dialect.MAVLink(None)
    content = log.path.read_bytes()
    rows: dict[Sender, list[Row]] = {}
    kinds: dict[Sender, int] = {}
    heard = Counter[tuple[Sender, int]]()
    bad: list[int] = []
    count = 0
    extras = {number: _MIRROR[kind.crc_extra : kind.crc_extra + 1] for number, kind in dialect.mavlink_map.items()}
    for place, end, number in _frames(log, content, extras):
        count += 1
        if number not in numbers:
            continue
        first = place + (13 if content[place + 8] == _V2 else 11)
        sender = content[first], content[first + 1]
        is_call = number in (HEARTBEAT, SYSTEM_TIME)
        if is_call and heard[sender, number] >= _ENOUGH:
            continue
        try:
            message = decoder.decode(bytearray(content[place + 8 : end]))
        except (dialect.MAVError, ValueError, TypeError):
            bad.append(place)
            continue
        if number == HEARTBEAT:
            kinds[sender] = message.type
        else:
            came_s = int.from_bytes(content[place : place + 8], "big") / 1e6
            rows.setdefault(sender, []).append((came_s, message, place))
        if is_call:
            heard[sender, number] += number == HEARTBEAT or is_clock(message.time_unix_usec / 1e6)
    if bad:
        log.note(f"{len(bad)} of {count} messages are damaged and left out, the first at byte {bad[0]}")
    if all(message.get_type() == "SYSTEM_TIME" for part in rows.values() for _, message, _ in part):
        raise log.refuse(f"none of its {count} MAVLink messages has a position, a height or an attitude")
    chosen, others = _choose_vehicle(log, rows, kinds)
    topics: Topics = {}
    came = np.array([came_s for part in rows.values() for came_s, *_ in part])
    is_timed = bool(is_clock(came).sum() > max(1, 0.01 * len(came)))  # a single damaged time is no clock
    for sender, part in sorted(rows.items(), key=lambda item: (item[0][0] != chosen[0], item[0])):
        if sender[0] in others:
            continue
        label = f"component {sender[1]}" + f" of system {sender[0]}" * (sender[0] != chosen[0])
        times = _sending_times(log, part, is_timed)
        indices: dict[str, list[int]] = {}
        for i, (_, message, _) in enumerate(part):
            indices.setdefault(message.get_type(), []).append(i)
        for name, index in indices.items():
            if sender == chosen or name in _OF_PARTS:
                messages = [part[i][1] for i in index]
                topic = {field: np.array([getattr(m, field) for m in messages]) for field in messages[0].fieldnames}
                topic |= {"time_s": times[index], "where": np.array([part[i][2] for i in index])}
                add_topic(topics, name, label, topic)
    return topics, _clock(log, topics, is_timed)


def _choose_vehicle(log: Log, rows: Mapping[Sender, list[Row]], kinds: Mapping[Sender, int]) -> tuple[Sender, set[int]]:
    """Return the vehicle with the most places, and the systems to leave out. Prefer autopilots to parts of vehicles.

    kinds: the senders' MAV_TYPE in their heartbeats. Raise InputError if all senders are ground stations.
    """
    stations = {system for (system, _), kind in kinds.items() if kind in _STATIONS}
    places = Counter(
        sender
        for sender, part in rows.items()
        for _, m, _ in part
        if m.get_type() in _PLACES and (m.lat != 0 or m.lon != 0) and getattr(m, "fix_type", 3) > 1
    )

    def trust(sender: Sender) -> int:
        kind, (system, component) = kinds.get(sender), sender
        if kind in _STATIONS or component == _STATION_COMPONENT:
            return 0
        if kind is None:
            return 0 if system in stations or system > _LAST_VEHICLE else 1 + (component == _AUTOPILOT)
        return 1 if kind in _PARTS else 3

    # A station may send nothing but its place, under any number and without heartbeats. A vehicle sends more.
    talks = {sender: len({m.get_type() for _, m, _ in part[:200]}) > 1 for sender, part in rows.items()}
    chosen = max(
        sorted(rows), key=lambda s: (trust(s) // 3, min(trust(s), places[s], 1), trust(s), talks[s], places[s])
    )
    if not trust(chosen):
        raise log.refuse("it has only messages of ground stations; give the log that holds the vehicle's messages")
    others = [s for s in sorted(places) if s != chosen]
    names = [f"{system}" if system != chosen[0] else f"its component {component}" for system, component in others]
    names = [name + " (ground station)" * (not trust(s)) for name, s in zip(names, others, strict=True)]
    if others:
        log.note(f"several vehicles report: system {chosen[0]} is used; left out: {', '.join(names[:9])}")
    return chosen, {s[0] for s in rows if places[s] or not trust(s)} - {chosen[0]}


def _clock(log: Log, topics: Topics, is_timed: bool) -> float:
    """Return the seconds since 1970 at the station's time 0: 0, or the value by the vehicle's SYSTEM_TIME."""
    told = [(topic["time_unix_usec"] / 1e6, topic["time_s"]) for topic in topics.get("SYSTEM_TIME", {}).values()]
    behind_s = start_clock(told)
    if not told or not is_clock(behind_s + told[0][1][0]) or (is_timed and abs(behind_s) < _APART_S):
        return 0.0  # if the station's clock is impossible, too, `build_record` notes it
    log.note(f"the station's clock is {behind_s:.0f} s behind the vehicle's SYSTEM_TIME, which is used")
    return behind_s


def _sending_times(log: Log, part: list[Row], is_timed: bool) -> np.ndarray:
    """Return when a sender sent each message, by its own clock. is_timed: whether the station has a clock.

    Messages arrive in bursts, a second late or more: an error of 20 m at 20 m/s. The smallest delay counts as zero. A
    message without a time has the previous time. If the clocks drift apart, the times of reception are kept.
    """
    came = np.array([came_s for came_s, *_ in part])
    came[is_timed & ~is_clock(came)] = np.nan  # before the station's clock was set, or damaged
    sent = np.array([getattr(message, "time_boot_ms", np.nan) / 1e3 for _, message, _ in part])
    is_known, is_usable = np.isfinite(sent), np.isfinite(sent + came)
    span_s = float(np.ptp(sent[is_usable])) if is_usable.any() else 0.0
    if span_s > 0:
        apart = (came - sent)[is_usable]
        alike = np.abs(apart - np.median(apart)) < 5 + 0.01 * span_s
        if alike.mean() >= 0.9:  # a few may be damaged: no checksum covers the times
            log.jitter_s = math.inf  # messages are sorted by time
            latest = np.maximum.accumulate(np.where(is_known, np.arange(len(sent)), np.argmax(is_known)))
            return sent[latest] + np.percentile(apart[alike], 1)
        log.note("the vehicle's clock and the station's drift apart: the times of reception are used")
    if np.isnan(came).any():
        log.note(f"{np.isnan(came).sum()} messages came at impossible times and are left out")
    return came


def looks_like_tlog(head: bytes) -> bool:
    """Return whether a message follows eight bytes of time, and another message follows the first."""
    for place in range(min(len(head), 1024)):
        end = _end(head, place)
        if end is not None and int.from_bytes(head[place : place + 8], "big") < _LATEST_US:
            return end >= len(head) - 8 or head[end + 8] in (_V1, _V2)
    return False


def message_end(content: bytes) -> int:
    """Return the end of the message that begins a datagram; that of the datagram if none begins it."""
    end = _end(bytes(8) + content, 0)
    return len(content) if end is None else min(end - 8, len(content))


def message_parts(message: bytes) -> tuple[int, int, bytes]:
    """Return the number, the system and the payload of a message."""
    if message[0] == _V2:
        return int.from_bytes(message[7:10], "little"), message[5], message[10 : 10 + message[1]]
    return message[5], message[3], message[6 : 6 + message[1]]


def _frames(log: Log, content: bytes, extras: Mapping[int, bytes]) -> Iterator[tuple[int, int, int]]:
    """Yield the start (of its time), end and number of each message; skip other bytes. extras: see `_is_whole`."""
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
        log.note(f"byte {lost_first}: {lost} bytes are not MAVLink messages and are left out")


def _end(content: bytes, place: int) -> int | None:
    """Return the end of the message whose time begins at place, or None."""
    if place + 12 > len(content):
        return None
    if content[place + 8] == _V1:
        return place + 16 + content[place + 9]
    if content[place + 8] == _V2:
        return place + 20 + content[place + 9] + (13 if content[place + 10] & _SIGNED else 0)
    return None


def _is_whole(mirrored: bytes, begin: int, end: int, extra: bytes) -> bool:
    """Return whether the checksum of a message is right, CRC-16/MCRF4XX.

    mirrored: the log with the bits of each byte reversed. On these bytes, `binascii` gives the same checksum quickly,
    which matters because any byte may look like the start of a message. extra: the reversed byte that the kind adds.
    """
    if mirrored[begin] == _V2_MIRRORED and mirrored[begin + 2] & _SIGNED_MIRRORED:
        end -= 13
    found = binascii.crc_hqx(extra, binascii.crc_hqx(mirrored[begin + 1 : end - 2], 0xFFFF))
    return mirrored[end - 2 : end] == found.to_bytes(2, "big")
