"""Write MISB ST 0903 VMTI local sets: the targets of a picture, as item 74 of a MISB ST 0601 local set."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from torchvision_dddas.io.telemetry.misb_packets import imap_bytes, length_bytes

VMTI = 74
"""The item of MISB ST 0601 for the set."""

_VERSION = 5  # ST 0903.5
_MOST = 500  # targets in a set; the set also states the number of all targets
_LARGEST_ID = 2_097_151
_OFFSET = -19.2, 19.2, 3  # range in degrees, and bytes


class VmtiTarget(NamedTuple):
    """A target. box_px: x, y, width, height. score: in [0, 1]. place: longitude, latitude, height above the ellipsoid.

    Unknown values are NaN.
    """

    identity: int
    box_px: Sequence[float]
    score: float = math.nan
    place: Sequence[float] = (math.nan, math.nan, math.nan)


def encode_vmti(
    frame: int,
    size_px: tuple[int, int],
    targets: Sequence[VmtiTarget],
    sensor: str = "",
    centre_deg: tuple[float, float] = (math.nan, math.nan),
) -> bytes:
    """Return the items of a local set without key and checksum, as it is embedded. size_px: (width, height).

    frame: number of the picture. sensor: name of the camera. centre_deg: longitude and latitude of the picture's middle
    as in items 24 and 23 of the set around it, from which places without a height count. A target without a pixel
    inside the picture is left out.
    """
    packs = [pack for target in targets if (pack := _pack(target, size_px, centre_deg))]
    shown = packs[:_MOST]
    items = [
        (3, b"torchvision_dddas"),
        (4, bytes([_VERSION])),
        (5, _least_bytes(len(packs))),
        (6, _least_bytes(len(shown))),
        (7, _least_bytes(frame)),
        (8, _least_bytes(size_px[0])),
        (9, _least_bytes(size_px[1])),
        (10, sensor.encode()[:127]),
        (101, b"".join(length_bytes(len(pack)) + pack for pack in shown)),
    ]
    return b"".join(_item(tag, value) for tag, value in items if value)


def _pack(target: VmtiTarget, size_px: tuple[int, int], centre_deg: tuple[float, float]) -> bytes:
    """Return a VTarget pack: the identity, and items; no bytes if the set cannot hold the target."""
    width, height = size_px
    if not all(map(math.isfinite, target.box_px)):
        return b""
    x, y, across, down = map(round, target.box_px)
    left, top, right, bottom = max(x, 0), max(y, 0), min(x + across, width) - 1, min(y + down, height) - 1
    if left > right or top > bottom or not 0 < target.identity <= _LARGEST_ID:
        return b""

    def number(column: int, row: int) -> bytes:
        """Return the number of a pixel, which counts from 1 row by row."""
        return _least_bytes(1 + column + row * width)

    items = [(1, number((left + right) // 2, (top + bottom) // 2)), (2, number(left, top)), (3, number(right, bottom))]
    if 0 <= target.score <= 1:
        items.append((5, bytes([round(100 * target.score)])))
    longitude, latitude, up_m = target.place
    place = imap_bytes(latitude, -90, 90, 4), imap_bytes(longitude, -180, 180, 4), imap_bytes(up_m, -900, 19000, 2)
    offset = imap_bytes(latitude - centre_deg[1], *_OFFSET), imap_bytes(longitude - centre_deg[0], *_OFFSET)
    if all(place):
        items.append((17, b"".join(place)))
    elif all(offset):
        items += [(10, offset[0]), (11, offset[1])]
    return _identity_bytes(target.identity) + b"".join(_item(tag, value) for tag, value in items)


def _item(tag: int, value: bytes) -> bytes:
    return bytes([tag]) + length_bytes(len(value)) + value


def _least_bytes(number: int) -> bytes:
    """Return a number in as few bytes as it needs."""
    return number.to_bytes(max(1, (number.bit_length() + 7) // 8), "big")


def _identity_bytes(number: int) -> bytes:
    """Return a number in BER-OID: seven bits a byte, and the highest bit in all but the last."""
    groups = [number >> shift & 0x7F for shift in (14, 7, 0) if number >> shift or not shift]
    return bytes([*(group | 0x80 for group in groups[:-1]), groups[-1]])
