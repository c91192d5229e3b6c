"""Workers share jobs: results do not depend on how many there are, and one that dies costs its clip's time alone."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import textwrap
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.evaluation.studies import world
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import jobs as studies_jobs
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.jobs import CONNECT_S, MAX_DEATHS, Workers
from torchvision_dddas.evaluation.studies.runner import plan_study, read_spec, run_jobs, run_study
from torchvision_dddas.evaluation.studies.summary import summarize

linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds workers by /proc")

SCHEDULER = """
    import asyncio
    from distributed import Scheduler
    async def main():
        async with Scheduler(host="127.0.0.1", port=0, dashboard=False, dashboard_address=None) as scheduler:
            print(scheduler.address, flush=True)
            await scheduler.finished()
    asyncio.run(main())
"""

WORKER = """
    import asyncio, sys
    {before}
    from distributed import Worker
    async def main():
        async with Worker(sys.argv[1], nthreads=1, dashboard=False) as worker:
            print(worker.address, flush=True)
            await worker.finished()
    asyncio.run(main())
"""

OTHER_CODE = "import torchvision_dddas.evaluation.studies.jobs as jobs; jobs.code_identity = lambda backend: 'other'"


@contextmanager
def process(script: str, *words: str, before: str = ""):
    """A process that prints its address in its first line; it ends with the block."""
    command = [sys.executable, "-c", textwrap.dedent(script).replace("{before}", before), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as run:
        try:
            assert run.stdout is not None
            yield run.stdout.readline().strip()
        finally:
            run.kill()


@pytest.fixture
def study(tmp_path):
    return read_spec(world.three(tmp_path / "clips"))


@pytest.fixture
def jobs(study, tmp_path):
    return {job.clip.name: job for job in plan_study(study, tmp_path).jobs}


@pytest.fixture(scope="module")
def scheduler():
    pytest.importorskip("distributed")
    with process(SCHEDULER) as address:
        yield address


def children(parent: int) -> list[int]:
    """The worker processes of a process: those that Python's multiprocessing has spawned."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            ppid = int(stat.read_text().rpartition(")")[2].split()[1])
            command = (stat.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if ppid == parent and b"spawn_main" in command:
            found.append(int(stat.parent.name))
    return found


def die_over_tracks(job, keys, store, code):
    """In place of `studies_jobs._do_remotely`: the worker is killed, so often as a file says."""
    left = store.folder / "deaths"
    if job.clip.name == "tracks" and (deaths := int(left.read_text())):
        left.write_text(str(deaths - 1))
        os.kill(os.getpid(), signal.SIGKILL)
    return studies_jobs._do_remotely(job, keys, store, code)


@pytest.mark.slow
@pytest.mark.parametrize("deaths", [1, MAX_DEATHS])
def test_a_dead_worker_costs_its_clip_s_time_and_the_third_one_the_clip(jobs, tmp_path, monkeypatch, deaths) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(studies_jobs, "_do_remotely", die_over_tracks)
    cache = Cache(tmp_path / "cache")
    (cache.folder / "deaths").write_text(str(deaths))
    with Workers(2) as team:
        done = run_jobs([jobs["tracks"], jobs["table"]], team, cache)
    assert all(d.cause == "" for d in done[jobs["table"].number])
    for outcome in done[jobs["tracks"].number]:
        lost = f"its worker died {MAX_DEATHS} times; is there memory enough for tracks and onboard?"
        assert outcome.cause == ("" if deaths == 1 else lost)


DDDAS = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]


def command(study: Path, out: Path, cache: Path, *more: str) -> list[str]:
    return [*DDDAS, "evaluate", "--dataset", str(study), "--out", str(out), "--cache", str(cache), *more]


def stopped_after(line: str, words: list[str], by: signal.Signals) -> int:
    """Run a command and stop it once a line of stderr holds some words; its exit code. Its workers end with it."""
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        assert run.stderr is not None
        assert any(line in text for text in run.stderr)
        ends = [os.pidfd_open(pid) for pid in children(run.pid)]
        assert ends
        run.send_signal(by)
        run.wait(60)
    for end in ends:  # nobody is left to compute for nobody
        assert select.select([end], [], [], 60.0)[0]
        os.close(end)
    return run.returncode


