"""What is kept appears whole or not at all, and is computed again where it is damaged."""

import os
from pathlib import Path

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.cache import Cache, Carried
from torchvision_dddas.evaluation.studies.scored import Scored

KEY = "ab" + "0" * 62


def record() -> Scored:
    return Scored(np.arange(3), {})


def test_what_was_kept_is_found_again_by_its_key_alone(tmp_path) -> None:
    Cache(tmp_path).put(KEY, record())
    again = Cache(tmp_path)
    known = again.get(KEY)
    assert again.has(KEY) and known is not None and (known.frames == np.arange(3)).all()
    assert not again.has(KEY[::-1]) and again.get(KEY[::-1]) is None


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b"", lambda b: b[:40] + b"x" + b[41:]])
@pytest.mark.parametrize("look", [Cache.has, Cache.get])
def test_a_damaged_entry_is_told_once_and_removed(tmp_path, damage, look) -> None:
    told: list[str] = []
    cache = Cache(tmp_path, told.append)
    cache.put(KEY, record())
    cache.place(KEY).write_bytes(damage(cache.place(KEY).read_bytes()))
    assert not look(cache, KEY)
    assert not look(cache, KEY)
    (line,) = told
    assert "damaged" in line and KEY in line
    cache.put(KEY, record())
    assert cache.has(KEY)


def test_an_entry_that_cannot_be_finished_leaves_nothing(tmp_path, monkeypatch) -> None:
    cache = Cache(tmp_path)

    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"No space left on device.*choose another --cache"):
        cache.put(KEY, record())
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_cache_that_cannot_be_is_one_line(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another --cache"):
        Cache(tmp_path / "file" / "cache")


def test_what_travels_with_a_job_is_used_and_what_it_makes_comes_back() -> None:
    there = Carried({})
    there.put(KEY, record())
    (content,) = there.made.values()
    back = Carried({KEY: content})
    known = back.get(KEY)
    assert known is not None and (known.frames == np.arange(3)).all() and back.made == {}
    assert Carried({KEY: content[:-1]}).get(KEY) is None


def test_nothing_is_kept_under_a_half_written_name(tmp_path) -> None:
    cache = Cache(tmp_path)
    cache.put(KEY, record())
    assert os.listdir(tmp_path / KEY[:2]) == [f"{KEY}.npz"]  # noqa: PTH208
