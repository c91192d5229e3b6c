"""Read MISB ST 0601 metadata as telemetry, beside a video in an MPEG transport stream or alone."""

import binascii
import bisect
import math
import re
import struct
from collections.abc import Iterator
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.io.telemetry.attitude import angles, axes
from torchvision_dddas.io.telemetry.record import Log, build_record, is_clock
from torchvision_dddas.types import Telemetry

KEY = bytes.fromhex("060e2b34020b01010e01030101000000")
"""The universal key of the UAS datalink local set."""

# No set of any version is longer. A damaged length would include the sets behind it.
_LONGEST = 1 << 16
_CHECKSUM, _STAMP = 1, 2
# No standard has more than a few hundred tags. An endless tag number would take time quadratic in its length.
_LARGEST_TAG = 1 << 21


class LocalSet(NamedTuple):
    """A packet. place: position of its first byte. tags: tag -> bytes. whole: whether its checksum is right."""

    place: int
    tags: dict[int, bytes]
    whole: bool


class Piece(NamedTuple):
    """The payload of a metadata packet. time_s: since the first picture, or NaN. seen_s: time of the picture before."""

    time_s: float
    seen_s: float
    content: bytes


def read_misb(path: Path, layout: tuple[int, int] | None, clock_offset_s: float) -> Telemetry:
    """Read MISB ST 0601 metadata. layout: `spacing` of the transport stream; None: the file holds local sets only.

    Times come from the stream and count from its first picture. If the stream has no times, they come from the stamps
    in the sets. The first stamp is then set to the last picture before it. Raise InputError if no metadata is intact.
    """
    log = Log(path, "MISB ST 0601 metadata", "byte", bridge_s=1.0, height_zero="ground")
    content = path.read_bytes()
    pieces = [Piece(math.nan, 0.0, content)] if layout is None else _read_stream(log, content, *layout)
    starts = [0, *accumulate(len(piece.content) for piece in pieces)]
    stream = b"".join(piece.content for piece in pieces)
    found = list(local_sets(stream))
    whole = [one for one in found if one.whole]
    if not found:
        raise log.refuse("its metadata has no MISB ST 0601 packet: the key of such packets is missing")
    if 2 * len(whole) < len(found):
        whole = _summed_otherwise(log, stream) or whole
    if not whole:
        why = "they are cut off, or their checksums are wrong in different ways"
        raise log.refuse(f"none of {len(found)} MISB ST 0601 packets is whole: {why}")
    if found[0].place and layout is None:
        log.note(f"{found[0].place} bytes before the first key are not part of a packet and are left out")
    if len(whole) < len(found):
        log.note(f"{len(found) - len(whole)} of {len(found)} packets are damaged or cut off, and are left out")
    times, start_utc_s = _times(log, whole, [pieces[bisect.bisect_right(starts, one.place) - 1] for one in whole])
    timed = np.isfinite(times)
    places = np.array([one.place for one in whole])
    values = {name: column[timed] for name, column in _quantities(log, whole).items()}
    log.moments = np.column_stack([times, times, places])[timed]
    log.add_all(times[timed], places[timed], values, known=True)
    return build_record(log, clock_offset_s, start_utc_s)


def _times(log: Log, whole: list[LocalSet], pieces: list[Piece]) -> tuple[np.ndarray, float]:
    """Return the seconds since the first picture, and the clock at it. pieces: the source of each set."""
    stream_s = np.array([piece.time_s for piece in pieces])
    stamps = np.array([stamp_s(one.tags.get(_STAMP)) for one in whole])
    clocked = np.isfinite(stamps)
    middle = float(np.median(stamps[clocked])) if clocked.any() else math.nan
    for unit, scale in (("milliseconds", 1e3), ("seconds", 1e6), ("nanoseconds", 1e-3)):
        if not is_clock(middle) and is_clock(middle * scale):
            log.note(f"the stamps of the packets count {unit}, not microseconds as in the standard")
            stamps, middle = stamps * scale, middle * scale
    if np.isfinite(stream_s).mean() > 0.5:
        apart = (stamps - stream_s)[clocked & np.isfinite(stream_s)]
        return stream_s, float(np.median(apart)) if len(apart) else math.nan
    if not clocked.any():
        raise log.refuse("neither the stream nor its metadata has times")
    first = int(np.argmax(clocked))
    start = float(stamps[first]) - pieces[first].seen_s
    if pieces[first].seen_s:
        log.note("the stream has no times for its metadata: the first packet gets the time of the picture before it")
    return stamps - start, start


