"""MISB ST 0601 in transport streams: packets, times, and where a camera looks that turns in a vehicle that turns."""

import math

import numpy as np
import pytest

from tests.io.flights import local_set, spread, transport_stream
from torchvision_dddas.geo.projection import axes_of
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.attitude import angles, axes, axes_of_quaternion
from torchvision_dddas.io.telemetry.misb import imap, local_sets, mapped

START_US = 1_340_980_354_100_000
PLACE = {13: spread(34.7211, 0, 90, 4, True), 14: spread(-86.6891, 0, 180, 4, True), 15: spread(3048, -900, 19000, 2)}


def attitude(heading: float, pitch: float, roll: float, azimuth: float, elevation: float, turn: float) -> dict:
    return {
        5: spread(heading, 0, 360, 2),
        6: spread(pitch, 0, 20, 2, True),
        7: spread(roll, 0, 50, 2, True),
        18: spread(azimuth, 0, 360, 4),
        19: spread(elevation, 0, 180, 4, True),
        20: spread(turn, 0, 360, 4),
    }


def packet(i: int, **further: bytes) -> bytes:
    more = {int(tag[1:]): value for tag, value in further.items()}
    return local_set({2: (START_US + i * 40_000).to_bytes(8, "big"), **PLACE, **more})


def test_values_are_those_of_the_examples_in_the_standard() -> None:
    # ST 0601 gives an encoded example beside each tag.
    assert mapped(bytes.fromhex("71C2"), 0, 360) == pytest.approx(159.9744, abs=1e-4)
    assert mapped(bytes.fromhex("FD3D"), -20, 20, True) == pytest.approx(-0.4315, abs=1e-4)
    assert mapped(bytes.fromhex("08B8"), -50, 50, True) == pytest.approx(3.4058, abs=1e-4)
    assert mapped(bytes.fromhex("5595B66D"), -90, 90, True) == pytest.approx(60.1768, abs=1e-4)
    assert mapped(bytes.fromhex("5B5360C4"), -180, 180, True) == pytest.approx(128.4268, abs=1e-4)
    assert mapped(bytes.fromhex("C221"), -900, 19000) == pytest.approx(14190.72, abs=0.01)
    assert mapped(bytes.fromhex("CD9C"), 0, 180) == pytest.approx(144.5713, abs=1e-4)
    assert math.isnan(mapped(bytes.fromhex("8000"), -20, 20, True)) and math.isnan(mapped(None, 0, 1))
    # ST 1201: IMAPB(-900, 40000, 3)
    assert imap(((2150 + 900) * 2**7).to_bytes(3, "big"), -900, 40000) == pytest.approx(2150, abs=0.01)
    assert math.isnan(imap(bytes.fromhex("C80000"), -900, 40000))  # plus infinity


@pytest.mark.parametrize("long_length", [False, True])
def test_a_packet_is_whole_only_with_its_checksum(long_length: bool) -> None:
    content = local_set({2: START_US.to_bytes(8, "big"), 56: b"\x10"}, long_length)
    (found,) = local_sets(b"..." + content + b"...")
    assert found.whole and found.place == 3 and found.tags[56] == b"\x10"
    for i in range(16, len(content)):
        damaged = bytearray(content)
        damaged[i] ^= 0x04
        assert not any(one.whole for one in local_sets(bytes(damaged)))
        assert not any(one.whole for one in local_sets(content[:i]))


def test_packets_behind_a_damaged_one_are_still_found() -> None:
    first, second = packet(0), packet(1)
    damaged = first[:17] + b"\xf0" + first[18:]
    assert [one.whole for one in local_sets(damaged + second)] == [False, True]


@pytest.mark.parametrize(("kind", "before"), [(0x06, b""), (0x15, b""), (0x06, b"time")])
def test_times_are_those_of_the_stream_since_the_picture_shown_first(fly, kind: int, before: bytes) -> None:
    first = 2**33 - 90_000  # the stamps wrap within the clip
    video = [(first + 3600 * shown) % 2**33 for shown in (2, 0, 1, 5, 3, 4, *range(6, 50))]
    metadata = [((first + 3600 * i + 900) % 2**33, packet(i)) for i in range(50)]
    found = fly(transport_stream(video, metadata, kind, before), "a.ts", clock_offset_s=0.5)
    np.testing.assert_allclose(found.time_s, 0.5 + 0.01 + 0.04 * np.arange(50), atol=1e-9)
    assert found.start_utc_s == pytest.approx(START_US / 1e6 - 0.01 - 0.5)
    np.testing.assert_allclose(found.place, [[-86.6891, 34.7211]] * 50, atol=1e-7)
    np.testing.assert_allclose(found.above_sea_m, 3048, atol=0.2)


