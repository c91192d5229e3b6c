"""Workers share jobs: what they find does not depend on how many there are, and one that dies costs its clip's time."""

import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from tests.evaluation.studies import world
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.jobs import TRIES, share
from torchvision_dddas.evaluation.studies.running import plan
from torchvision_dddas.evaluation.studies.spec import read_spec
from torchvision_dddas.evaluation.studies.worker import LIMITS

linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds workers by /proc")


@pytest.fixture
def jobs(tmp_path):
    return plan(read_spec(world.three(tmp_path / "clips")), tmp_path).jobs


def ended(jobs, workers, cache):
    return {event.job.clip.name: event.done for event in share(jobs, workers, cache) if event.done is not None}


def contents(done, cache):
    """All that was scored, as bytes."""
    return {name: [Cache(cache).content(d.scored) for d in each] for name, each in done.items()}


def test_results_depend_neither_on_the_number_of_workers_nor_on_the_order(jobs, tmp_path) -> None:
    one = ended(jobs, 1, tmp_path / "one")
    two = ended(jobs[::-1], 2, tmp_path / "two")
    assert all(d.cause == "" and d.computed for each in one.values() for d in each)
    assert two == one
    assert contents(two, tmp_path / "two") == contents(one, tmp_path / "one")
    assert None not in contents(one, tmp_path / "one")["tracks"]


def workers_of(parent: int) -> list[int]:
    """The worker processes that a process started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            ppid = int(stat.read_text().rpartition(")")[2].split()[1])
            command = (stat.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if ppid == parent and b"torchvision_dddas.evaluation.studies.worker" in command:
            found.append(int(stat.parent.name))
    return found


class Trap:
    """A picture that a worker waits for, and is killed while it does."""

    def __init__(self, picture: Path, times: int) -> None:
        self.content, self.picture, self.times = picture.read_bytes(), picture, times
        picture.unlink()
        os.mkfifo(picture)
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        for k in range(self.times):
            with self.picture.open("wb"):  # goes on once somebody reads
                if k + 1 == self.times < TRIES:
                    self.picture.unlink()
                    self.picture.write_bytes(self.content)
                (worker,) = workers_of(os.getpid())
                end = os.pidfd_open(worker)
                os.kill(worker, signal.SIGKILL)
                select.select([end], [], [])  # until it is gone, and does not read any more
                os.close(end)


@linux
def test_a_killed_worker_costs_its_clip_s_time_only(jobs, tmp_path) -> None:
    wanted = ended(jobs, 1, tmp_path / "untroubled")
    by_name = {job.clip.name: job for job in jobs}
    trap = Trap(by_name["tracks"].clip.pictures[4], times=1)
    events = list(share([by_name["masks"], by_name["tracks"], by_name["table"]], 1, tmp_path / "cache"))
    trap.thread.join()
    done = {event.job.clip.name: event.done for event in events if event.done is not None}
    notes = [event.note for event in events if event.note]
    assert notes == ["tracks: its worker was killed (SIGKILL); it is tried again"]
    assert contents(done, tmp_path / "cache") == contents(wanted, tmp_path / "untroubled")
    assert [event.job.clip.name for event in events if event.done is not None] == ["masks", "tracks", "table"]


@linux
def test_a_clip_that_always_kills_its_worker_is_left_out_and_the_others_go_on(jobs, tmp_path) -> None:
    by_name = {job.clip.name: job for job in jobs}
    trap = Trap(by_name["tracks"].clip.pictures[4], times=TRIES)
    done = ended([by_name["tracks"], by_name["table"]], 1, tmp_path / "cache")
    trap.thread.join()
    assert all(f"was killed (SIGKILL), {TRIES} times" in d.cause for d in done["tracks"])
    assert all(d.cause == "" for d in done["table"])


@linux
def test_leaving_early_ends_the_workers(jobs, tmp_path) -> None:
    events = share(jobs, 2, tmp_path / "cache")
    next(events)
    events.close()
    assert workers_of(os.getpid()) == []


def test_a_worker_runs_the_libraries_on_one_thread() -> None:
    script = """
        import os
        from torchvision_dddas.evaluation.studies.worker import LIMITS, one_thread
        one_thread("onboard")
        import cv2
        assert cv2.getNumThreads() == 1 and all(os.environ[name] == value for name, value in LIMITS.items())
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script)], env={**os.environ, **LIMITS}, check=True)
