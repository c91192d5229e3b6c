"""Lines into files and pipes, with the trouble that a real system makes."""

import json
import os
import resource
import threading

import pytest
from torchvision_dddas.io.streams.line_outlet import KEPT_BYTES, LineOutlet

from tests.io.streamed import ABOUT, Told, surveyed
from torchvision_dddas.io.streams import open_stream


@pytest.fixture
def room():
    """Lets no file grow beyond a size, as a full disk does: the kernel writes a part of a line and refuses the rest."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def lines(*sizes):
    return [b"%d" % (k % 10) * (size - 1) + b"\n" for k, size in enumerate(sizes, 1)]


def taken(pipe):
    """What a pipe holds at the moment."""
    os.set_blocking(pipe, False)
    found = b""
    try:
        while more := os.read(pipe, 1 << 16):
            found += more
    except BlockingIOError:
        pass
    return found


def test_a_file_holds_each_line_as_soon_as_it_is_written_and_goes_on_where_it_ended(tmp_path):
    path = tmp_path / "x.jsonl"
    for first in (1, 3):
        stream = open_stream(f"json:{path}", ABOUT, Told())
        for number in (first, first + 1):
            stream.write(surveyed(number))
            assert json.loads(path.read_text().splitlines()[-1])["frame"] == number  # before it is closed
            stream.sync()
        stream.close()
    assert [json.loads(line)["frame"] for line in path.read_text().splitlines()] == [1, 2, 3, 4]


def test_a_disk_that_fills_up_within_a_line_keeps_whole_lines_and_loses_none(tmp_path, room):
    path = tmp_path / "x.txt"
    outlet = LineOutlet(path)
    one, two, three = lines(100, 10_000, 200)
    room(5_000)
    outlet.put([one, two, three])
    with pytest.raises(OSError, match="too large"):
        outlet.flush()
    assert path.read_bytes() == one
    room(resource.RLIM_INFINITY)
    outlet.mend()
    outlet.flush()
    outlet.close()
    assert path.read_bytes() == one + two + three and outlet.lost == 0


def test_standard_output_into_a_file_on_a_full_disk_keeps_whole_lines_too(tmp_path, room, monkeypatch):
    path = tmp_path / "x.txt"
    with path.open("wb") as file:  # `> FILE`: not for appending
        outlet = LineOutlet(None)
        monkeypatch.setattr(outlet, "_file", file.fileno())
        monkeypatch.setattr(outlet, "_regular", True)
        one, two = lines(100, 10_000)
        room(5_000)
        outlet.put([one, two])
        with pytest.raises(OSError, match="too large"):
            outlet.flush()
        room(resource.RLIM_INFINITY)
        outlet.flush()
    assert path.read_bytes() == one + two


def test_a_device_without_room_is_told_once_and_ends_nothing():
    told = Told()
    stream = open_stream("json:/dev/full", ABOUT, told)
    for number in range(1, 20):
        stream.write(surveyed(number))
    stream.close()
    assert told == [
        "json:/dev/full: No space left on device; trying again in 0.5 s",
        "json:/dev/full closed; 19 messages lost",
    ]


def test_a_line_that_a_killed_run_left_half_written_does_not_spoil_the_next(tmp_path):
    path = tmp_path / "x.jsonl"
    path.write_bytes(b'{"frame":1}\n{"fra')
    stream = open_stream(f"json:{path}", ABOUT, Told())
    stream.write(surveyed(2))
    stream.close()
    first, torn, last = path.read_text().splitlines()
    assert (first, torn) == ('{"frame":1}', '{"fra') and json.loads(last)["frame"] == 2


def test_a_file_that_is_moved_away_or_removed_is_begun_anew(tmp_path):
    path, moved = tmp_path / "x.jsonl", tmp_path / "x.jsonl.1"
    told = Told()
    stream = open_stream(f"json:{path}", ABOUT, told)
    stream.write(surveyed(1))
    path.rename(moved)
    stream.write(surveyed(2))
    path.unlink()
    stream.write(surveyed(3))
    stream.close()
    assert [json.loads(p.read_text())["frame"] for p in (moved, path)] == [1, 3] and told == []


def test_a_folder_that_disappears_is_told_and_comes_back(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    told = Told()
    stream = open_stream(f"json:{folder}/x", ABOUT, told, retry_s=0.0, retry_most_s=0.0)
    (folder / "x").unlink()
    folder.rmdir()
    for number in (1, 2):
        stream.write(surveyed(number))
    assert [text.split("; ")[0].split(": ")[1] for text in told] == ["No such file or directory"]
    folder.mkdir()
    stream.write(surveyed(3))
    stream.close()
    assert [json.loads(line)["frame"] for line in (folder / "x").read_text().splitlines()] == [1, 2, 3]
    assert told[1:] == [f"json:{folder}/x works again; no messages lost"]


def test_a_pipe_that_nobody_reads_neither_blocks_nor_grows_and_a_slow_reader_gets_whole_lines(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    outlet = LineOutlet(path)
    count = 40
    for line in lines(*[100_000] * count):  # more than the pipe and what is kept
        outlet.put([line])
        outlet.flush()
        assert outlet._kept_bytes <= KEPT_BYTES
    assert 0 < outlet.lost < count
    got = b""
    while outlet._kept:
        got += taken(reader)
        outlet.flush()
    got += taken(reader)
    found = got.split(b"\n")[:-1]
    assert len(found) == count - outlet.lost
    assert all(len(line) == 99_999 and len(set(line)) == 1 for line in found)
    assert found[-1][:1] == b"0"  # the newest: the oldest are lost
    os.close(reader)
    outlet.close()


def test_a_pipe_is_read_by_another_after_its_reader_went_away(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    told = Told()
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    stream = open_stream(f"json:{path}", ABOUT, told, retry_s=0.0, retry_most_s=0.0)
    stream.write(surveyed(1))
    os.close(reader)
    stream.write(surveyed(2))
    stream.write(surveyed(3))
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    stream.write(surveyed(4))
    assert [json.loads(line)["frame"] for line in taken(reader).splitlines()] == [2, 3, 4]
    assert [text.split("; ")[0] for text in told] == [f"json:{path}: nobody reads it", f"json:{path} works again"]
    os.close(reader)
    stream.close()


def test_closing_waits_a_little_for_a_reader_that_is_at_work(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    outlet = LineOutlet(path)
    line = lines(500_000)[0]
    outlet.put([line])
    outlet.flush()
    got = []
    os.set_blocking(reader, True)

    def read():
        while more := os.read(reader, 1 << 16):
            got.append(more)

    thread = threading.Thread(target=read)
    thread.start()
    outlet.close()
    thread.join()
    os.close(reader)
    assert b"".join(got) == line and outlet.lost == 0


def test_standard_output_gets_the_lines_and_stays_open(capfd):
    stream = open_stream("mot:-", ABOUT, Told())
    stream.write(surveyed(7))
    stream.close()
    os.write(1, b"open\n")
    assert capfd.readouterr().out.splitlines() == [
        "7,1,10.00,20.00,30.00,40.00,0.875,-1,-1,-1",
        "7,2,20.00,20.00,30.00,40.00,0.875,-1,-1,-1",
        "open",
    ]