def _quantities(log: Log, whole: list[LocalSet]) -> dict[str, np.ndarray]:
    def column(tag: int, low: float, high: float, signed: bool = False) -> np.ndarray:
        return np.array([mapped(one.tags.get(tag), low, high, signed) for one in whole])

    def first_known(best: np.ndarray, other: np.ndarray | float) -> np.ndarray:
        return np.where(np.isfinite(best), best, other)

    above_sea, ground = column(15, -900, 19000), column(25, -900, 19000)
    above_ground = np.array([imap(one.tags.get(113), -900, 40000) for one in whole])
    ellipsoid = first_known(np.array([imap(one.tags.get(104), -900, 40000) for one in whole]), column(75, -900, 19000))
    above_middle = first_known(above_sea - ground, ellipsoid - column(78, -900, 19000))
    if not np.isfinite(above_ground).any() and np.isfinite(above_middle).any():
        log.note("the altitude above ground counts from the ground in the picture's middle")
    vehicle_heading = np.radians(column(5, 0, 360))
    vehicle_pitch = np.radians(first_known(column(90, -90, 90, True), column(6, -20, 20, True)))
    vehicle_roll = np.radians(first_known(column(91, -90, 90, True), column(7, -50, 50, True)))
    sensor_heading, sensor_pitch = np.radians(column(18, 0, 360)), np.radians(column(19, -180, 180, True))
    sensor_roll = np.radians(first_known(column(20, 0, 360), 0.0))
    vehicle = axes(vehicle_heading, -vehicle_pitch, vehicle_roll)  # the standard's pitch is positive up
    heading, pitch, roll = angles(vehicle @ axes(sensor_heading, -sensor_pitch, sensor_roll))
    return {
        "longitude_deg": column(14, -180, 180, True),
        "latitude_deg": column(13, -90, 90, True),
        "above_sea_m": above_sea,
        "above_ellipsoid_m": ellipsoid,
        "altitude_m": first_known(above_ground, above_middle),
        "speed_m_s": column(56, 0, 255),
        "heading_rad": heading,
        "pitch_rad": pitch,
        "roll_rad": roll,
        "hfov_rad": np.radians(column(16, 0, 180)),
        "vehicle_heading_rad": vehicle_heading,
    }


# --------------------------------------------------------------------------------------------------------------------
# Local sets: keys, lengths and values (KLV).


def local_sets(content: bytes) -> Iterator[LocalSet]:
    """Yield every local set that begins with the universal key, in order. A damaged set is marked and has no tags."""
    place = content.find(KEY)
    sums = _Sums(content)
    while place >= 0:
        following = place + len(KEY)
        tags = None
        size, begin = _length(content, following)
        # Check the sum first. It takes the same time for a set of any length, and sets may lie in each other.
        if size <= _LONGEST and begin + size <= len(content) and sums.are_right(place, begin + size):
            following = begin + size
            tags = _tags(content[begin:following])
            if tags is not None and tags.get(_CHECKSUM) != content[following - 2 : following]:
                tags = None
        yield LocalSet(place, tags or {}, tags is not None)
        place = content.find(KEY, following)


