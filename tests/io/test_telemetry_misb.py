"""MISB ST 0601 in transport streams: packets, times, and where a camera looks that turns in a vehicle that turns."""

import binascii
import math

import numpy as np
import pytest

from tests.io.flights import PLACE, START_US, attitude, local_set, packet, spread, transport_stream
from torchvision_dddas.geometry.projection import axes_of
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.attitude import angles, axes, axes_of_quaternion
from torchvision_dddas.io.telemetry.misb import imap, local_sets, mapped


@pytest.fixture
def fly_packets(fly):
    """Telemetry from a stream with a packet each 40 ms; further tags of each."""

    def read(tags, damage=bytes):
        metadata = [(3600 * i, packet(i, more)) for i, more in enumerate(tags)]
        return fly(damage(transport_stream([3600 * i for i in range(len(tags))], metadata)), "a.ts")

    return read


@pytest.mark.parametrize(
    ("coded", "span", "value"),
    [
        # ST 0601 gives an encoded example beside each tag.
        ("71C2", (0, 360), 159.9744),
        ("FD3D", (-20, 20, True), -0.4315),
        ("08B8", (-50, 50, True), 3.4058),
        ("5595B66D", (-90, 90, True), 60.1768),
        ("5B5360C4", (-180, 180, True), 128.4268),
        ("C221", (-900, 19000), 14190.7195),
        ("CD9C", (0, 180), 144.5713),
        ("8000", (-20, 20, True), math.nan),
    ],
)
def test_values_are_those_of_the_examples_in_the_standard(coded, span, value):
    assert mapped(bytes.fromhex(coded), *span) == pytest.approx(value, abs=1e-4, nan_ok=True)


def test_a_float_of_st_1201_is_mapped_and_infinity_unknown():
    assert imap(((2150 + 900) * 2**7).to_bytes(3, "big"), -900, 40000) == pytest.approx(2150, abs=0.01)
    assert math.isnan(imap(bytes.fromhex("C80000"), -900, 40000)) and math.isnan(mapped(None, 0, 1))


@pytest.mark.parametrize("long_length", [False, True])
def test_a_packet_is_whole_only_with_its_checksum(long_length):
    content = local_set({2: START_US.to_bytes(8, "big"), 56: b"\x10"}, long_length)
    (found,) = local_sets(b"..." + content + b"...")
    assert found.whole and found.place == 3 and found.tags[56] == b"\x10"
    for i in range(16, len(content)):
        damaged = bytearray(content)
        damaged[i] ^= 0x04
        assert not any(one.whole for one in local_sets(bytes(damaged)))
        assert not any(one.whole for one in local_sets(content[:i]))
    behind = content[:17] + b"\xf0" + content[18:] + packet(1)
    assert [one.whole for one in local_sets(behind)] == [False, True]


@pytest.mark.parametrize(("kind", "before"), [(0x06, b""), (0x15, b""), (0x06, b"time")])
def test_times_are_those_of_the_stream_since_the_picture_shown_first(fly, kind, before):
    first = 2**33 - 90_000  # the stamps wrap within the clip
    video = [(first + 3600 * shown) % 2**33 for shown in (2, 0, 1, 5, 3, 4, *range(6, 50))]
    metadata = [((first + 3600 * i + 900) % 2**33, packet(i)) for i in range(50)]
    found = fly(transport_stream(video, metadata, kind, before), "a.ts", clock_offset_s=0.5)
    np.testing.assert_allclose(found.time_s, 0.5 + 0.01 + 0.04 * np.arange(50), atol=1e-9)
    assert found.start_utc_s == pytest.approx(START_US / 1e6 - 0.01 - 0.5)
    np.testing.assert_allclose(found.place, [[-86.6891, 34.7211]] * 50, atol=1e-7)
    np.testing.assert_allclose(found.above_sea_m, 3048, atol=0.2)


def test_where_the_stream_has_no_times_the_packets_own_stamps_count(fly):
    packets = [packet(i) for i in range(20)]
    stream = transport_stream([90_000 + 3600 * i for i in range(20)], [(None, content) for content in packets])
    for content, name in ((stream, "a.ts"), (b"".join(packets), "a.klv")):
        np.testing.assert_allclose(fly(content, name).time_s, 0.04 * np.arange(20), atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_the_camera_looks_where_mount_and_vehicle_together_turn_it(fly_packets, seed):
    rng = np.random.default_rng(seed)
    platform = rng.uniform([0, -19, -49], [360, 19, 49])
    sensor = rng.uniform([0, -80, 0], [360, 10, 360])
    found = fly_packets([attitude(*platform, *sensor)] * 2)

    def about(axis, degrees):
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i] = turn[j, j] = math.cos(math.radians(degrees))
        turn[j, i] = math.sin(math.radians(degrees))
        turn[i, j] = -turn[j, i]
        return turn

    whole = np.eye(3)
    for heading, pitch_up, roll in (platform, sensor):
        whole = whole @ about(2, heading) @ about(1, pitch_up) @ about(0, roll)
    seen = axes(found.heading_rad[:1], found.pitch_rad[:1], found.roll_rad[:1])[0]
    np.testing.assert_allclose(seen, whole, atol=2e-3)  # 16-bit angles: 0.005 degrees


