"""MPEG transport streams: metadata packets and their times."""

from collections.abc import Iterator
from dataclasses import dataclass, field

_SYNC = 0x47
_PACKET = 188
# Packets alone, with a time code of 4 bytes before each (.m2ts), or with check bytes behind.
_SPACINGS = ((188, 0), (192, 4), (204, 0))
_VIDEO_TYPES = {0x01, 0x02, 0x10, 0x1B, 0x24, 0x33}
_METADATA_IN_PES, _PRIVATE = 0x15, 0x06
_WRAP = 1 << 33
_HZ = 90_000


@dataclass
class Piece:
    """The payload of a metadata packet. time_s: since the first picture, or NaN. seen_s: time of the last video."""

    time_s: float
    seen_s: float
    content: bytes


@dataclass
class Stream:
    """Contents of a stream. damaged: first byte out of sync, and the count. cut: ends within a packet."""

    pieces: list[Piece] = field(default_factory=list)
    video: int | None = None
    metadata: int | None = None
    kinds: list[int] = field(default_factory=list)
    damaged: tuple[int, int] | None = None
    cut: bool = False


def spacing(head: bytes) -> tuple[int, int] | None:
    """Packet spacing and offset of the first sync byte, bytes; None if it is no transport stream."""
    for size, before in _SPACINGS:
        # A recording may begin within a packet.
        for first in range(before, min(before + size, len(head))):
            places = range(first, len(head), size)
            if len(places) >= 3 and sum(head[i] == _SYNC for i in places) >= 0.8 * len(places):
                return size, first
    return None


def read_stream(content: bytes, size: int, first: int) -> Stream:
    """Every metadata packet of the first programme that has any."""
    stream = Stream()
    programmes: set[int] = set()
    open_pieces: list[tuple[int | None, int, bytearray]] = []  # time stamp, the video's last one, payload
    last_video, earliest = 0, None
    for pid, starts, payload in _packets(content, size, first, stream):
        if pid == 0 and starts and not programmes:
            programmes = _programmes(payload)
        elif pid in programmes and starts and stream.metadata is None:
            _streams(payload, stream)
        elif pid == stream.video and starts:
            stamp = _stamp(payload)
            if stamp is not None:
                # Pictures are not sent in display order.
                earliest = stamp if earliest is None else min(earliest, _near(stamp, earliest))
                last_video = stamp
        elif pid == stream.metadata:
            if starts and payload[:3] == b"\0\0\1" and len(payload) > 8:
                open_pieces.append((_stamp(payload), last_video, bytearray(payload[9 + payload[8] :])))
            elif open_pieces:
                open_pieces[-1][2].extend(payload)
    origin = earliest if earliest is not None else next((p[0] for p in open_pieces if p[0] is not None), 0)
    for stamp, seen, gathered in open_pieces:
        time_s = (_near(stamp, origin) - origin) / _HZ if stamp is not None else float("nan")
        stream.pieces.append(Piece(time_s, (_near(seen, origin) - origin) / _HZ, bytes(gathered)))
    return stream


def _near(stamp: int, other: int) -> int:
    """A 33-bit time stamp, unwrapped to be near another."""
    return other + (stamp - other + _WRAP // 2) % _WRAP - _WRAP // 2


def _packets(content: bytes, size: int, first: int, stream: Stream) -> Iterator[tuple[int, bool, bytes]]:
    """Stream number, whether a unit starts, and payload of each unscrambled packet."""
    place = first
    while place + _PACKET <= len(content):
        if content[place] != _SYNC:
            found = _resynchronized(content, place + 1, size)
            stream.damaged = (place, 1) if stream.damaged is None else (stream.damaged[0], stream.damaged[1] + 1)
            if found is None:
                return
            place = found
            continue
        flags = content[place + 3]
        if flags & 0x10 and not flags & 0xC0 and not content[place + 1] & 0x80:
            begin = place + 4 + (content[place + 4] + 1 if flags & 0x20 else 0)
            pid = (content[place + 1] & 0x1F) << 8 | content[place + 2]
            if begin < place + _PACKET:
                yield pid, bool(content[place + 1] & 0x40), content[begin : place + _PACKET]
        place += size
    stream.cut = place < len(content)


def _resynchronized(content: bytes, place: int, size: int) -> int | None:
    while (place := content.find(_SYNC, place)) >= 0:
        if place + size >= len(content) or content[place + size] == _SYNC:
            return place
        place += 1
    return None


def _programmes(payload: bytes) -> set[int]:
    """Stream numbers of the programme tables."""
    table = payload[1 + payload[0] :] if payload else b""
    length = ((table[1] & 0x0F) << 8 | table[2]) if len(table) > 8 else 0
    entries = table[8 : min(3 + length - 4, len(table))]
    pairs = zip(entries[0::4], entries[1::4], entries[2::4], entries[3::4], strict=False)
    return {(c & 0x1F) << 8 | d for a, b, c, d in pairs if a or b}


def _streams(payload: bytes, stream: Stream) -> None:
    """Find the video and the MISB metadata among a programme's streams."""
    table = payload[1 + payload[0] :] if payload else b""
    if len(table) < 12 or table[0] != 0x02:
        return
    end = min(3 + ((table[1] & 0x0F) << 8 | table[2]) - 4, len(table))
    place = 12 + ((table[10] & 0x0F) << 8 | table[11])
    while place + 5 <= end:
        kind, pid = table[place], (table[place + 1] & 0x1F) << 8 | table[place + 2]
        size = (table[place + 3] & 0x0F) << 8 | table[place + 4]
        described = table[place + 5 : place + 5 + size]
        stream.kinds.append(kind)
        if kind in _VIDEO_TYPES and stream.video is None:
            stream.video = pid
        if (kind == _METADATA_IN_PES or (kind == _PRIVATE and b"KLVA" in described)) and stream.metadata is None:
            stream.metadata = pid
        place += 5 + size


def _stamp(payload: bytes) -> int | None:
    """The presentation time of a PES packet, 33 bits at 90 kHz."""
    if payload[:3] != b"\0\0\1" or len(payload) < 14 or not payload[7] & 0x80:
        return None
    a, b, c, d, e = payload[9:14]
    return (a >> 1 & 7) << 30 | b << 22 | (c >> 1) << 15 | d << 7 | e >> 1