def test_where_the_stream_tells_no_times_the_packets_own_stamps_do(fly) -> None:
    video = [90_000 + 3600 * i for i in range(20)]
    found = fly(transport_stream(video, [(None, packet(i)) for i in range(20)]), "a.ts")
    np.testing.assert_allclose(found.time_s, 0.04 * np.arange(20), atol=1e-6)
    alone = fly(b"".join(packet(i) for i in range(20)), "a.klv")
    np.testing.assert_allclose(alone.time_s, 0.04 * np.arange(20), atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_looks_where_mount_and_vehicle_together_turn_it(fly, seed: int) -> None:
    rng = np.random.default_rng(seed)
    platform = rng.uniform([0, -19, -49], [360, 19, 49])
    sensor = rng.uniform([0, -80, 0], [360, 10, 360])
    tags = {f"t{tag}": value for tag, value in attitude(*platform, *sensor).items()}
    content = transport_stream([0, 3600], [(3600 * i, packet(i, **tags)) for i in range(2)])
    found = fly(content, "a.ts")

    def about(axis: int, degrees: float) -> np.ndarray:
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


def test_angles_and_axes_are_each_others_inverse_and_straight_down_the_upper_edge_has_the_heading() -> None:
    rng = np.random.default_rng(0)
    told = rng.uniform([-3, -1.5, -3], [3, 1.5, 3], (50, 3)).T
    np.testing.assert_allclose(angles(axes(*told)), told, atol=1e-9)
    down = axes(np.radians([40.0]), np.radians([90.0]), np.zeros(1))
    np.testing.assert_allclose(-down[0, :, 2], [math.cos(math.radians(40)), math.sin(math.radians(40)), 0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.ravel(angles(down))), [40, 90, 0], atol=1e-6)
    half = math.radians(20)
    yawed = axes_of_quaternion(np.array([[math.cos(half), 0, 0, math.sin(half)]]))
    np.testing.assert_allclose(np.degrees(np.ravel(angles(yawed))), [40, 0, 0], atol=1e-9)
    assert np.isnan(axes_of_quaternion(np.zeros((1, 4)))).any()


def test_the_altitude_is_that_above_the_ground_in_the_picture_or_as_told(fly) -> None:
    ground = {"t25": spread(201, -900, 19000, 2)}
    content = transport_stream([0], [(3600 * i, packet(i, **ground)) for i in range(3)])
    found = fly(content, "a.ts")
    np.testing.assert_allclose(found.altitude_m, 3048 - 201, atol=0.4)
    assert any("picture's middle" in note for note in found.notes)
    told = ground | {"t113": ((2150 + 900) * 2**7).to_bytes(3, "big")}
    found = fly(transport_stream([0], [(3600 * i, packet(i, **told)) for i in range(3)]), "a.ts")
    np.testing.assert_allclose(found.altitude_m, 2150, atol=0.01)


def test_what_is_told_in_some_packets_alone_goes_on_between_them(fly) -> None:
    view = {"t16": spread(13, 0, 180, 2)}
    metadata = [(3600 * i, packet(i, **(view if i % 10 == 0 else {}))) for i in range(41)]
    found = fly(transport_stream([0], metadata), "a.ts")
    flight = found.at(0.7)
    assert flight is not None and math.degrees(flight.hfov_rad) == pytest.approx(13, abs=0.01)


@pytest.mark.parametrize(
    ("damage", "least", "words"),
    [(lambda c: c[: len(c) // 2 + 77], 11, "cut off"), (lambda c: c[:9000] + b"rubbish" + c[9000:], 28, "out of step")],
)
def test_a_damaged_stream_is_read_around_the_damage(fly, damage, least, words):
    flown = fly(
        damage(transport_stream([3600 * i for i in range(30)], [(3600 * i, packet(i)) for i in range(30)])), "a.ts"
    )
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


def test_a_camera_is_turned_as_the_projection_has_it_in_other_axes_of_the_same_world():
    heading, pitch, roll = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 20))
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    for turned, *given in zip(axes(heading, pitch, roll), heading, pitch, roll, strict=True):
        assert np.allclose(enu_from_ned @ turned[:, [1, 2, 0]], axes_of(*given))
