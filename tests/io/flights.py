"""A flight written down the way that autopilots, receivers and cameras write it, for tests of reading it back."""

import functools
import struct
from collections.abc import Iterable, Mapping, Sequence

KEY = bytes.fromhex("060e2b34020b01010e01030101000000")


# -- MISB ST 0601 in MPEG-TS -------------------------------------------------------------------------------------------


def spread(value: float, low: float, high: float, size: int, signed: bool = False) -> bytes:
    """A number over a range as an integer of so many bytes; signed ones over +-high, as ST 0601 has them."""
    most = 2 ** (8 * size - signed) - 1
    number = round(value / high * most) if signed else round((value - low) / (high - low) * most)
    return number.to_bytes(size, "big", signed=signed)


def local_set(tags: dict[int, bytes], long_length: bool = False) -> bytes:
    """A packet with its checksum, the last of its tags."""
    body = b"".join(bytes([tag, len(value)]) + value for tag, value in tags.items()) + b"\x01\x02"
    length = len(body) + 2
    size = bytes([0x82]) + length.to_bytes(2, "big") if long_length or length > 127 else bytes([length])
    packet = KEY + size + body
    total = sum(byte << (8 * ((i + 1) % 2)) for i, byte in enumerate(packet)) & 0xFFFF
    return packet + total.to_bytes(2, "big")


START_US = 1_340_980_354_100_000
PLACE = {13: spread(34.7211, 0, 90, 4, True), 14: spread(-86.6891, 0, 180, 4, True), 15: spread(3048, -900, 19000, 2)}


def packet(i: int, tags: Mapping[int, bytes] = {}) -> bytes:
    """The place 40 ms after the packet before, and further tags."""
    return local_set({2: (START_US + i * 40_000).to_bytes(8, "big"), **PLACE, **tags})


def attitude(heading: float, pitch: float, roll: float, azimuth: float, elevation: float, turn: float) -> dict:
    vehicle = {5: spread(heading, 0, 360, 2), 6: spread(pitch, 0, 20, 2, True), 7: spread(roll, 0, 50, 2, True)}
    camera = {18: spread(azimuth, 0, 360, 4), 19: spread(elevation, 0, 180, 4, True), 20: spread(turn, 0, 360, 4)}
    return {**vehicle, **camera}


def _pes(stream: int, payload: bytes, pts: int | None) -> bytes:
    head = bytes([0x80, 0x00, 0])
    if pts is not None:
        a, b, c, d, e = pts >> 30 & 7, pts >> 22 & 0xFF, pts >> 15 & 0x7F, pts >> 7 & 0xFF, pts & 0x7F
        head = bytes([0x80, 0x80, 5, 0x21 | a << 1, b, c << 1 | 1, d, e << 1 | 1])
    return b"\0\0\1" + bytes([stream]) + (len(head) + len(payload)).to_bytes(2, "big") + head + payload


def _packets(pid: int, content: bytes) -> Iterable[bytes]:
    for place in range(0, len(content), 184):
        part = content[place : place + 184]
        filling = 184 - len(part)
        head = bytes([0x47, (0x40 if place == 0 else 0) | pid >> 8, pid & 0xFF, 0x30 if filling else 0x10])
        if filling:
            head += bytes([filling - 1]) + (b"\0" + b"\xff" * (filling - 2) if filling > 1 else b"")
        yield head + part


def transport_stream(
    video_pts: Sequence[int], metadata: Sequence[tuple[int | None, bytes]], kind: int = 0x06, before: bytes = b""
) -> bytes:
    """Pictures and metadata by turns, each with its time stamp; `before`: bytes before each packet, as in .m2ts."""
    described = b"\x05\x04KLVA"
    pat = b"\0" + bytes([0, 0xB0, 13, 0, 1, 0xC1, 0, 0, 0, 1, 0xE1, 0x00]) + b"\0\0\0\0"
    streams = bytes([0x1B, 0xE1, 0x01, 0xF0, 0]) + bytes([kind, 0xE1, 0x02, 0xF0, len(described)]) + described
    pmt = b"\0" + bytes([2, 0xB0, 13 + len(streams), 0, 1, 0xC1, 0, 0, 0xE1, 0x01, 0xF0, 0]) + streams + b"\0\0\0\0"
    parts = [*_packets(0, pat), *_packets(0x100, pmt)]
    for i in range(max(len(video_pts), len(metadata))):
        if i < len(video_pts):
            parts += _packets(0x101, _pes(0xE0, bytes(300), video_pts[i]))
        if i < len(metadata):
            parts += _packets(0x102, _pes(0xBD, metadata[i][1], metadata[i][0]))
    return b"".join(before + part for part in parts)


# -- MAVLink -----------------------------------------------------------------------------------------------------------


def tlog(messages: Iterable[tuple[float, str, dict]], system: int = 1, version: int = 2, component: int = 1) -> bytes:
    """Each message (seconds since 1970 at which it came, name, fields) behind its time."""
    from pymavlink.dialects.v20 import all as dialect

    sender = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    content = b""
    for time_s, name, fields in messages:
        message = getattr(dialect, f"MAVLink_{name.lower()}_message")(**fields)
        content += struct.pack(">Q", round(time_s * 1e6)) + bytes(message.pack(sender, force_mavlink1=version == 1))
    return content


