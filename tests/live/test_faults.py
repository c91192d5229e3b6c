"""Kills, full disks and damaged streams do not harm a whole `dddas run --live` or what it has written."""

import http.server
import json
import random
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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


def test_a_kill_keeps_what_was_sent_and_a_restart_gets_the_port_and_a_new_folder(clip, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        words = ("--set", "live.pace=0", "--serve", str(probe.getsockname()[1]))
    with running(clip, tmp_path, *words, "--emit", "json:-") as run:
        assert run.stdout is not None
        sent = [json.loads(run.stdout.readline()) for _ in range(5)]
        run.kill()
        sent += [json.loads(line) for line in run.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
        assert run.wait() == -signal.SIGKILL
    (folder,) = tmp_path.iterdir()
    text = (folder / "results.jsonl").read_text()
    written = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
    for line in (*sent, *written):
        line.pop("age_s")  # each stream counts it until it is written there
    assert written[: len(sent)] == sent and len(sent) >= 5
    assert json.loads((folder / "run.json").read_text())["state"] == "running"
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with running(clip, tmp_path, *words, "--quiet") as run:
        assert run.wait() == 0
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    (again,) = set(tmp_path.iterdir()) - {folder}
    assert json.loads((again / "run.json").read_text())["state"] == "complete"
    assert len((again / "results.jsonl").read_text().splitlines()) == FRAMES


def test_ctrl_c_ends_a_live_run_with_its_summary_and_says_no_more(clip, tmp_path):
    with running(clip, tmp_path, "--set", "live.pace=0.5", "--emit", "json:-") as run:
        assert run.stdout is not None
        run.stdout.readline()
        run.send_signal(signal.SIGINT)
        _, err = run.communicate()
    (folder,) = tmp_path.iterdir()
    assert run.returncode == 130 and json.loads((folder / "run.json").read_text())["state"] == "stopped"
    assert err.splitlines()[-1].endswith(f"; {folder}") and "nothing was kept" not in err


def test_a_disk_that_fills_up_ends_nothing_and_leaves_whole_lines(clip, tmp_path):
    with running(clip, tmp_path, "--set", "live.pace=0.5", "--emit", "json:-") as run:
        assert run.stdout is not None
        sent = [run.stdout.readline() for _ in range(3)]
        (folder,) = tmp_path.iterdir()
        room = (folder / "results.jsonl").stat().st_size + 300
        resource.prlimit(run.pid, resource.RLIMIT_FSIZE, (room, room))
        out, err = run.communicate()
    assert run.returncode == 74, err
    frames = [json.loads(line)["frame"] for line in [*sent, *out.splitlines()]]
    kept = (folder / "results.jsonl").read_text()
    assert kept.endswith("\n") and len(kept) <= room
    assert len(frames) > kept.count("\n") > 0  # what could not be kept was still sent
    assert [json.loads(line)["frame"] for line in kept.splitlines()] == frames[: kept.count("\n")]
    assert json.loads((folder / "run.json").read_text())["state"] == "running"  # the last that went onto the disk
    last = err.splitlines()[-1]
    assert last.startswith(f"dddas: {folder}: run.json cannot be written: File too large; results.jsonl lacks ")


class Sender(http.server.BaseHTTPRequestHandler):
    """Sends one video a connection, then cuts it; after the last one it sends errors."""

    def do_GET(self) -> None:
        server: Server = self.server  # type: ignore[assignment]
        if not server.parts:
            server.done.set()
            self.send_error(503)
            return
        if server.begun:
            server.ready.wait(PATIENCE_S)
        server.begun = True
        self.send_response(200)
        self.end_headers()
        with suppress(OSError):  # the reader may hang up
            self.wfile.write(server.parts.pop(0))

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (the name is the base's)
        """Requests are not logged."""


class Server(http.server.ThreadingHTTPServer):
    """ready: it goes on after the first part. done: all was sent, and more was asked for."""

    def __init__(self, parts: list[bytes]) -> None:
        super().__init__(("127.0.0.1", 0), Sender)
        self.parts, self.begun = parts, False
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


def test_a_run_survives_a_stream_that_is_cut_damaged_and_of_another_size(tmp_path):
    whole, small = (
        video(tmp_path / name, size).read_bytes() for name, size in (("a.ts", (240, 180)), ("b.ts", (320, 180)))
    )
    server = Server([whole, whole[: len(whole) // 3], corrupted(whole), small, b"no video at all" * 100, whole, whole])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    words = ("--set", "live.retry_s=0.05", "--set", "live.retry_most_s=0.1", "--set", "live.stall_s=60")
    try:
        with running(f"http://127.0.0.1:{server.server_port}/live.ts", tmp_path / "out", *words) as run:
            assert run.stderr is not None
            first = run.stderr.readline()
            assert "240x180 at " in first, first
            server.ready.set()
            assert server.done.wait(PATIENCE_S), "the run asks no more for the stream"
            run.send_signal(signal.SIGTERM)
            _, err = run.communicate()
    finally:
        server.shutdown()
        server.server_close()
    assert run.returncode == 0 and "Traceback" not in err, err
    (folder,) = (tmp_path / "out").iterdir()
    record = json.loads((folder / "run.json").read_text())
    frames = [json.loads(line)["frame"] for line in (folder / "results.jsonl").read_text().splitlines()]
    assert frames == sorted(set(frames)) and len(frames) > 0
    assert record["state"] == "stopped"
    assert record["counts"]["reconnects"] >= 4 and record["counts"]["begun_anew"] == 0
    events = (folder / "events.log").read_text()
    assert "lost" in events and "320x180" in events
