"""Targets in MISB ST 0903 local sets: the bytes of published examples, and the values that were written."""

import math

import pytest

from torchvision_dddas.io.telemetry import VmtiTarget, encode_vmti
from torchvision_dddas.io.telemetry.misb import imap

SIZE = (1920, 1080)
STEP_DEG = 2.0**-17  # of an offset in three bytes


def length(content: bytes, place: int) -> tuple[int, int]:
    first = content[place]
    end = place + 1 + (first & 0x7F if first > 127 else 0)
    return (int.from_bytes(content[place + 1 : end], "big") if first > 127 else first), end


def items(content: bytes) -> dict[int, bytes]:
    found, place = dict[int, bytes](), 0
    while place < len(content):
        size, begin = length(content, place + 1)
        assert begin + size <= len(content) and content[place] not in found
        found[content[place]] = content[begin : begin + size]
        place = begin + size
    return found


def packs(content: bytes) -> dict[int, dict[int, bytes]]:
    """The items of each target, by its identity."""
    found, place, series = dict[int, dict[int, bytes]](), 0, items(content).get(101, b"")
    while place < len(series):
        size, begin = length(series, place)
        pack, place = series[begin : begin + size], begin + size
        end = next(k for k, byte in enumerate(pack, 1) if byte < 128)
        identity = 0
        for byte in pack[:end]:
            identity = identity << 7 | byte & 0x7F
        found[identity] = items(pack[end:])
    return found


def test_the_bytes_are_those_of_published_examples():
    # From the tests of WestRidgeSystems/jmisb (st0903: VmtiLocalSetOneWithTheLotTest, TargetLocationTest).
    target = VmtiTarget(1, (639, 213, 1, 1), 0.8, (29.157890122923, -10.5423886331461, 3216.0))
    content = encode_vmti(78_000, SIZE, [target], "EO Nose")
    assert bytes.fromhex("040105") in content
    assert bytes.fromhex("07030130b0 08020780 09020438 0a07454f204e6f7365") in content
    pack = packs(content)[1]
    assert pack[1] == bytes.fromhex("064000") and pack[5] == b"\x50"
    assert pack[17] == bytes.fromhex("27ba9302344a1adf1014")


def test_written_targets_are_read_again():
    near = (11.5, 48.0, 520.0)
    targets = [VmtiTarget(k, (10.0 * k, 20.4, 6.0, 4.0), k / 10, near) for k in (1, 5, 9)]
    found = packs(content := encode_vmti(7, SIZE, targets))
    assert list(found) == [1, 5, 9] and items(content)[5] == items(content)[6] == b"\3"
    for identity, pack in found.items():
        top, left, bottom = 20, 10 * identity, 23
        corners = [1 + left + top * 1920, 1 + left + 5 + bottom * 1920]
        assert [int.from_bytes(pack[tag], "big") for tag in (2, 3)] == corners
        assert pack[5][0] == 10 * identity
        latitude, longitude, up_m = pack[17][:4], pack[17][4:8], pack[17][8:]
        assert imap(latitude, -90, 90) == pytest.approx(48.0, abs=1e-6)
        assert imap(longitude, -180, 180) == pytest.approx(11.5, abs=1e-6)
        assert imap(up_m, -900, 19000) == pytest.approx(520.0, abs=0.7)


def test_a_place_without_a_height_counts_from_the_middle_of_the_picture():
    target = VmtiTarget(1, (1, 1, 2, 2), place=(11.5, 48.0, math.nan))
    pack = packs(encode_vmti(1, SIZE, [target], centre_deg=(11.501, 47.998)))[1]
    assert imap(pack[10], -19.2, 19.2) == pytest.approx(0.002, abs=STEP_DEG)
    assert imap(pack[11], -19.2, 19.2) == pytest.approx(-0.001, abs=STEP_DEG)
    assert not {10, 11, 17} & packs(encode_vmti(1, SIZE, [target]))[1].keys()


@pytest.mark.parametrize("identity", [1, 127, 128, 16_383, 16_384, 2_097_151])
def test_identities_of_every_length_are_kept(identity):
    assert list(packs(encode_vmti(1, SIZE, [VmtiTarget(identity, (0, 0, 9, 9))]))) == [identity]


@pytest.mark.parametrize(
    "target",
    [
        VmtiTarget(0, (1, 1, 9, 9)),
        VmtiTarget(2_097_152, (1, 1, 9, 9)),
        VmtiTarget(1, (1920, 1, 9, 9)),
        VmtiTarget(1, (-20, 1, 9, 9)),
        VmtiTarget(1, (math.nan, 1, 9, 9)),
        VmtiTarget(1, (5, 5, 0, 0)),
    ],
)
def test_a_target_that_cannot_be_told_is_left_out(target):
    content = encode_vmti(1, SIZE, [target, VmtiTarget(7, (-5, 1070, 20, 20))])
    assert list(packs(content)) == [7] and items(content)[6] == b"\1"
    assert int.from_bytes(packs(content)[7][3], "big") == 15 + 1079 * 1920


def test_a_crowd_beyond_the_limit_is_counted():
    content = encode_vmti(1, SIZE, [VmtiTarget(k, (k, 1, 9, 9)) for k in range(1, 601)])
    assert int.from_bytes(items(content)[5], "big") == 600 and len(packs(content)) == 500
    assert int.from_bytes(items(content)[6], "big") == 500