def _summed_otherwise(log: Log, content: bytes) -> list[LocalSet]:
    """Return the packets of an encoder with another checksum or none; [] if checksums are wrong in different ways.

    An encoder may sum other bytes, in another order, or from another start. If a rule is right, the given checksum and
    the sum by the rule differ by the same number in each packet.
    """
    keys = [found.start() for found in re.finditer(re.escape(KEY), content)]
    framed: list[tuple[int, int, LocalSet]] = []  # begin and end of the value
    for place, following in pairwise([*keys, len(content)]):
        size, begin = _length(content, place + len(KEY))
        if begin + size <= following and (tags := _tags(content[begin : begin + size])):
            framed.append((begin, begin + size, LocalSet(place, tags, True)))
    if not any(_CHECKSUM in one.tags for *_, one in framed):
        log.note("the packets have no checksum: damage in them goes unnoticed")
        return [one for *_, one in framed]
    begins, ends, places = np.array([(begin, end, one.place) for begin, end, one in framed]).T
    given = np.array([int.from_bytes(content[end - 2 : end], "big") for end in ends])
    sums = _Sums(content)
    spans = [(start, ends - tail) for start in (places, places + len(KEY), begins) for tail in (2, 4)]
    pairs = [sums.by_turns(*span) for span in spans]
    rules = [rule for a, b in pairs for rule in ((a << 8) + b, (b << 8) + a, a + b)]
    rules += [-rule for rule in rules]  # complements
    for seed in (0xFFFF, 0):
        rules += [np.array([binascii.crc_hqx(content[a:b], seed) for a, b in np.stack(span, 1)]) for span in spans]
    alike, right = np.zeros(len(given), bool), rules[0] & 0xFFFF
    for total in (*rules, 0 * given):
        for written in (given, given >> 8 | (given & 0xFF) << 8):
            apart = (written - total) & 0xFFFF
            is_usual = apart == (usual := np.bincount(apart).argmax())
            is_sure = usual == 0 or (is_usual.sum() > 2 and len(np.unique(right[is_usual])) > 1)
            if is_sure and is_usual.sum() > max(alike.sum(), len(given) / 2):
                alike = is_usual
    if alike.any():
        log.note("the checksums are all wrong in the same way: the encoder sums other bytes. The packets are read")
    return [framed[i][2] for i in np.flatnonzero(alike)]


def _length(content: bytes, place: int) -> tuple[int, int]:
    """Return a length in BER, short or long, and where the value begins; a huge length if it is cut off."""
    first = content[place] if place < len(content) else 0xFF
    if first < 0x80:
        return first, place + 1
    end = place + 1 + (first & 0x7F)
    if not 1 <= first & 0x7F <= 8 or end > len(content):
        return 1 << 64, place
    return int.from_bytes(content[place + 1 : end], "big"), end


class _Sums:
    """Running sums of the bytes at even and at odd places, modulo 2^16. They quickly give the checksum of any part."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        values = np.frombuffer(content, np.uint8)
        self._running = []
        for odd in (0, 1):
            mine = values.copy()
            mine[1 - odd :: 2] = 0
            self._running.append(np.append(np.uint16(0), np.cumsum(mine, dtype=np.uint16)))

    def by_turns(self, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of the first, third, ... bytes of some parts, and of the second, fourth, ... bytes."""
        even, odd = (one[end].astype(int) - one[begin] for one in self._running)
        return np.where(begin % 2, odd, even), np.where(begin % 2, even, odd)

    def are_right(self, begin: int, end: int) -> bool:
        """Return whether the last two bytes are the sum of the others, with the first, third, ... bytes times 256."""
        high, low = (int(one[end - 2]) - int(one[begin]) for one in self._running[:: -1 if begin % 2 else 1])
        return ((high << 8) + low) & 0xFFFF == int.from_bytes(self._content[end - 2 : end], "big")


