"""Records on disk: what is stored comes back to the last digit, whole or not at all, until nobody uses it any more."""

import hashlib
import io
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.cache import Cache, CarriedRecords, DamagedError, digest, pack, unpack
from torchvision_dddas.evaluation.studies.records import Found

KEY = "ab" + "0" * 62
RNG = np.random.default_rng(0)
FOUND = Found(
    np.array([1, 1, 4]),
    RNG.random((3, 4)),
    RNG.random(3),
    np.array([7, -1, 7]),
    np.full((3, 2), np.nan),
    np.full((3, 2, 2), np.nan),
    np.array([1, 2, 4]),
    {2: b"\x89PNG", 4: b""},
    {4: np.eye(3) * np.pi},
    {"speed_px": RNG.random(3)},
    {"read": 0.1, "track": 1e-300},
    float("nan"),
    ("a note – with signs",),
)
WHOLE = pack(FOUND)


def test_a_result_comes_back_to_the_last_digit() -> None:
    back = unpack(WHOLE)
    assert isinstance(back, Found) and pack(back) == WHOLE
    for name in ("frame", "box_px", "covariance_m2"):
        there, again = getattr(FOUND, name), getattr(back, name)
        assert again.dtype == there.dtype and again.tobytes() == there.tobytes()
    assert back.masks == FOUND.masks and back.seconds == FOUND.seconds and back.notes == FOUND.notes
    assert (back.steps[4] == FOUND.steps[4]).all()


@given(st.integers(0, len(WHOLE) - 1), st.integers(0, 255))
def test_any_changed_byte_or_lost_end_is_noticed(place: int, change: int) -> None:
    damaged = bytearray(WHOLE)
    damaged[place] ^= change
    with pytest.raises(DamagedError):
        unpack(bytes(damaged) if change else WHOLE[:place])


@pytest.mark.parametrize("name", ["os:system", "torchvision_dddas.cli:main", "Settings"])
def test_what_is_no_record_is_never_made(name: str) -> None:
    file = io.BytesIO()
    np.savez(file, content=np.frombuffer(json.dumps({"of": name, "fields": {"command": "true"}}).encode(), np.uint8))
    with pytest.raises(DamagedError):
        unpack(hashlib.sha256(file.getvalue()).digest() + file.getvalue())


def test_what_cannot_be_stored_is_refused_by_its_name() -> None:
    with pytest.raises(TypeError, match="a set cannot be stored"):
        pack({"a": {1, 2}})


@pytest.mark.parametrize(
    ("one", "other"),
    [
        *((1, 1.0), ("1", 1), (("a", "bc"), ("ab", "c")), ((1, (2,)), ((1, 2),)), (None, "None"), (True, 1)),
        *((np.zeros(2), np.zeros((2, 1))), (np.zeros(2), np.zeros(2, int)), ({"a": 1}, {"a": 2})),
    ],
)
def test_what_differs_has_another_digest(one, other) -> None:
    assert digest(one) == digest(one) != digest(other)


def test_what_was_kept_is_found_again_by_its_key_alone(tmp_path) -> None:
    Cache(tmp_path).put(KEY, FOUND)
    again = Cache(tmp_path)
    assert again.has(KEY) and pack(again.get(KEY)) == WHOLE
    assert not again.has(KEY[::-1]) and again.get(KEY[::-1]) is None
    assert [path.name for path in (tmp_path / KEY[:2]).iterdir()] == [f"{KEY}.npz"]


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b"", lambda b: b[:40] + b"x" + b[41:]])
@pytest.mark.parametrize("look", [Cache.has, Cache.get])
def test_a_damaged_entry_is_noted_once_and_removed(tmp_path, damage, look) -> None:
    cache = Cache(tmp_path)
    cache.put(KEY, FOUND)
    cache.path(KEY).write_bytes(damage(cache.path(KEY).read_bytes()))
    assert not look(cache, KEY) and not look(cache, KEY)
    (line,) = cache.notes
    assert "damaged" in line and KEY in line


def test_an_entry_that_cannot_be_finished_leaves_nothing(tmp_path, monkeypatch) -> None:
    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"No space left on device.*choose another --cache"):
        Cache(tmp_path).put(KEY, FOUND)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_cache_that_cannot_be_is_one_line(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another --cache"):
        Cache(tmp_path / "file" / "cache")


def test_what_nobody_used_for_long_is_pruned_and_what_was_read_stays(tmp_path) -> None:
    cache, other = Cache(tmp_path), "cd" + KEY[2:]
    for key in (KEY, other):
        cache.put(key, FOUND)
        os.utime(cache.path(key), (1e9, 1e9))
    assert cache.has(KEY)
    assert cache.prune(30) == (1, len(WHOLE))
    assert cache.has(KEY) and not cache.has(other)


def test_records_that_travel_with_a_job_are_used_and_new_ones_come_back() -> None:
    there = CarriedRecords({})
    there.put(KEY, FOUND)
    back = CarriedRecords(there.made)
    assert pack(back.get(KEY)) == WHOLE and back.made == {}
    assert CarriedRecords({KEY: WHOLE[:-1]}).get(KEY) is None
