"""MISB ST 0601: the local sets of keys, lengths and values that a motion imagery stream carries."""

import math
import struct
from collections.abc import Iterator
from typing import NamedTuple

KEY = bytes.fromhex("060e2b34020b01010e01030101000000")
"""The universal key of the UAS datalink local set."""

# No set of any version is longer; a damaged length would swallow the sets behind it.
_LONGEST = 1 << 16
_CHECKSUM = 1


class LocalSet(NamedTuple):
    """One packet. place: its first byte. tags: value by tag, as bytes. whole: its checksum is right."""

    place: int
    tags: dict[int, bytes]
    whole: bool


def local_sets(content: bytes) -> Iterator[LocalSet]:
    """All that begin with the universal key, in order; one that is cut off or garbled is not whole and has no tags."""
    place = content.find(KEY)
    while place >= 0:
        size = _length(content, place + len(KEY))
        if size is None or size[0] > _LONGEST or size[1] + size[0] > len(content):
            yield LocalSet(place, {}, False)
            place = content.find(KEY, place + len(KEY))
            continue
        end = size[1] + size[0]
        tags = _tags(content, size[1], end)
        whole = tags is not None and _summed(content, place, end, tags.get(_CHECKSUM))
        yield LocalSet(place, tags if tags is not None and whole else {}, whole)
        place = content.find(KEY, end if whole else place + len(KEY))


def _length(content: bytes, place: int) -> tuple[int, int] | None:
    """A length in BER, short or long, and where its value begins."""
    if place >= len(content):
        return None
    first = content[place]
    if first < 0x80:
        return first, place + 1
    count = first & 0x7F
    if not 1 <= count <= 8 or place + 1 + count > len(content):
        return None
    return int.from_bytes(content[place + 1 : place + 1 + count], "big"), place + 1 + count


def _tags(content: bytes, place: int, end: int) -> dict[int, bytes] | None:
    tags: dict[int, bytes] = {}
    while place < end:
        tag = 0
        while place < end:  # a tag in BER-OID: seven bits a byte, the last one's highest bit is 0
            byte = content[place]
            place += 1
            tag = tag << 7 | byte & 0x7F
            if byte < 0x80:
                break
        size = _length(content, place)
        if size is None or size[1] + size[0] > end:
            return None
        tags[tag] = content[size[1] : size[1] + size[0]]
        place = size[1] + size[0]
    return tags


def _summed(content: bytes, place: int, end: int, told: bytes | None) -> bool:
    """Whether the 16-bit sum over all but the last two bytes is the one told."""
    if told is None or len(told) != 2:
        return False
    packet = content[place : end - 2]
    total = (sum(packet[0::2]) << 8) + sum(packet[1::2])
    return total & 0xFFFF == int.from_bytes(told, "big") and content[end - 2 : end] == told


def mapped(value: bytes | None, low: float, high: float, signed: bool = False) -> float:
    """An integer spread over a range; a signed one's lowest value says out of range. NaN where there is none."""
    if not value or len(value) > 8:
        return math.nan
    number = int.from_bytes(value, "big", signed=signed)
    bits = 8 * len(value)
    if not signed:
        return low + number / (2**bits - 1) * (high - low)
    if number == -(2 ** (bits - 1)):
        return math.nan
    return number / (2 ** (bits - 1) - 1) * high


def imap(value: bytes | None, low: float, high: float) -> float:
    """A number as MISB ST 1201 (IMAPB) spreads it; NaN for its special values and where there is none."""
    if not value or len(value) > 8:
        return math.nan
    number, bits = int.from_bytes(value, "big"), 8 * len(value) - 1
    if number > 1 << bits:  # the highest bit alone is the upper end; with others it tells infinities and the like
        return math.nan
    scale = 2.0 ** (bits - math.ceil(math.log2(high - low)))
    offset = scale * low - math.floor(scale * low) if low < 0 < high else 0.0
    return (number - offset) / scale + low


def stamp_s(value: bytes | None) -> float:
    """Seconds since 1970 of a precision time stamp; NaN where there is none."""
    return struct.unpack(">Q", value)[0] / 1e6 if value is not None and len(value) == 8 else math.nan
