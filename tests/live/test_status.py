"""The health of a run, and what is written of it while it goes on."""

import json
import threading
from typing import Any

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output import SessionLog, make_session_folder
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.status import StatusWriter


def test_counts_of_many_threads_add_up():
    health = Health()

    def often():
        for _ in range(500):
            health.count("read")

    threads = [threading.Thread(target=often) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert health.snapshot().counts == {"read": 2000}


def test_percentiles_are_of_the_latest_times():
    health = Health()
    for _ in range(10):
        health.took("step", 9.0)
    for k in range(4096):
        health.took("step", k / 4095)
    assert health.snapshot().seconds["step"] == pytest.approx((0.5, 0.95, 0.99), abs=1e-3)


def test_a_result_makes_the_run_fresh_and_events_are_kept_in_order():
    health = Health()
    health.event("stream", "lost", 3)
    health.event("stream", "found again", 7)
    health.result()
    told = health.snapshot()
    assert told.idle_s < 1
    assert [(event.frame, event.text) for event in told.events] == [(3, "lost"), (7, "found again")]
    assert told.counts == {"events_stream": 2, "results": 1}


class Disk(Any):
    """A log that may be full."""

    def __init__(self):
        self.full, self.lines, self.states = False, [], []

    def append(self, events):
        if self.full:
            raise OSError(28, "No space left on device")
        self.lines += [event.text for event in events]

    def write_state(self, state, now):
        if self.full:
            raise OSError(28, "No space left on device")
        self.states.append((state, now["counts"].get("results", 0)))


class Flow(Any):
    synced = 0

    def sync(self):
        self.synced += 1


def test_events_are_written_and_said_once_each_in_order():
    health, disk, said = Health(), Disk(), []
    status = StatusWriter(health, disk, [], 1.0, lambda event: said.append(event.text))
    health.event("run", "one")
    health.event("stream", "two")
    status.events()
    health.event("run", "three")
    status.events()
    status.events()
    assert disk.lines == said == ["one", "two", "three"]


def test_a_disk_that_refuses_is_told_once_and_gets_everything_later():
    health, disk, said = Health(), Disk(), []
    status = StatusWriter(health, disk, [], 1.0, lambda event: said.append(event.text))
    disk.full = True
    for words in ("one", "two", "three"):
        health.event("run", words)
        status.events()
        status.status()
    assert sum("No space left on device" in words for words in said) == 1
    disk.full = False
    status.events()
    status.status()
    assert [words for words in disk.lines if "No space" not in words] == ["one", "two", "three"]
    assert disk.states == [("running", 0)]


def test_the_last_word_is_written_and_results_are_put_on_the_disk():
    health, disk, flow = Health(), Disk(), Flow()
    with StatusWriter(health, disk, [flow], 1000.0) as status:
        health.result()
        health.event("run", "the end")
        status.state = "complete"
    assert disk.lines == ["the end"]
    assert disk.states == [("complete", 1)]
    assert flow.synced == 1


def test_a_run_that_ends_by_an_error_of_ours_counts_as_failed():
    disk = Disk()
    with pytest.raises(ZeroDivisionError), StatusWriter(Health(), disk, [], 1000.0):
        raise ZeroDivisionError
    assert disk.states[-1][0] == "failed"


def test_each_session_has_a_folder_of_its_own(tmp_path):
    one, two, three = (make_session_folder(tmp_path / "out", utc_s) for utc_s in (0.0, 0.5, 60.0))
    assert [folder.name for folder in (one, two, three)] == [
        "1970-01-01T000000Z",
        "1970-01-01T000000Z-2",
        "1970-01-01T000100Z",
    ]


def test_a_place_where_no_folder_can_be_is_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"cannot write into .*file.*--out"):
        make_session_folder(tmp_path / "file")


def test_a_session_is_valid_at_every_moment(tmp_path):
    health, log = Health(), SessionLog(tmp_path, {"input": "camera:0", "odd": float("nan")})
    log.write_state("running", {"counts": {}})
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "running"
    log.append([health.event("stream", "lost\nand found", 4), health.event("run", "é")])
    lines = (tmp_path / "events.log").read_text().splitlines()
    assert len(lines) == 2
    assert lines[0].endswith("Z 4 stream: lost and found")
    assert lines[1].endswith("Z - run: é")
    log.close()
    assert json.loads((tmp_path / "run.json").read_text())["odd"] is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events.log", "run.json"]
