"""MISB ST 0601 metadata beside a video in an MPEG transport stream, or alone, as telemetry."""

import bisect
import math
import struct
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.io.telemetry.attitude import angles, axes
from torchvision_dddas.io.telemetry.log import Log, assemble
from torchvision_dddas.io.telemetry.transport import Piece, Stream, read_stream
from torchvision_dddas.types import Telemetry

KEY = bytes.fromhex("060e2b34020b01010e01030101000000")
"""The universal key of the UAS datalink local set."""

# No set of any version is longer; a damaged length would swallow the sets behind it.
_LONGEST = 1 << 16
_CHECKSUM = 1
_STAMP = 2


class LocalSet(NamedTuple):
    """A packet. place: its first byte. tags: bytes by tag. whole: its checksum is right."""

    place: int
    tags: dict[int, bytes]
    whole: bool


def read_misb(path: Path, layout: tuple[int, int] | None, clock_offset_s: float) -> Telemetry:
    """Read MISB ST 0601 metadata. layout: the transport stream's `spacing`; None for bare local sets.

    Times are the stream's, since its first picture; without them the sets' own stamps, the first of which is aligned
    with the last picture before it. Raises InputError without intact metadata.
    """
    log = Log(path, "MISB ST 0601 metadata", "byte", bridge_s=1.0)
    content = path.read_bytes()
    if layout is None:
        pieces = [Piece(math.nan, 0.0, content)]
    else:
        stream = read_stream(content, *layout)
        _note_damage(log, stream, len(content))
        if stream.metadata is None:
            kinds = ", ".join(f"0x{kind:02x}" for kind in stream.kinds) or "none"
            raise log.refuse(f"this MPEG-TS carries no KLV metadata; its streams are of the types {kinds}")
        pieces = stream.pieces
    joined = b"".join(piece.content for piece in pieces)
    starts = [0, *accumulate(len(piece.content) for piece in pieces)]
    found = list(local_sets(joined))
    whole = [one for one in found if one.whole]
    if not found:
        raise log.refuse("its metadata has no MISB ST 0601 packet, nothing begins with the key of one")
    if not whole:
        raise log.refuse(f"none of {len(found)} MISB ST 0601 packets is whole: their checksums are wrong")
    if len(whole) < len(found):
        log.note(f"{len(found) - len(whole)} of {len(found)} packets are damaged or cut off and left out")
    belonging = [pieces[bisect.bisect_right(starts, one.place) - 1] for one in whole]
    times, start_utc_s = _times(log, whole, belonging)
    _say(log, times, whole)
    return assemble(log, clock_offset_s, start_utc_s)


def _note_damage(log: Log, stream: Stream, size: int) -> None:
    if stream.damaged is not None:
        log.note(f"byte {stream.damaged[0]}: the transport stream is out of step, {stream.damaged[1]} times in all")
    if stream.cut:
        log.note(f"the file ends within a transport packet, at byte {size}: it was cut off")


def _times(log: Log, whole: list[LocalSet], belonging: list[Piece]) -> tuple[np.ndarray, float]:
    """Seconds since the first picture, and the clock at it."""
    told = np.array([piece.time_s for piece in belonging])
    stamps = np.array([stamp_s(one.tags.get(_STAMP)) for one in whole])
    clocked = np.isfinite(stamps)
    if np.isfinite(told).mean() > 0.5:
        apart = (stamps - told)[clocked & np.isfinite(told)]
        return told, float(np.median(apart)) if len(apart) else math.nan
    if not clocked.any():
        raise log.refuse("neither the stream nor its metadata has times")
    first = int(np.argmax(clocked))
    start = float(stamps[first]) - belonging[first].seen_s
    if belonging[first].seen_s:
        log.note("the stream has no times for its metadata: the first is aligned with the picture before it")
    return stamps - start, start


def _say(log: Log, times: np.ndarray, whole: list[LocalSet]) -> None:
    def column(tag: int, low: float, high: float, signed: bool = False) -> np.ndarray:
        return np.array([mapped(one.tags.get(tag), low, high, signed) for one in whole])

    above_sea = column(15, -900, 19000)
    ground = column(25, -900, 19000)
    agl = np.array([imap(one.tags.get(113), -900, 40000) for one in whole])
    if not np.isfinite(agl).any() and np.isfinite(ground).any():
        log.note("the altitude above ground is that above the ground in the picture's middle")
    full = [column(tag, -90, 90, True) for tag in (90, 91)]
    platform = [
        column(5, 0, 360),
        np.where(np.isfinite(full[0]), full[0], column(6, -20, 20, True)),
        np.where(np.isfinite(full[1]), full[1], column(7, -50, 50, True)),
    ]
    roll = column(20, 0, 360)
    sensor = [column(18, 0, 360), column(19, -180, 180, True), np.where(np.isfinite(roll), roll, 0.0)]
    heading, pitch, rolled = angles(_turned(platform) @ _turned(sensor))
    longitude, latitude = column(14, -180, 180, True), column(13, -90, 90, True)
    said = {
        "longitude_deg": longitude,
        "latitude_deg": latitude,
        "above_sea_m": above_sea,
        "altitude_m": np.where(np.isfinite(agl), agl, above_sea - ground),
        "speed_m_s": column(56, 0, 255),
        "heading_rad": heading,
        "pitch_rad": pitch,
        "roll_rad": rolled,
        "hfov_rad": np.radians(column(16, 0, 180)),
        "vehicle_heading_rad": np.radians(platform[0]),
    }
    for number, (time_s, one) in enumerate(zip(times.tolist(), whole, strict=True)):
        if math.isfinite(time_s):
            log.moments.append((time_s, one.place))
            for name, values in said.items():
                if math.isfinite(values[number]):
                    log.add(name, time_s, float(values[number]), one.place)


def _turned(degrees: list[np.ndarray]) -> np.ndarray:
    """The axes of heading, pitch up and roll."""
    heading, pitch_up, roll = (np.radians(part) for part in degrees)
    return axes(heading, -pitch_up, roll)


# --------------------------------------------------------------------------------------------------------------------
# Local sets: keys, lengths and values (KLV).


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
