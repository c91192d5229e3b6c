"""What is kept is not computed again; workers share jobs, and one that dies costs its clip's time alone."""

import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import textwrap
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from tests.lab.evaluation.studies import world
from torchvision_dddas.config import load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.studies import jobs
from torchvision_dddas.lab.evaluation.studies.cache import Cache
from torchvision_dddas.lab.evaluation.studies.jobs import Job, Workers, do_job, find_cached, make_keys
from torchvision_dddas.lab.evaluation.studies.runner import plan_study, read_spec, run_jobs, run_study
from torchvision_dddas.lab.evaluation.studies.summary import summarize

ALL = ["motion", "motion: score", "tracking", "tracking: score", "association", "association: score"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A cache in which all of a clip is kept, and the clip."""
    place = tmp_path_factory.mktemp("data")
    world.followed(place / "clips", "tracks", 2)
    assert computed(place, job_of(place)) == ALL
    return place


def job_of(place, *overrides, interval=1):
    (clip,) = world.clips_in(place / "clips")
    return Job(0, clip, ("motion", "tracking", "association"), load_config(None, overrides), "onboard", interval)


def with_truth(job, **changes):
    return replace(job, clip=replace(job.clip, truth=replace(job.clip.truth, **changes)))


def do(place, job, cache=None):
    return do_job(job, make_keys(job), cache or Cache(place / "cache"))


def computed(place, job):
    done = do(place, job)
    assert not any(d.cause for d in done)
    return [stage for d in done for stage in d.computed]


@pytest.mark.parametrize(
    ("change", "again"),
    [("difference.threshold=4.5", ALL[:4]), ("track.memory_frames=9", ALL[2:]), ("live.calm_s=9.0", [])],
)
def test_a_changed_parameter_computes_again_what_depends_on_it_and_nothing_else(folder, change, again) -> None:
    assert computed(folder, job_of(folder, change)) == again


def test_a_changed_interval_or_truth_leaves_what_does_not_depend_on_it(folder) -> None:
    stages = computed(folder, job_of(folder, interval=2))
    assert [stage for stage in stages if "score" not in stage] == ["tracking", "association"]
    tracks = job_of(folder).clip.truth.tracks
    again = computed(folder, with_truth(job_of(folder), tracks=tracks.at(tracks.frame != 2)))
    assert again == ["motion: score", "tracking: score", "association", "association: score"]


def test_a_clip_is_known_by_its_content_not_by_its_place_or_name(folder, tmp_path) -> None:
    place = world.followed(tmp_path / "clips", "renamed", 2)
    assert computed(folder, job_of(tmp_path)) == []
    pictures = sorted((place / "frames").iterdir())
    pictures[1].write_bytes(pictures[2].read_bytes())
    assert computed(folder, job_of(tmp_path)) == ALL


def test_other_code_is_another_key(folder, monkeypatch) -> None:
    before = make_keys(job_of(folder))
    monkeypatch.setattr(jobs, "code_digest", lambda backend: "another")
    for task, after in make_keys(job_of(folder)).items():
        assert before[task].found != after.found and before[task].scored != after.scored


def test_a_job_is_kept_only_if_all_of_it_is_whole(folder) -> None:
    cache, job = Cache(folder / "cache"), job_of(folder)
    keys = make_keys(job)
    assert find_cached(job, keys, cache) == do(folder, job)
    cache.path(keys["tracking"].found).write_bytes(b"damaged")
    assert find_cached(job, keys, cache) is None
    assert [stage for d in do(folder, job, cache) for stage in d.computed] == ["tracking"]
    assert len(cache.notes) == 1 and "computed again" in cache.notes[0]


def test_bad_input_and_faults_are_the_causes_of_the_tasks_that_meet_them(folder, tmp_path, monkeypatch) -> None:
    job = job_of(folder)
    tracks = job.clip.truth.tracks
    done = do(folder, with_truth(job, tracks=tracks._replace(frame=tracks.frame + 100)))
    assert done[0].cause == "" and "goes on to frame" in done[2].cause
    world.followed(tmp_path / "clips", "tracks", 2)
    gone = job_of(tmp_path)
    gone.clip.pictures[3].unlink()
    assert all("cannot be read" in d.cause for d in do(folder, gone))

    def broken(*given, **more):
        raise KeyError("x")

    monkeypatch.setattr(jobs, "find", broken)
    done = do(tmp_path, job)
    assert all("a fault of the program, KeyError: 'x'" in d.cause and "in broken" in d.trace for d in done)


def test_a_signal_that_a_library_turns_into_another_exception_ends_a_job(folder, monkeypatch) -> None:
    def stopped(*given, **more):
        raise RuntimeError("an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(jobs, "find", stopped)
    with pytest.raises(RuntimeError, match="an exception set"):
        do(folder, job_of(folder), Cache(folder / "empty"))


NODE = """
    import asyncio, sys
    {before}
    from distributed import Scheduler, Worker
    async def main():
        async with {node} as node:
            print(node.address, flush=True)
            await node.finished()
    asyncio.run(main())
"""
SCHEDULER = 'Scheduler(host="127.0.0.1", port=0, dashboard=False, dashboard_address=None)'
WORKER = "Worker(sys.argv[1], nthreads=1, dashboard=False)"
OTHER_CODE = "import torchvision_dddas.lab.evaluation.studies.jobs as jobs; jobs.code_digest = lambda backend: 'other'"


@contextmanager
def process(node: str, *words: str, before: str = "", **more: str):
    """A node of a cluster, which prints its address in its first line; it ends with the block."""
    command = [sys.executable, "-c", textwrap.dedent(NODE.format(node=node, before=before)), *words]
    pipe, nowhere, environment = subprocess.PIPE, subprocess.DEVNULL, {**os.environ, **more}
    with subprocess.Popen(command, stdout=pipe, stderr=nowhere, text=True, env=environment) as run:
        try:
            assert run.stdout is not None
            yield run.stdout.readline().strip()
        finally:
            run.kill()


@pytest.fixture
def study(tmp_path):
    return read_spec(world.three(tmp_path / "clips"))


@pytest.fixture
def by_name(study, tmp_path):
    return {job.clip.name: job for job in plan_study(study, tmp_path).jobs}


@pytest.fixture(scope="module")
def scheduler():
    pytest.importorskip("distributed")
    with process(SCHEDULER) as address:
        yield address


def die_over_tracks(job, keys, store, code):
    """In place of `jobs._do_remotely`: the worker is killed, as often as a file says."""
    left = store.folder / "deaths"
    if job.clip.name == "tracks" and (deaths := int(left.read_text())):
        left.write_text(str(deaths - 1))
        os.kill(os.getpid(), signal.SIGKILL)
    return jobs._do_remotely(job, keys, store, code)


@pytest.mark.slow
@pytest.mark.parametrize("deaths", [1, jobs.MAX_DEATHS])
def test_a_dead_worker_costs_its_clip_s_time_and_the_third_one_the_clip(by_name, tmp_path, monkeypatch, deaths) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(jobs, "_do_remotely", die_over_tracks)
    cache = Cache(tmp_path / "cache")
    (cache.folder / "deaths").write_text(str(deaths))
    with Workers(2) as team:
        done = run_jobs([by_name["tracks"], by_name["table"]], team, cache)
    assert not any(d.cause for d in done[by_name["table"].number])
    lost = f"its worker died or gave no sign {jobs.MAX_DEATHS} times; is there memory enough for tracks and onboard?"
    assert {d.cause for d in done[by_name["tracks"].number]} == {"" if deaths == 1 else lost}


def stopped_after(line: str, words: list[str], by: signal.Signals) -> int:
    """Run a command and stop it once a line of stderr holds some words and it has workers; its exit code.

    Its workers end with it.
    """
    psutil = pytest.importorskip("psutil")
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        assert run.stderr is not None
        assert any(line in text for text in run.stderr)
        # Clips that are kept are counted before a worker starts.
        workers, until = list[Any](), time.monotonic() + 60
        while not workers and time.monotonic() < until and run.poll() is None:
            children = psutil.Process(run.pid).children()
            workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
            time.sleep(0.05)
        assert workers
        run.send_signal(by)
        run.wait(60)
    assert not psutil.wait_procs(workers, 60)[1]
    return run.returncode


def stop_once(job, keys, store, code):
    """In place of `jobs._do_remotely`: the first worker that comes to a clip is stopped, and stays so."""
    with suppress(FileExistsError):
        if job.clip.name == "tracks":
            (store.folder / "stopped").touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGSTOP)
    return jobs._do_remotely(job, keys, store, code)


@pytest.mark.slow
@pytest.mark.parametrize("allowed", [True, False])
def test_a_worker_that_is_stopped_counts_as_dead(by_name, tmp_path, monkeypatch, allowed) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(jobs, "_do_remotely", stop_once)
    monkeypatch.setattr(jobs, "MAX_DEATHS", 2 if allowed else 1)
    with Workers(2, silent_s=15.0) as team:
        done = run_jobs([by_name["tracks"], by_name["table"]], team, Cache(tmp_path / "cache"))
    assert (tmp_path / "cache" / "stopped").exists()
    assert not any(d.cause for d in done[by_name["table"].number])
    assert {"gave no sign" in d.cause for d in done[by_name["tracks"].number]} == {not allowed}


def hang(job, keys, store, code):
    """In place of `jobs._do_remotely`: a job that takes long and heeds nothing."""
    (store.folder / "begun").touch()
    time.sleep(60)


@pytest.mark.slow
def test_busy_workers_do_not_hold_up_an_interrupt(by_name, tmp_path, monkeypatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(jobs, "_do_remotely", hang)
    cache, asked_s = Cache(tmp_path / "cache"), list[float]()

    def ask() -> None:
        while not (cache.folder / "begun").exists():
            time.sleep(0.05)
        asked_s.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    Thread(target=ask, daemon=True).start()
    with pytest.raises(KeyboardInterrupt), Workers(2) as team:
        run_jobs([by_name["tracks"], by_name["table"]], team, cache)
    assert time.monotonic() - asked_s[0] < 3.5  # Dask by itself waits 4 s for them


# The first worker that begins sends the signal to its starter.
AT_START = textwrap.dedent("""
    import os, signal
    from distributed import Nanny

    whole = Nanny.instantiate

    async def instantiate(nanny):
        os.kill(os.getpid(), signal.SIGTERM)
        return await whole(nanny)

    Nanny.instantiate = instantiate
""")


@pytest.mark.slow
@pytest.mark.parametrize("at_start", [True, False])
def test_a_signal_to_a_study_with_workers_is_one_line(tmp_path, at_start) -> None:
    pytest.importorskip("distributed")
    words = ["evaluate", "--dataset", world.three(tmp_path / "clips"), "--out", tmp_path / "out", "--jobs", "2"]
    program = (AT_START if at_start else "") + "from torchvision_dddas.cli import main; main()"
    call = [sys.executable, "-c", program, *map(str, words), "--cache", str(tmp_path / "cache")]
    pipe = subprocess.PIPE
    with subprocess.Popen(call, stdout=pipe, stderr=pipe, text=True, start_new_session=True) as run:
        assert run.stderr is not None
        if not at_start:
            assert any("1 of 3" in line for line in run.stderr)
            os.killpg(run.pid, signal.SIGHUP)  # as a terminal does that is closed
        error = run.communicate(timeout=60)[1]
    lines = [line for line in error.splitlines() if " clips" not in line.split(" kept")[0] and " of 3: " not in line]
    name = "SIGTERM" if at_start else "SIGHUP"
    assert len(lines) == 1 and lines[0].startswith(f"dddas: ended by {name}; "), error
    assert run.returncode == 128 + getattr(signal, name)


@pytest.mark.slow
def test_a_study_killed_interrupted_and_resumed_gives_the_same_bytes_as_one_process(tmp_path) -> None:
    pytest.importorskip("distributed")
    # The clip with tracks takes so long that it is under way when the two others are done.
    study, whole, out = world.three(tmp_path / "clips", tracked=45), tmp_path / "whole", tmp_path / "out"
    program = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]

    def command(out: Path, cache: str, count: int) -> list[str]:
        words = ("--dataset", study, "--out", out, "--cache", tmp_path / cache, "--jobs", count)
        return [*program, "evaluate", *map(str, words)]

    def state():
        return json.loads((out / "run.json").read_text())["state"]

    subprocess.run([*command(whole, "other", 1), "--quiet"], check=True)
    words = command(out, "cache", 2)
    assert stopped_after("1 of 3", words, signal.SIGKILL) == -signal.SIGKILL
    assert state() == "running" and not (out / "metrics.json").exists()
    assert stopped_after("2 of 3", words, signal.SIGINT) == 130
    assert state() == "interrupted"
    last = subprocess.run(words, check=True, capture_output=True, text=True)
    assert last.stderr.count("kept") > 0 and state() == "complete"
    assert (out / "metrics.json").read_bytes() == (whole / "metrics.json").read_bytes()


@pytest.mark.slow
def test_a_cluster_finds_what_one_process_finds_and_survives_a_lost_worker(scheduler, study, tmp_path) -> None:
    alone = run_study(study, tmp_path, cache=tmp_path / "alone")
    with Workers(scheduler=scheduler) as cluster, process(WORKER, scheduler):
        with process(WORKER, scheduler):
            run_study(study, tmp_path, cluster, tmp_path / "there", ["masks"])
        there = run_study(study, tmp_path, cluster, tmp_path / "there")
    assert summarize(there) == summarize(alone)
    assert 0 < there.facts["computed"] < alone.facts["computed"]
    with Workers(scheduler=scheduler) as cluster:  # all is kept: no worker is needed, and there is none
        again = run_study(study, tmp_path, cluster, tmp_path / "there")
    assert again.facts["computed"] == 0 and summarize(again) == summarize(alone)


@pytest.mark.slow
def test_a_worker_with_another_version_of_the_package_is_one_line(scheduler, by_name, tmp_path) -> None:
    with (
        process(WORKER, scheduler, before=OTHER_CODE),
        Workers(scheduler=scheduler) as cluster,
        pytest.raises(InputError, match=r"^[^\n]*another version of the package[^\n]*$"),
    ):
        run_jobs([by_name["table"]], cluster, Cache(tmp_path / "cache"))


def test_a_scheduler_without_workers_is_one_line(scheduler, by_name, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(jobs, "NO_WORKER_S", 0.0)
    with Workers(scheduler=scheduler) as cluster, pytest.raises(InputError, match="has had no worker"):
        run_jobs([by_name["table"]], cluster, Cache(tmp_path / "cache"))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:{free}", "tls://127.0.0.1:{free}", "foo://127.0.0.1:1", ""])
def test_a_scheduler_that_cannot_be_reached_is_one_line_within_seconds(address) -> None:
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = address.format(free=free.getsockname()[1])
    start_s = time.monotonic()
    with pytest.raises(InputError, match=r"^no Dask scheduler answers at [^\n]*wanted an address as tcp://host[^\n]*$"):
        Workers(scheduler=address).__enter__()
    assert time.monotonic() - start_s < 25


def answers_of(address: tuple[str, int]) -> list[bytes]:
    """What a port says to somebody without a key: who asks for a page, and who speaks TLS."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    answers = []
    for is_tls in (False, True):
        with suppress(ssl.SSLError, ConnectionError), ExitStack() as stack:
            asking = stack.enter_context(socket.create_connection(address, timeout=60))
            if is_tls:
                asking = stack.enter_context(context.wrap_socket(asking))
            asking.sendall(b"GET /json/identity.json HTTP/1.0\r\n\r\n")
            answers.append(asking.recv(4096))
    return answers


@pytest.mark.slow
def test_the_processes_of_a_study_talk_to_nobody_without_their_key_and_serve_no_http(by_name, tmp_path) -> None:
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    here = psutil.Process()
    before = here.children(recursive=True)  # the open scheduler of other tests
    with Workers(2) as team:
        assert run_jobs([by_name["table"]], team, Cache(tmp_path / "cache"))
        for one in {here, *here.children(recursive=True)}.difference(before):
            for port in [c.laddr for c in one.net_connections() if c.status == psutil.CONN_LISTEN]:
                assert port.ip == "127.0.0.1"
                for answer in answers_of(port):  # at most TLS's refusal, in a few bytes
                    assert len(answer) < 16 and b"HTTP" not in answer, (one.cmdline(), answer)


@pytest.mark.slow
def test_the_keys_for_a_scheduler_over_tls_are_those_of_dask_s_own_settings(by_name, tmp_path) -> None:
    dask = pytest.importorskip("dask")
    security = pytest.importorskip("distributed").Security.temporary()
    files = {"ca-file": security.tls_ca_file}
    for role in ("scheduler", "worker", "client"):
        files |= {f"{role}.key": security.tls_client_key, f"{role}.cert": security.tls_client_cert}
    settings, variables = {}, {}
    for name, content in files.items():
        path = tmp_path / f"{name}.pem"
        path.write_text(content)
        settings[f"distributed.comm.tls.{name}"] = str(path)
        words = name.upper().replace("-", "_").replace(".", "__")
        variables[f"DASK_DISTRIBUTED__COMM__TLS__{words}"] = str(path)
    with process(SCHEDULER.replace("port=0", 'port=0, protocol="tls"'), **variables) as address:
        assert address.startswith("tls://")
        with process(WORKER, address, **variables), dask.config.set(settings), Workers(scheduler=address) as cluster:
            done = run_jobs([by_name["table"]], cluster, Cache(tmp_path / "cache"))
    assert not any(d.cause for d in done[by_name["table"].number])


@pytest.mark.parametrize("missing", ["distributed", "cryptography"])
def test_one_process_needs_no_dask_and_others_say_what_to_install(by_name, tmp_path, monkeypatch, missing) -> None:
    monkeypatch.setattr(jobs, "find_spec", lambda name: None if name == missing else name)
    monkeypatch.setitem(sys.modules, "distributed", None)
    for options in ({"jobs": 2}, {"scheduler": "tcp://127.0.0.1:1"}):
        with pytest.raises(InputError, match=r"pip install 'torchvision-dddas\[distributed\]'"):
            Workers(**options)
    frames = []
    done = run_jobs([by_name["table"]], Workers(), Cache(tmp_path), lambda event: frames.append(event.frames))
    assert [d.cause for d in done[by_name["table"].number]] == ["", ""] and sum(frames) > 0
