"""What goes wrong on a vehicle, done to a whole `dddas run --live`: it goes on, and what was written stays."""

import http.server
import json
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import pytest

from tests.synthetic_clip import render

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="needs the limits and signals of Linux"),
]

# Nothing that a test waits for takes this long, however busy the machine: a hang becomes a failure.
PATIENCE_S = 180
FRAMES = 24
# A machine that is busy with other things is no hung run; and no picture is to be left out for being late.
LIVE = ("--live", "--config", "fast", "--set", "live.watchdog_s=0", "--set", "live.status_s=0.2")


def video(path: Path, size: tuple[int, int] = (240, 180), frames: int = FRAMES) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mpg1"), 25.0, size)
    assert writer.isOpened()
    for image in render(0, frames, size).images:
        writer.write(image)
    writer.release()
    return path


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return video(tmp_path_factory.mktemp("clip") / "clip.avi")


@contextmanager
def running(clip: str | Path, out: Path, *words: str) -> Iterator["subprocess.Popen[str]"]:
    """A run in a process of its own, its standard output and errors read as text."""
    call = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", "run", str(clip), *LIVE]
    with subprocess.Popen(
        [*call, "--out", str(out), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as run:
        killer = threading.Timer(PATIENCE_S, run.kill)
        killer.start()
        try:
            yield run
        finally:
            run.kill()
            killer.cancel()


def session(out: Path) -> tuple[Path, dict, list[dict]]:
    """The folder of the one session, its record, and its results: each line is whole, and frames rise."""
    (folder,) = out.iterdir()
    record = json.loads((folder / "run.json").read_text())
    results = [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]
    numbers = [result["frame"] for result in results]
    assert numbers == sorted(set(numbers))
    return folder, record, results


def test_what_was_said_before_a_kill_is_in_the_file_and_a_restart_touches_nothing_of_it(clip, tmp_path):
    with running(clip, tmp_path, "--set", "live.pace=0", "--emit", "json:-") as run:
        assert run.stdout is not None
        said = [json.loads(run.stdout.readline()) for _ in range(5)]
        run.kill()
        said += [json.loads(line) for line in run.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
        assert run.wait() == -signal.SIGKILL
    (folder,) = tmp_path.iterdir()
    text = (folder / "results.jsonl").read_text()
    written = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
    for line in (*said, *written):
        line.pop("age_s")  # each stream counts it until it is written there
    assert written[: len(said)] == said and len(said) >= 5
    assert json.loads((folder / "run.json").read_text())["state"] == "running"
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with running(clip, tmp_path, "--set", "live.pace=0", "--quiet") as run:
        assert run.wait() == 0
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    (again,) = set(tmp_path.iterdir()) - {folder}
    assert json.loads((again / "run.json").read_text())["state"] == "complete"
    assert len((again / "results.jsonl").read_text().splitlines()) == FRAMES


def test_a_disk_that_fills_up_ends_nothing_and_leaves_whole_lines(clip, tmp_path):
    with running(clip, tmp_path, "--set", "live.pace=0.5", "--emit", "json:-") as run:
        assert run.stdout is not None
        said = [run.stdout.readline() for _ in range(3)]
        (folder,) = tmp_path.iterdir()
        room = (folder / "results.jsonl").stat().st_size + 300
        resource.prlimit(run.pid, resource.RLIMIT_FSIZE, (room, room))
        out, err = run.communicate()
    assert run.returncode == 0, err
    frames = [json.loads(line)["frame"] for line in [*said, *out.splitlines()]]
    kept = (folder / "results.jsonl").read_text()
    assert kept.endswith("\n") and len(kept) <= room
    assert len(frames) > kept.count("\n") > 0  # what could not be kept was still said
    assert [json.loads(line)["frame"] for line in kept.splitlines()] == frames[: kept.count("\n")]
    assert json.loads((folder / "run.json").read_text())["state"] == "running"  # the last that went onto the disk
    assert "File too large" in err


def test_telemetry_that_falls_silent_is_told_and_the_run_goes_on(clip, tmp_path):
    flight = tmp_path / "flight.csv"
    flight.write_text("time_s,altitude_m,speed_m_s\n-5,50,2\n-2,50,2\n-0.6,50,2\n")  # it holds for a second more
    out = tmp_path / "out"
    with running(clip, out, "--set", "live.pace=0", "--telemetry", str(flight), "--quiet") as run:
        assert run.wait() == 0, run.stderr and run.stderr.read()
    folder, record, results = session(out)
    assert record["state"] == "complete" and len(results) == FRAMES
    assert "telemetry is silent" in (folder / "events.log").read_text()


class Sender(http.server.BaseHTTPRequestHandler):
    """Sends one video a connection, then cuts it; past the last one nobody answers any more."""

    def do_GET(self) -> None:
        server: Server = self.server  # type: ignore[assignment]
        if not server.parts:
            server.done.set()
            self.send_error(503)
            return
        if len(server.parts) < server.count:
            server.ready.wait(PATIENCE_S)
        part = server.parts.pop(0)
        self.send_response(200)
        self.send_header("Content-Type", "video/mp2t")
        self.end_headers()
        try:
            self.wfile.write(part)
        except OSError:  # who reads has hung up
            return

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (the name is the base's)
        """Say nothing."""


class Server(http.server.ThreadingHTTPServer):
    """Holds what is to be sent. ready: it goes on after the first part. done: all was sent, and more was asked for."""

    def __init__(self, parts: list[bytes]) -> None:
        super().__init__(("127.0.0.1", 0), Sender)
        self.parts, self.count = parts, len(parts)
        self.ready, self.done = threading.Event(), threading.Event()


def corrupted(stream: bytes) -> bytes:
    """A transport stream of which each tenth packet or so has garbage in it, or is lost."""
    rng = random.Random(0)
    packets = [stream[k : k + 188] for k in range(0, len(stream), 188)]
    kept = []
    for k, packet in enumerate(packets):
        if k > 20 and rng.random() < 0.05:
            continue
        kept.append(packet[:10] + rng.randbytes(178) if k > 20 and rng.random() < 0.05 else packet)
    return b"".join(kept)


def test_a_stream_that_is_cut_damaged_and_of_another_size_is_got_over(tmp_path):
    whole, small = (
        video(tmp_path / name, size).read_bytes() for name, size in (("a.ts", (240, 180)), ("b.ts", (320, 180)))
    )
    server = Server([whole, whole[: len(whole) // 3], corrupted(whole), small, b"no video at all" * 100, whole, whole])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    words = ("--set", "live.retry_s=0.05", "--set", "live.retry_most_s=0.1", "--set", "live.stall_s=60")
    try:
        url = f"http://127.0.0.1:{server.server_port}/live.ts"
        with running(url, tmp_path / "out", *words) as run:
            assert run.stderr is not None
            said = run.stderr.readline()
            assert "240x180 at " in said, said
            server.ready.set()
            assert server.done.wait(PATIENCE_S), "the run asks no more for the stream"
            run.send_signal(signal.SIGTERM)
            _, err = run.communicate()
    finally:
        server.shutdown()
        server.server_close()
    assert run.returncode == 0, err
    assert "Traceback" not in err
    folder, record, results = session(tmp_path / "out")
    assert record["state"] == "stopped" and len(results) > 0
    assert record["counts"]["reconnects"] >= 4
    assert record["counts"]["begun_anew"] == 0
    events = (folder / "events.log").read_text()
    assert "lost" in events and "320x180" in events


def test_a_run_that_was_killed_gives_its_port_and_its_files_free(clip, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    for _ in range(2):
        with running(clip, tmp_path, "--set", "live.pace=0.05", "--serve", str(port), "--emit", "json:-") as run:
            assert run.stdout is not None and run.stderr is not None
            assert run.stdout.readline(), run.stderr.read()
            os.kill(run.pid, signal.SIGKILL)
    assert len(list(tmp_path.iterdir())) == 2
