"""Records on disk, whole or not at all; digests of all that a result depends on."""

import hashlib
import io
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import PartFile
from torchvision_dddas.lab.evaluation.metrics.boxes import BoxCounts
from torchvision_dddas.lab.evaluation.metrics.metres import LocatedCounts
from torchvision_dddas.lab.evaluation.studies import cache
from torchvision_dddas.lab.evaluation.studies.cache import Cache, digest, files_digest, pack, unpack
from torchvision_dddas.lab.evaluation.studies.records import Findings

KEY, OTHER = "ab" + "0" * 62, "cd" + "0" * 62
RNG = np.random.default_rng(0)
FOUND = Findings(
    *(np.array([1, 1, 4]), RNG.random((3, 4)), RNG.random(3), np.array([7, -1, 7])),
    *(np.full((3, 2), np.nan), np.full((3, 2, 2), np.nan), np.array([1, 2, 4])),
    masks={2: b"\x89PNG", 4: b""},
    steps={4: np.eye(3) * np.pi},
    more={"speed_px": RNG.random(3)},
    seconds={"read": 0.1, "track": 1e-300},
    notes=("a note – with signs",),
)
WHOLE = pack(FOUND)


def test_a_result_comes_back_to_the_last_digit() -> None:
    back = unpack(WHOLE)
    assert isinstance(back, Findings) and pack(back) == WHOLE
    for name in ("frame", "box_px", "covariance_m2"):
        before, after = getattr(FOUND, name), getattr(back, name)
        assert after.dtype == before.dtype and after.tobytes() == before.tobytes()
    assert back.masks == FOUND.masks and back.seconds == FOUND.seconds and back.notes == FOUND.notes
    assert (back.steps[4] == FOUND.steps[4]).all()


@given(st.integers(0, len(WHOLE) - 1), st.integers(0, 255))
def test_any_changed_byte_or_lost_end_is_noticed(place: int, change: int) -> None:
    damaged = bytearray(WHOLE)
    damaged[place] ^= change
    with pytest.raises(cache.DamagedError):
        unpack(bytes(damaged) if change else WHOLE[:place])


@pytest.mark.parametrize("name", ["os:system", "torchvision_dddas.cli:main", "Settings"])
def test_only_records_are_made(name: str) -> None:
    file = io.BytesIO()
    np.savez(file, content=np.frombuffer(json.dumps({"of": name, "fields": {"command": "true"}}).encode(), np.uint8))
    with pytest.raises(cache.DamagedError):
        unpack(hashlib.sha256(file.getvalue()).digest() + file.getvalue())
    with pytest.raises(TypeError, match="a set cannot be stored"):
        pack({"a": {1, 2}})


def test_records_keep_their_names_in_files_when_their_classes_are_renamed() -> None:
    for record, name in ((FOUND, b"Found"), (BoxCounts(), b"Boxes"), (LocatedCounts(), b"GroundLocations")):
        assert b'{"of": "' + name + b'"' in pack(record) and type(unpack(pack(record))) is type(record)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        *((1, 1.0), ("1", 1), (("a", "bc"), ("ab", "c")), ((1, (2,)), ((1, 2),)), (None, "None"), (True, 1)),
        *((np.zeros(2), np.zeros((2, 1))), (np.zeros(2), np.zeros(2, int)), ({"a": 1}, {"a": 2})),
    ],
)
def test_different_values_have_different_digests(one, other) -> None:
    assert digest(one) == digest(one) != digest(other)


