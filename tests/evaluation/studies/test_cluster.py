"""Jobs on a Dask cluster: the results are those of one machine, and what goes wrong is one line."""

import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.evaluation.studies import world
from tests.evaluation.studies.test_jobs import contents, linux
from tests.evaluation.studies.test_running import command
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import cluster
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.cluster import connected, spread
from torchvision_dddas.evaluation.studies.running import plan, run_study
from torchvision_dddas.evaluation.studies.spec import read_spec
from torchvision_dddas.evaluation.studies.summary import summary

pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")

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
        async with Worker(sys.argv[1], nthreads=1, dashboard=False, name=sys.argv[2]) as worker:
            print(worker.address, flush=True)
            await worker.finished()
    asyncio.run(main())
"""

OTHER = """
    from torchvision_dddas.evaluation.studies import cluster
    cluster.identity = lambda backend: ("0.0.9", "other code")
"""

NONE = """
    sys.modules["torchvision_dddas"] = None
"""


@contextmanager
def process(script: str, *words: str, before: str = ""):
    """A process that says its address in its first line; ends with the block."""
    script = textwrap.dedent(script).replace("{before}", "\n".join(textwrap.dedent(before).split("\n")).strip())
    command = [sys.executable, "-c", script, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as run:
        try:
            assert run.stdout is not None
            yield run, run.stdout.readline().strip()
        finally:
            run.kill()


@pytest.fixture(scope="module")
def scheduler():
    with process(SCHEDULER) as (_, address):
        yield address


@pytest.fixture
def client(scheduler):
    with connected(scheduler) as client:
        yield client


@pytest.fixture
def study(tmp_path):
    return read_spec(world.three(tmp_path / "clips"))


def ended(events):
    found = list(events)
    return {e.job.clip.name: e.done for e in found if e.done is not None}, [e.note for e in found if e.note]


def test_a_cluster_finds_what_one_machine_finds(scheduler, study, tmp_path) -> None:
    here = run_study(study, tmp_path, jobs=0, cache=tmp_path / "here")
    with process(WORKER, scheduler, "one"), process(WORKER, scheduler, "two"):
        there = run_study(study, tmp_path, scheduler=scheduler, cache=tmp_path / "there")
    assert summary(there) == summary(here)
    assert there.facts["computed"] == here.facts["computed"] > 0
    # All is kept here: no worker is needed any more, and there is none.
    again = run_study(study, tmp_path, scheduler=scheduler, cache=tmp_path / "there")
    assert again.facts["computed"] == 0 and summary(again) == summary(here)


@linux
def test_a_killed_worker_costs_its_clip_s_time_only(scheduler, client, study, tmp_path) -> None:
    jobs = {job.clip.name: job for job in plan(study, tmp_path).jobs}
    wanted, _ = ended(_alone(list(jobs.values()), tmp_path))
    picture = jobs["tracks"].clip.pictures[4]
    content = picture.read_bytes()
    picture.unlink()
    os.mkfifo(picture)
    with process(WORKER, scheduler, "first") as (first, _):

        def trap() -> None:
            # The client looks at the files too, to know what is kept: the second reader is the worker.
            for reader in range(2):
                with picture.open("wb") as file:
                    if reader == 0:
                        file.write(content)
                        continue
                    picture.unlink()
                    picture.write_bytes(content)
                    first.send_signal(signal.SIGKILL)
                    first.wait()

        thread = threading.Thread(target=trap, daemon=True)
        thread.start()
        events = spread([jobs["tracks"], jobs["table"]], client, Cache(tmp_path / "cache"))
        with process(WORKER, scheduler, "second"):
            done, notes = ended(events)
        thread.join()
    assert len(notes) == 1 and "is gone; it is tried again" in notes[0]
    for name in ("tracks", "table"):
        assert contents(done, tmp_path / "cache")[name] == contents(wanted, tmp_path / "alone")[name]


def _alone(jobs, tmp_path):
    from torchvision_dddas.evaluation.studies.digests import Files
    from torchvision_dddas.evaluation.studies.jobs import Event
    from torchvision_dddas.evaluation.studies.working import work

    cache = Cache(tmp_path / "alone")
    return [Event(job, tuple(work(job, cache, Files(None)))) for job in jobs]


@pytest.mark.parametrize(
    ("before", "words"), [(OTHER, "of this package it has version 0.0.9"), (NONE, "it has none that can be used")]
)
def test_a_worker_with_another_version_gets_no_clip_and_is_told_in_one_line(
    scheduler, client, study, tmp_path, before, words
) -> None:
    jobs = plan(study, tmp_path).jobs
    with process(WORKER, scheduler, "other", before=before) as (_, other), process(WORKER, scheduler, "same"):
        done, notes = ended(spread(jobs, client, Cache(tmp_path / "cache")))
    assert all(d.cause == "" for each in done.values() for d in each)
    (line,) = notes
    assert line.startswith(other) and words in line and "\n" not in line


def test_no_worker_with_this_version_is_one_line(scheduler, client, study, tmp_path) -> None:
    jobs, words = plan(study, tmp_path).jobs, "has had no worker with this version of the package"
    with process(WORKER, scheduler, "other", before=OTHER), pytest.raises(InputError, match=words):
        ended(spread(jobs, client, Cache(tmp_path / "cache"), alone_s=0.0))


def test_a_scheduler_that_cannot_be_reached_is_one_line_within_seconds(study, tmp_path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1") as told:
        run_study(study, tmp_path, scheduler=address, cache=tmp_path / "cache")
    assert "\n" not in str(told.value)
    assert time.monotonic() - begun < 5 * cluster.CONNECT_S


@pytest.mark.parametrize("address", ["nonsense", "foo://127.0.0.1:1", "tcp://", ""])
def test_an_address_that_is_none_is_one_line(study, tmp_path, address) -> None:
    with pytest.raises(InputError, match="wanted an address as tcp://host:8786"):
        run_study(study, tmp_path, scheduler=address, cache=tmp_path / "cache")


def test_nothing_follows_the_line_about_an_address_that_is_none(tmp_path) -> None:
    world.three(tmp_path / "clips")
    words = command(tmp_path / "study.toml", tmp_path / "out", tmp_path / "cache", "--scheduler", "nonsense")
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr


def test_without_dask_the_line_says_what_to_install(study, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'torchvision-dddas\[distributed\]'"):
        run_study(study, tmp_path, scheduler="tcp://127.0.0.1:1", cache=tmp_path / "cache")


def test_workers_read_the_same_package_as_this_one() -> None:
    script = "from torchvision_dddas.evaluation.studies.cluster import identity; print(*identity('onboard'))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
    )
    assert tuple(done.stdout.split()) == cluster.identity("onboard")