@pytest.mark.slow
@linux
def test_a_study_killed_interrupted_and_resumed_gives_the_same_bytes_as_one_process(tmp_path) -> None:
    pytest.importorskip("distributed")
    study = world.three(tmp_path / "clips")
    whole, out = tmp_path / "whole", tmp_path / "out"
    subprocess.run(command(study, whole, tmp_path / "other", "--jobs", "1", "--quiet"), check=True)
    words = command(study, out, tmp_path / "cache", "--jobs", "2")
    assert stopped_after("1 of 3", words, signal.SIGKILL) == -signal.SIGKILL
    assert json.loads((out / "run.json").read_text())["state"] == "running"
    assert not (out / "metrics.json").exists()
    assert stopped_after("2 of 3", words, signal.SIGINT) == 130
    assert json.loads((out / "run.json").read_text())["state"] == "interrupted"
    last = subprocess.run(words, check=True, capture_output=True, text=True)
    assert last.stderr.count("kept") > 0
    assert (out / "metrics.json").read_bytes() == (whole / "metrics.json").read_bytes()
    assert json.loads((out / "run.json").read_text())["state"] == "complete"


@pytest.mark.slow
def test_a_cluster_finds_what_one_process_finds_and_survives_a_lost_worker(scheduler, study, tmp_path) -> None:
    here = run_study(study, tmp_path, cache=tmp_path / "here")
    with Workers(scheduler=scheduler) as cluster, process(WORKER, scheduler):
        with process(WORKER, scheduler):
            there = run_study(study, tmp_path, cluster, tmp_path / "there", ["masks"])
        there = run_study(study, tmp_path, cluster, tmp_path / "there")
    assert summarize(there) == summarize(here)
    assert 0 < there.facts["computed"] < here.facts["computed"]
    with Workers(scheduler=scheduler) as cluster:  # all is kept here: no worker is needed, and there is none
        again = run_study(study, tmp_path, cluster, tmp_path / "there")
    assert again.facts["computed"] == 0 and summarize(again) == summarize(here)


@pytest.mark.slow
def test_a_worker_with_another_version_of_the_package_is_one_line(scheduler, jobs, tmp_path) -> None:
    with (
        process(WORKER, scheduler, before=OTHER_CODE),
        Workers(scheduler=scheduler) as cluster,
        pytest.raises(InputError, match="another version of the package") as caught,
    ):
        run_jobs([jobs["table"]], cluster, Cache(tmp_path / "cache"))
    assert "\n" not in str(caught.value)


def test_a_scheduler_without_workers_is_one_line(scheduler, jobs, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(studies_jobs, "NO_WORKER_S", 0.0)
    with Workers(scheduler=scheduler) as cluster, pytest.raises(InputError, match="has had no worker"):
        run_jobs([jobs["table"]], cluster, Cache(tmp_path / "cache"))


def test_a_scheduler_that_cannot_be_reached_is_one_line_within_seconds() -> None:
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1") as told:
        Workers(scheduler=address).__enter__()
    assert "\n" not in str(told.value) and time.monotonic() - begun < 5 * CONNECT_S


@pytest.mark.parametrize("address", ["nonsense", "foo://127.0.0.1:1", "tcp://", ""])
def test_an_address_that_is_none_is_one_line(address) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="wanted an address as tcp://host:8786"):
        Workers(scheduler=address).__enter__()


@pytest.mark.parametrize("asked", [{"jobs": 2}, {"scheduler": "tcp://127.0.0.1:1"}])
def test_without_dask_the_line_says_what_to_install(monkeypatch, asked) -> None:
    monkeypatch.setattr(studies_jobs, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'torchvision-dddas\[distributed\]'"):
        Workers(**asked)


def test_one_process_does_jobs_without_dask(jobs, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(studies_jobs, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "distributed", None)
    frames = []
    done = run_jobs([jobs["table"]], Workers(), Cache(tmp_path), lambda event: frames.append(event.frames))
    assert [d.cause for d in done[jobs["table"].number]] == ["", ""] and sum(frames) > 0