def test_entries_are_found_again_by_their_keys_and_pruned_if_unused_for_long(tmp_path) -> None:
    for key in (KEY, OTHER):
        Cache(tmp_path).put(key, FOUND)
    assert [path.name for path in (tmp_path / KEY[:2]).iterdir()] == [f"{KEY}.npz"]
    again = Cache(tmp_path)
    for key in (KEY, OTHER):
        os.utime(again.path(key), (1e9, 1e9))
    assert pack(again.get(KEY)) == WHOLE  # which is a use
    assert again.get(KEY[::-1]) is None
    assert again.prune(30) == (1, len(WHOLE))
    assert again.has(KEY) and not again.has(OTHER)


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b"", lambda b: b[:40] + b"x" + b[41:]])
@pytest.mark.parametrize("read", [Cache.has, Cache.get])
def test_a_damaged_entry_is_noted_once_and_removed(tmp_path, damage, read) -> None:
    entries = Cache(tmp_path)
    entries.put(KEY, FOUND)
    entries.path(KEY).write_bytes(damage(WHOLE))
    assert not read(entries, KEY) and not read(entries, KEY)
    (line,) = entries.notes
    assert "damaged" in line and KEY in line


def test_a_cache_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path, monkeypatch) -> None:
    written = PartFile.write

    def full(part: PartFile, content: bytes) -> None:
        written(part, content[:10])
        raise OSError(28, "No space left on device")

    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="choose another --cache"):
        Cache(tmp_path / "file" / "cache")
    monkeypatch.setattr(PartFile, "write", full)
    with pytest.raises(InputError, match=r"No space left on device.*choose another --cache"):
        Cache(tmp_path / "cache").put(KEY, FOUND)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["file"]


def old(path, text: str):
    path.write_text(text)
    os.utime(path, (1e9, 1e9))
    return path


def test_files_count_by_their_content_and_order_not_by_name_or_time(tmp_path) -> None:
    one, same, other = (old(tmp_path / name, text) for name, text in (("a", "one"), ("b", "one"), ("c", "two")))
    assert files_digest([one]) == files_digest([same]) != files_digest([other])
    assert files_digest([one, other]) != files_digest([other, one])
    with pytest.raises(InputError, match=r"gone\.png cannot be read"):
        files_digest([tmp_path / "gone.png"])


def test_a_file_is_read_again_only_after_a_change_and_one_just_written_is_not_remembered(tmp_path, monkeypatch) -> None:
    path, memory = tmp_path / "a", tmp_path / "memory"
    path.write_text("one")  # it may be written again within one tick of its time stamp
    first = files_digest([path], memory)
    assert not memory.exists()
    assert files_digest([old(path, "one")], memory) == first
    with monkeypatch.context() as blind:
        blind.setattr(cache, "_file_digest", lambda path: pytest.fail("it was read again"))
        assert files_digest([path], memory) == first
    time.sleep(0.05)
    old(path, "two")  # of the same size and with its old time
    assert files_digest([path], memory) != first


@pytest.mark.parametrize(
    ("path", "counts"),
    [
        *(("detection/detector.py", True), ("lab/evaluation/metrics/boxes.py", True), ("graphs/manifest.json", True)),
        *(("cli/run.py", False), ("live/runner.py", False), ("lab/evaluation/report/__init__.py", False)),
    ],
)
def test_results_depend_on_the_code_that_a_study_can_run(monkeypatch, path, counts) -> None:
    find_digest = cache.code_digest.__wrapped__
    before, real, changed_file = find_digest("onboard"), cache._file_digest, cache.PACKAGE / path
    assert changed_file.is_file()
    monkeypatch.setattr(cache, "_file_digest", lambda read: "other" if read == changed_file else real(read))
    assert (find_digest("onboard") != before) == counts


def test_no_stage_or_score_imports_code_that_does_not_count() -> None:
    modules = ("torchvision_dddas.lab.evaluation.studies.stages", "torchvision_dddas.lab.evaluation.studies.scoring")
    above = tuple(f"torchvision_dddas.{folder.replace('/', '.')}" for folder in cache._ABOVE)
    program = f"import sys, {', '.join(modules)}; print([name for name in sys.modules if name.startswith({above})])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_entries_written_after_a_time_are_told_from_older_ones(tmp_path):
    cache = Cache(tmp_path)
    assert not cache.has_newer(0.0)
    cache.put("0123", {"a": np.zeros(1)})
    written_s = next(tmp_path.glob("*/*.npz")).stat().st_mtime
    assert cache.has_newer(written_s - 1) and not cache.has_newer(written_s)
