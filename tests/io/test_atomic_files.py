"""Files under way belong to one process, folders to one run, and what killed processes left is removed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import (
    ClaimedFolder,
    PartFile,
    claimed,
    remove_left_behind,
    utf8_name,
    write_whole,
)
from torchvision_dddas.lab.evaluation.studies.cache import Cache

ROOT = Path(__file__).resolve().parents[2]

HOLD = """
import sys, time
from pathlib import Path
from torchvision_dddas.io.atomic_files import ClaimedFolder, PartFile
claim, part = ClaimedFolder(Path(sys.argv[1])), PartFile(Path(sys.argv[1]) / "a.csv")
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that has claimed the folder and writes a file there."""
    program = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


def parts(folder):
    return [path.name for path in folder.iterdir() if ".part" in path.name]


def test_a_folder_that_another_process_writes_into_is_refused_and_its_files_are_left(holder, tmp_path):
    with pytest.raises(InputError, match=r"another run is writing into .*out.*--out"):
        ClaimedFolder(tmp_path / "out")
    remove_left_behind(tmp_path / "out")
    assert len(parts(tmp_path / "out")) == 1


def test_what_a_killed_process_left_is_removed_and_its_folder_is_free(holder, tmp_path):
    holder.send_signal(signal.SIGKILL)
    holder.wait(60)
    assert len(parts(tmp_path / "out")) == 1
    with claimed(tmp_path / "out"):
        assert parts(tmp_path / "out") == []
    assert not (tmp_path / "out" / ".dddas.lock").exists()


def test_two_files_under_way_have_names_of_their_own_and_an_existing_name_is_not_taken(tmp_path, monkeypatch):
    one, other = PartFile(tmp_path / "a.csv"), PartFile(tmp_path / "a.csv")
    one.write(b"one")
    other.write(b"other")
    other.keep()
    assert (tmp_path / "a.csv").read_bytes() == b"other"
    one.keep()
    assert (tmp_path / "a.csv").read_bytes() == b"one"
    monkeypatch.setattr("secrets.token_hex", lambda count: "0" * 16)
    taken = PartFile(tmp_path / "b.csv")
    with pytest.raises(FileExistsError):
        write_whole(tmp_path / "b.csv", b"")
    taken.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_a_folder_made_for_nothing_is_not_left_behind(tmp_path):
    with claimed(tmp_path / "deep" / "out"):
        pass
    assert list(tmp_path.iterdir()) == []


WRITE = """
import sys
from pathlib import Path
from torchvision_dddas.lab.evaluation.studies.cache import Cache
cache = Cache(Path(sys.argv[1]))
for _ in range(30):
    cache.put("ab" * 32, bytes([int(sys.argv[2])]) * 300_000)
"""


def test_two_processes_with_one_cache_tear_no_entry(tmp_path):
    cache = Cache(tmp_path)
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITE, str(tmp_path), mark], stderr=subprocess.PIPE, cwd=ROOT)
        for mark in "12"
    ]
    while None in [writer.poll() for writer in writers]:
        assert cache.get("ab" * 32) in (None, b"\1" * 300_000, b"\2" * 300_000)
    assert [writer.communicate(timeout=60)[1] for writer in writers] == [b"", b""]
    assert cache.get("ab" * 32) is not None and cache.notes == []
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [cache.path("ab" * 32)]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems take no such names")
@pytest.mark.parametrize("name", [b"plain.mp4", "für.mp4".encode(), b"cl\xffip.mp4", b"fold\xffer/clip.mp4"])
def test_every_file_has_a_name_in_utf8_with_the_same_ending(tmp_path, name):
    path = tmp_path / os.fsdecode(name)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"content")
    found = utf8_name(path)
    assert found.encode().endswith(b".mp4")
    assert Path(found).read_bytes() == b"content"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_error_of_an_open_file_names_it(tmp_path):
    part = PartFile(tmp_path / "a.csv")
    full = os.open("/dev/full", os.O_WRONLY)
    with pytest.raises(OSError, match="No space left") as error, part.naming():
        os.write(full, b"1")
    os.close(full)
    assert error.value.filename == str(part.path)
    part.discard()