def test_angles_and_axes_are_each_others_inverse_and_those_of_the_projection():
    given = np.random.default_rng(0).uniform([-3, -1.5, -3], [3, 1.5, 3], (50, 3)).T
    np.testing.assert_allclose(angles(axes(*given)), given, atol=1e-9)
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    for turned, *one in zip(axes(*given), *given, strict=True):
        assert np.allclose(enu_from_ned @ turned[:, [1, 2, 0]], axes_of(*one))
    down = axes(np.radians([40.0]), np.radians([90.0]), np.zeros(1))  # the upper edge has the heading
    np.testing.assert_allclose(-down[0, :, 2], [math.cos(math.radians(40)), math.sin(math.radians(40)), 0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.ravel(angles(down))), [40, 90, 0], atol=1e-6)
    half = math.radians(20)
    yawed = axes_of_quaternion(np.array([[math.cos(half), 0, 0, math.sin(half)]]))
    np.testing.assert_allclose(np.degrees(np.ravel(angles(yawed))), [40, 0, 0], atol=1e-9)
    assert np.isnan(axes_of_quaternion(np.zeros((1, 4)))).any()


def test_the_altitude_is_that_above_the_ground_in_the_picture_or_the_given_one(fly_packets):
    ground = {25: spread(201, -900, 19000, 2)}
    found = fly_packets([ground] * 3)
    np.testing.assert_allclose(found.altitude_m, 3048 - 201, atol=0.4)
    assert any("picture's middle" in note for note in found.notes)
    found = fly_packets([{**ground, 113: ((2150 + 900) * 2**7).to_bytes(3, "big")}] * 3)
    np.testing.assert_allclose(found.altitude_m, 2150, atol=0.01)


def test_what_some_packets_alone_hold_goes_on_between_them(fly_packets):
    flight = fly_packets([{16: spread(13, 0, 180, 2)} if i % 10 == 0 else {} for i in range(41)]).at(0.7)
    assert flight is not None and math.degrees(flight.hfov_rad) == pytest.approx(13, abs=0.01)