def global_position(time_boot_ms: int, lon: float, lat: float, above_m: float = 50.0, v_m_s: float = 5.0) -> dict:
    heights = {"alt": round((above_m + 100) * 1000), "relative_alt": round(above_m * 1000)}
    place = {"lat": round(lat * 1e7), "lon": round(lon * 1e7)}
    return {"time_boot_ms": time_boot_ms, **place, **heights, "vx": round(v_m_s * 100), "vy": 0, "vz": 0, "hdg": 9000}


CLOCK_S = 1_533_737_161.0


def eastward(count: int = 20, step_s: float = 0.25, delays_s: Sequence[float] = ()) -> list[tuple[float, str, dict]]:
    """Positions eastwards, each followed by an attitude whose heading is 100 degrees."""
    said: list[tuple[float, str, dict]] = []
    for i in range(count):
        came, boot_ms = CLOCK_S + i * step_s + (delays_s[i] if delays_s else 0), round(5000 + 1000 * i * step_s)
        said.append((came, "GLOBAL_POSITION_INT", global_position(boot_ms, 149.0 + i * 1e-5, -35.0, 50 + i)))
        still = dict.fromkeys(("roll", "pitch", "rollspeed", "pitchspeed", "yawspeed"), 0)
        said.append((came, "ATTITUDE", {"time_boot_ms": boot_ms + 10, "yaw": 1.7453293, **still}))
    return said


# -- PX4 ---------------------------------------------------------------------------------------------------------------

_LETTERS = {"uint64_t": "Q", "float": "f", "double": "d", "int32_t": "i", "uint8_t": "B", "bool": "B", "uint16_t": "H"}


def ulog(topics: Mapping[str, tuple[Sequence[str], Sequence[Sequence[float]]]]) -> bytes:
    """Topics: (type and name of the fields behind the time stamp, rows with the time in microseconds first).

    The name of an instance other than the first ends with its number: `sensor_gps 1`.
    """
    content = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<H", len(body)) + kind + body

    for name, fields in {name.split()[0]: fields for name, (fields, _) in topics.items()}.items():
        content += message(b"F", f"{name}:{';'.join(['uint64_t timestamp', *fields])};".encode())
    for number, name in enumerate(topics):
        name, _, instance = name.partition(" ")
        content += message(b"A", struct.pack("<BH", int(instance or 0), number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        pattern = "<HQ"
        for field in fields:
            kind, _, count = field.split()[0].rstrip("]").partition("[")
            pattern += f"{count or 1}{_LETTERS[kind]}"
        for row in rows:
            content += message(b"D", struct.pack(pattern, number, *row))
    return content


# -- ArduPilot's DataFlash ---------------------------------------------------------------------------------------------

_CODES = {"Q": "Q", "B": "B", "I": "I", "H": "H", "f": "f", "d": "d", "L": "i", "c": "h", "C": "H"}
_PER_UNIT = {"L": 1e7, "c": 100, "C": 100}


def dataflash(kinds: Mapping[str, tuple[str, str]], rows: Iterable[tuple]) -> bytes:
    """A binary log. kinds: letters of the format and the columns by message. rows: message and its values, in order."""
    content, numbers = b"", {name: 129 + k for k, name in enumerate(kinds)}
    for name, letters, columns in (
        ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        *((name, *kind) for name, kind in kinds.items()),
    ):
        size = 89 if name == "FMT" else 3 + struct.calcsize("<" + "".join(_CODES[letter] for letter in letters))
        texts = (name.encode(), letters.encode(), columns.encode())
        content += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", numbers.get(name, 128), size, *texts)
    for name, *values in rows:
        letters = kinds[name][0]
        raw = [round(v * _PER_UNIT[c]) if c in _PER_UNIT else v for c, v in zip(letters, values, strict=True)]
        pattern = "<" + "".join(_CODES[letter] for letter in letters)
        content += b"\xa3\x95" + bytes([numbers[name]]) + struct.pack(pattern, *raw)
    return content


def dataflash_text(kinds: Mapping[str, tuple[str, str]], rows: Iterable[tuple], comma: str = ", ") -> str:
    """The same log as text."""
    lines = [f"FMT, 128, 89, FMT, BBnNZ, {comma.join(['Type', 'Length', 'Name', 'Format', 'Columns'])}"]
    lines += [
        f"FMT, {129 + k}, 50, {name}, {letters}, {columns}"
        for k, (name, (letters, columns)) in enumerate(kinds.items())
    ]
    lines += [", ".join(map(str, row)) for row in rows]
    return "\n".join(lines).replace(", ", comma)


# -- NMEA 0183 ---------------------------------------------------------------------------------------------------------


def sentence(body: str) -> str:
    """A sentence with its checksum."""
    return f"${body}*{functools.reduce(lambda total, letter: total ^ ord(letter), body, 0):02X}"
