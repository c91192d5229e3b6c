"""What is written while a run goes on, and its folder."""

import json

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output.live_session import SessionLog, claim
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.status import StatusWriter


class Disk:
    """A log that may be full."""

    def __init__(self):
        self.full, self.lines, self.states = False, [], []

    def tell(self, events):
        if self.full:
            raise OSError(28, "No space left on device")
        self.lines += [event.text for event in events]

    def state(self, state, now):
        if self.full:
            raise OSError(28, "No space left on device")
        self.states.append((state, now["counts"].get("results", 0)))


class Flow:
    synced = 0

    def sync(self):
        self.synced += 1


def test_events_are_written_and_said_once_each_in_order():
    health, disk, said = Health(), Disk(), []
    keeping = StatusWriter(health, disk, [], 1.0, lambda event: said.append(event.text))
    health.event("run", "one")
    health.event("stream", "two")
    keeping.events()
    health.event("run", "three")
    keeping.events()
    keeping.events()
    assert disk.lines == said == ["one", "two", "three"]


def test_a_disk_that_refuses_is_told_once_and_gets_everything_later():
    health, disk, said = Health(), Disk(), []
    keeping = StatusWriter(health, disk, [], 1.0, lambda event: said.append(event.text))
    disk.full = True
    for words in ("one", "two", "three"):
        health.event("run", words)
        keeping.events()
        keeping.status()
    assert sum("No space left on device" in words for words in said) == 1
    disk.full = False
    keeping.events()
    keeping.status()
    assert [words for words in disk.lines if "No space" not in words] == ["one", "two", "three"]
    assert disk.states == [("running", 0)]


def test_the_last_word_is_written_and_results_are_put_on_the_disk():
    health, disk, flow = Health(), Disk(), Flow()
    with StatusWriter(health, disk, [flow], 1000.0) as keeping:
        health.result()
        health.event("run", "the end")
        keeping.state = "complete"
    assert disk.lines == ["the end"]
    assert disk.states == [("complete", 1)]
    assert flow.synced == 1


def test_a_run_that_ends_by_an_error_of_ours_counts_as_failed():
    disk = Disk()
    with pytest.raises(ZeroDivisionError), StatusWriter(Health(), disk, [], 1000.0):
        raise ZeroDivisionError
    assert disk.states[-1][0] == "failed"


def test_each_session_has_a_folder_of_its_own(tmp_path):
    one, two, three = (claim(tmp_path / "out", utc_s) for utc_s in (0.0, 0.5, 60.0))
    assert [folder.name for folder in (one, two, three)] == [
        "1970-01-01T000000Z",
        "1970-01-01T000000Z-2",
        "1970-01-01T000100Z",
    ]


def test_a_place_where_no_folder_can_be_is_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"cannot write into .*file.*--out"):
        claim(tmp_path / "file")


def test_a_session_is_valid_at_every_moment(tmp_path):
    health, log = Health(), SessionLog(tmp_path, {"input": "camera:0", "odd": float("nan")})
    log.state("running", {"counts": {}})
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "running"
    log.tell([health.event("stream", "lost\nand found", 4), health.event("run", "é")])
    lines = (tmp_path / "events.log").read_text().splitlines()
    assert len(lines) == 2
    assert lines[0].endswith("Z 4 stream: lost and found")
    assert lines[1].endswith("Z - run: é")
    log.close()
    assert json.loads((tmp_path / "run.json").read_text())["odd"] is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events.log", "run.json"]