def _tags(content: bytes) -> dict[int, bytes] | None:
    tags: dict[int, bytes] = {}
    place = 0
    while place < len(content):
        tag = 0
        while place < len(content):  # BER-OID has seven bits a byte; the highest bit of the last byte is 0
            byte = content[place]
            place += 1
            tag = tag << 7 | byte & 0x7F
            if byte < 0x80:
                break
            if tag > _LARGEST_TAG:
                return None
        size, begin = _length(content, place)
        if begin + size > len(content):
            return None
        tags[tag] = content[begin : begin + size]
        place = begin + size
    return tags


def mapped(value: bytes | None, low: float, high: float, signed: bool = False) -> float:
    """Map an integer to a range. Return NaN for a missing value and for the lowest signed value (out of range)."""
    if not value or len(value) > 8:
        return math.nan
    number, most = int.from_bytes(value, "big", signed=signed), 2 ** (8 * len(value) - signed) - 1
    if not signed:
        return low + number / most * (high - low)
    return number / most * high if number >= -most else math.nan


def imap(value: bytes | None, low: float, high: float) -> float:
    """Map an integer to a number by MISB ST 1201 (IMAPB). Return NaN for special and missing values."""
    if not value or len(value) > 8:
        return math.nan
    number, bits = int.from_bytes(value, "big"), 8 * len(value) - 1
    if number > 1 << bits:  # the highest bit alone is the upper end; with other bits it marks special values
        return math.nan
    scale = 2.0 ** (bits - math.ceil(math.log2(high - low)))
    offset = scale * low - math.floor(scale * low) if low < 0 < high else 0.0
    return (number - offset) / scale + low


def stamp_s(value: bytes | None) -> float:
    """Return the seconds since 1970 of a precision time stamp; NaN if it is missing."""
    return struct.unpack(">Q", value)[0] / 1e6 if value is not None and len(value) == 8 else math.nan


# --------------------------------------------------------------------------------------------------------------------
# MPEG transport streams: metadata packets and their times.

_SYNC = b"G"
_PACKET = 188
# Packets alone, with a time code of 4 bytes before each (.m2ts), or with check bytes behind each.
_SPACINGS = ((188, 0), (192, 4), (204, 0))
_VIDEO_TYPES = {0x01, 0x02, 0x10, 0x1B, 0x24, 0x33}
_METADATA_IN_PES, _PRIVATE = 0x15, 0x06
_WRAP = 1 << 33
_HZ = 90_000


def spacing(head: bytes) -> tuple[int, int] | None:
    """Return the packet spacing and the offset of the first sync byte, in bytes; None if not a transport stream."""
    for size, before in _SPACINGS:
        # A recording may begin within a packet.
        for first in range(before, min(before + size, len(head))):
            marks = head[first::size]
            if len(marks) >= 3 and marks.count(_SYNC) >= 0.8 * len(marks):
                return size, first
    return None


def _read_stream(log: Log, content: bytes, size: int, first: int) -> list[Piece]:
    """Return every metadata packet of the first programme that has any. Raise InputError if there is none."""
    programmes: set[int] = set()
    streams: list[tuple[int, int, bytes]] = []
    video = metadata = None
    packets: list[tuple[int | None, int, bytearray]] = []  # time stamp, the video's last time stamp, payload
    last_video, earliest = 0, None
    for pid, starts, payload in _packets(log, content, size, first):
        if pid == 0 and starts and not programmes:
            programmes = _programmes(payload)
        elif pid in programmes and starts and metadata is None:
            added = list(_streams(payload))
            streams += added
            if video is None:
                video = next((n for kind, n, _ in added if kind in _VIDEO_TYPES), None)
            klv = [n for kind, n, text in added if kind == _METADATA_IN_PES or (kind == _PRIVATE and b"KLVA" in text)]
            metadata = klv[0] if klv else None
        elif pid == video and starts:
            if (stamp := _stamp(payload)) is not None:
                # Pictures are not sent in display order.
                earliest = stamp if earliest is None else min(earliest, _near(stamp, earliest))
                last_video = stamp
        elif pid == metadata:
            if starts and payload[:3] == b"\0\0\1" and len(payload) > 8:
                packets.append((_stamp(payload), last_video, bytearray(payload[9 + payload[8] :])))
            elif packets:
                packets[-1][2].extend(payload)
    if metadata is None:
        kinds = ", ".join(f"0x{kind:02x}" for kind, *_ in streams) or "none"
        raise log.refuse(f"this MPEG-TS carries no KLV metadata; its streams are of the types {kinds}")
    origin = earliest if earliest is not None else next((p[0] for p in packets if p[0] is not None), 0)

    def since_origin(stamp: int | None) -> float:
        return math.nan if stamp is None else (_near(stamp, origin) - origin) / _HZ

    return [Piece(since_origin(stamp), since_origin(seen), bytes(payload)) for stamp, seen, payload in packets]


