"""Write MISB ST 0601 local sets: the inverse of the reader in `misb`."""

import math
from collections.abc import Mapping

import numpy as np

from torchvision_dddas.io.telemetry.misb import KEY
from torchvision_dddas.types import Flight

_VERSION = 19  # of the standard


def encode_flight(flight: Flight, utc_s: float, further: Mapping[int, bytes] | None = None) -> bytes:
    """Return a local set with a report of a vehicle at utc_s, seconds since 1970. Unknown values are left out.

    further: values of other tags. The vehicle flies level. Its nose has the camera's heading if its own is unknown.
    """
    camera_deg, nose_deg = math.degrees(flight.heading_rad), math.degrees(flight.vehicle_heading_rad)
    nose_deg = camera_deg if math.isnan(nose_deg) else nose_deg
    level = 0.0 if math.isfinite(nose_deg) else math.nan
    values = {
        2: round(1e6 * utc_s).to_bytes(8, "big"),
        5: mapped(nose_deg % 360, 0, 360, 2),
        6: mapped(level, -20, 20, 2, signed=True),
        7: mapped(level, -50, 50, 2, signed=True),
        13: mapped(flight.place[1], -90, 90, 4, signed=True),
        14: mapped(flight.place[0], -180, 180, 4, signed=True),
        15: mapped(flight.above_sea_m, -900, 19000, 2),
        16: mapped(math.degrees(flight.hfov_rad), 0, 180, 2),
        18: mapped((camera_deg - nose_deg) % 360, 0, 360, 4),
        19: mapped(-math.degrees(flight.pitch_rad), -180, 180, 4, signed=True),
        20: mapped(math.degrees(flight.roll_rad) % 360, 0, 360, 4),
        56: mapped(flight.speed_m_s, 0, 255, 1),
        65: bytes([_VERSION]),
        113: imap_bytes(flight.altitude_m, -900, 40000, 4),
        **(further or {}),
    }
    return local_set({tag: value for tag, value in values.items() if value})


def local_set(tags: dict[int, bytes]) -> bytes:
    """Return a packet: the universal key, its length, the tags (below 128) and the checksum."""
    body = b"".join(bytes([tag]) + length_bytes(len(value)) + value for tag, value in tags.items()) + b"\x01\x02"
    packet = KEY + length_bytes(len(body) + 2) + body
    total = np.frombuffer(packet + b"\0" * (len(packet) % 2), ">u2").sum(dtype=np.int64)
    return packet + (int(total) & 0xFFFF).to_bytes(2, "big")


def mapped(value: float, low: float, high: float, size: int, signed: bool = False) -> bytes:
    """Return a number spread over a range as an integer of `size` bytes; no bytes if it is unknown or out of range."""
    if not low <= value <= high:
        return b""
    most = 2 ** (8 * size - signed) - 1
    number = round(value / high * most) if signed else round((value - low) / (high - low) * most)
    return number.to_bytes(size, "big", signed=signed)


def imap_bytes(value: float, low: float, high: float, size: int) -> bytes:
    """Return a number as MISB ST 1201 (IMAPB) spreads it; no bytes if it is unknown or out of range."""
    if not low <= value <= high:
        return b""
    scale = 2.0 ** (8 * size - 1 - math.ceil(math.log2(high - low)))
    offset = scale * low - math.floor(scale * low) if low < 0 < high else 0.0
    return math.floor(scale * (value - low) + offset).to_bytes(size, "big")


def length_bytes(count: int) -> bytes:
    """Return a length in BER, in one byte below 128."""
    return bytes([count]) if count < 128 else b"\x82" + count.to_bytes(2, "big")