@pytest.mark.parametrize(
    ("damage", "least", "words"),
    [(lambda c: c[: len(c) // 2 + 77], 11, "cut off"), (lambda c: c[:9000] + b"rubbish" + c[9000:], 28, "out of step")],
)
def test_a_damaged_stream_is_read_around_the_damage(fly_packets, damage, least, words):
    flown = fly_packets([{}] * 30, damage)
    assert least <= len(flown) <= 30 and any(words in note for note in flown.notes)


@pytest.mark.parametrize(
    ("payload", "kind", "words"),
    [
        (b"sound", 0x03, "carries no KLV metadata; its streams are of the types 0x1b, 0x03"),
        (b"other keys", 0x06, "no MISB ST 0601 packet"),
        (packet(0)[:-1] + b"\0", 0x06, "none of 9 MISB ST 0601 packets is whole"),
    ],
)
def test_a_stream_without_whole_metadata_is_refused(refused, payload, kind, words):
    assert words in refused(read_telemetry, transport_stream([0, 3600], [(0, payload)] * 9, kind), "a.ts")


def sum_of(content: bytes, flip: int = 0) -> int:
    return sum(byte << (8 * ((i + 1 + flip) % 2)) for i, byte in enumerate(content)) & 0xFFFF


def resummed(content: bytes, checksum: int) -> bytes:
    return content[:-2] + (checksum & 0xFFFF).to_bytes(2, "big")


# Of two lengths: the second of two packets has one more tag.
PACKETS = [packet(i, {56: bytes([10 + i])} | ({5: spread(i, 0, 360, 2)} if i % 2 else {})) for i in range(12)]


@pytest.mark.parametrize(
    "checksum",
    [
        lambda c: sum_of(c[17:-2]),
        lambda c: sum_of(c[17:-4]),
        lambda c: sum_of(c[16:-2]),
        lambda c: sum_of(c[:-4]),
        lambda c: sum_of(c[:-2], flip=1),
        lambda c: sum_of(c[:-2]) + 77,
        lambda c: int.from_bytes(sum_of(c[:-2]).to_bytes(2, "big"), "little"),
        lambda c: sum(c[:-2]),
        lambda c: sum_of(c[:-2]) ^ 0xFFFF,
        lambda c: -sum_of(c[:-2]) & 0xFFFF,
        lambda c: sum_of(c[16:-4]) ^ 0xFFFF,
        lambda c: binascii.crc_hqx(c[:-2], 0xFFFF),
        lambda c: binascii.crc_hqx(c[:-4], 0),
        lambda c: 0,
        lambda c: 0xFFFF,
    ],
)
@pytest.mark.parametrize("in_stream", [False, True])
def test_packets_whose_checksums_are_all_wrong_in_the_same_way_are_read(fly, checksum, in_stream):
    packets = [resummed(one, checksum(one)) for one in PACKETS]
    times = [3600 * i for i in range(12)]
    stream = transport_stream(times, list(zip(times, packets, strict=True)))
    flown = fly(*((stream, "a.ts") if in_stream else (b"".join(packets), "a.klv")))
    assert len(flown) == 12 and flown.speed_m_s.round().tolist() == [10 + i for i in range(12)]
    assert any("wrong in the same way" in note for note in flown.notes)
    # Damaged packets are still found by them, if they depend on the content at all.
    damaged = [one[:22] + bytes([one[22] ^ 4]) + one[23:] if i in (3, 7) else one for i, one in enumerate(packets)]
    if checksum(PACKETS[0]) not in (0, 0xFFFF):
        flown = fly(b"".join(damaged), "a.klv")
        assert len(flown) == 10 and any("2 of 12 packets are damaged" in note for note in flown.notes)


@pytest.mark.parametrize(("unit", "per_s"), [("milliseconds", 1e3), ("seconds", 1.0), ("nanoseconds", 1e9)])
def test_stamps_in_another_unit_than_the_standards_are_read_with_a_note(fly, unit, per_s):
    stamps = [int((START_US / 1e6 // 1 + i) * per_s) for i in range(5)]
    flown = fly(b"".join(local_set({2: stamp.to_bytes(8, "big"), **PLACE}) for stamp in stamps), "a.klv")
    np.testing.assert_allclose(flown.time_s, range(5))
    assert flown.start_utc_s == START_US // 10**6
    assert [note for note in flown.notes if f"count {unit}, not microseconds" in note]


def test_packets_whose_checksums_are_wrong_in_different_ways_are_refused(refused):
    rng = np.random.default_rng(0)
    packets = [resummed(one, int(rng.integers(1 << 16))) for one in PACKETS]
    assert "none of 12 MISB ST 0601 packets is whole" in refused(read_telemetry, b"".join(packets), "a.klv")


def test_of_whole_packets_one_with_a_wrong_checksum_is_left_out(fly):
    packets = [resummed(one, 0) if i == 3 else one for i, one in enumerate(PACKETS)]
    flown = fly(b"".join(packets), "a.klv")
    assert len(flown) == 11 and any("1 of 12 packets are damaged" in note for note in flown.notes)


def test_packets_without_a_checksum_are_read_with_a_warning(fly):
    packets = [one[:16] + bytes([len(one) - 21]) + one[17:-4] for one in PACKETS]
    flown = fly(b"".join(packets), "a.klv")
    assert len(flown) == 12 and any("no checksum" in note for note in flown.notes)


@pytest.mark.parametrize(
    "lead", [b"\0", bytes.fromhex("000001fc004084"), bytes(30_000), b"hello, world\n", b"\xff" * 7]
)
@pytest.mark.parametrize("name", ["a.klv", "a.bin"])
def test_bytes_before_the_first_key_are_left_out(fly, lead, name):
    for content in (lead + b"".join(PACKETS), b"".join(lead + one for one in PACKETS)):
        flown = fly(content, name)
        assert len(flown) == 12
        assert any(f"{len(lead)} bytes before the first key" in note for note in flown.notes)


@pytest.mark.parametrize(
    ("tags", "ellipsoid_m", "altitude_m"),
    [
        ({75: spread(1033, -900, 19000, 2)}, 1033, math.nan),
        ({104: ((1500 + 900) * 2**7).to_bytes(3, "big")}, 1500, math.nan),
        ({75: spread(1033, -900, 19000, 2), 104: ((1500 + 900) * 2**7).to_bytes(3, "big")}, 1500, math.nan),
        ({75: spread(1033, -900, 19000, 2), 78: spread(201, -900, 19000, 2)}, 1033, 832),
        # The ground above the sea and the vehicle above the ellipsoid have no common zero.
        ({75: spread(1033, -900, 19000, 2), 25: spread(201, -900, 19000, 2)}, 1033, math.nan),
    ],
)
def test_heights_above_the_ellipsoid_are_never_above_the_sea(fly, tags, ellipsoid_m, altitude_m):
    place = {tag: value for tag, value in PLACE.items() if tag != 15}
    packets = [local_set({2: (START_US + i * 40_000).to_bytes(8, "big"), **place, **tags}) for i in range(5)]
    flown = fly(b"".join(packets), "a.klv")
    np.testing.assert_allclose(flown.above_ellipsoid_m, ellipsoid_m, atol=0.2)
    np.testing.assert_allclose(flown.altitude_m, altitude_m, atol=0.4)
    assert np.isnan(flown.above_sea_m).all()
    assert any("ellipsoid" in note for note in flown.notes) == math.isnan(altitude_m)


def test_a_camera_without_a_clock_has_none(fly):
    packets = [local_set({2: (i * 40_000).to_bytes(8, "big"), **PLACE}) for i in range(5)]
    flown = fly(b"".join(packets), "a.klv")
    assert math.isnan(flown.start_utc_s) and any("1970-01-01" in note for note in flown.notes)