def _near(stamp: int, other: int) -> int:
    """Return a 33-bit time stamp, unwrapped to be near another time stamp."""
    return other + (stamp - other + _WRAP // 2) % _WRAP - _WRAP // 2


def _packets(log: Log, content: bytes, size: int, first: int) -> Iterator[tuple[int, bool, bytes]]:
    """Yield stream number, whether a unit starts, and payload of each unscrambled packet; note damage at the end."""
    place = first
    damaged: list[int] = []
    while place + _PACKET <= len(content):
        if content[place : place + 1] != _SYNC:
            damaged.append(place)
            # Search for the next sync byte that has another sync byte one packet later.
            while (place := content.find(_SYNC, place + 1)) >= 0 and content[place + size : place + size + 1] not in (
                b"",
                _SYNC,
            ):
                pass
            if place < 0:
                break
            continue
        flags = content[place + 3]
        if flags & 0x10 and not flags & 0xC0 and not content[place + 1] & 0x80:
            begin = place + 4 + (content[place + 4] + 1 if flags & 0x20 else 0)
            pid = (content[place + 1] & 0x1F) << 8 | content[place + 2]
            if begin < place + _PACKET:
                yield pid, bool(content[place + 1] & 0x40), content[begin : place + _PACKET]
        place += size
    if damaged:
        log.note(f"byte {damaged[0]}: the transport stream is out of step, {len(damaged)} times in all")
    if 0 <= place < len(content):
        log.note(f"the file ends within a transport packet, at byte {len(content)}: it was cut off")


def _programmes(payload: bytes) -> set[int]:
    """Return the stream numbers of the programme tables."""
    table = payload[1 + payload[0] :] if payload else b""
    length = ((table[1] & 0x0F) << 8 | table[2]) if len(table) > 8 else 0
    entries = table[8 : min(3 + length - 4, len(table))]
    quads = zip(entries[0::4], entries[1::4], entries[2::4], entries[3::4], strict=False)
    return {(c & 0x1F) << 8 | d for a, b, c, d in quads if a or b}


def _streams(payload: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield the type, number and description of a programme's streams."""
    table = payload[1 + payload[0] :] if payload else b""
    if len(table) < 12 or table[0] != 0x02:
        return
    end = min(3 + ((table[1] & 0x0F) << 8 | table[2]) - 4, len(table))
    place = 12 + ((table[10] & 0x0F) << 8 | table[11])
    while place + 5 <= end:
        size = (table[place + 3] & 0x0F) << 8 | table[place + 4]
        number = (table[place + 1] & 0x1F) << 8 | table[place + 2]
        yield table[place], number, table[place + 5 : place + 5 + size]
        place += 5 + size


def _stamp(payload: bytes) -> int | None:
    """Return the presentation time of a PES packet, 33 bits at 90 kHz; None if it is missing."""
    if payload[:3] != b"\0\0\1" or len(payload) < 14 or not payload[7] & 0x80:
        return None
    a, b, c, d, e = payload[9:14]
    return (a >> 1 & 7) << 30 | b << 22 | (c >> 1) << 15 | d << 7 | e >> 1
