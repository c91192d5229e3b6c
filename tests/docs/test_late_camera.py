"""The commands for a board whose camera boots late, as docs/onboard.md shows them."""

import http.server
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.synthetic_clip import render

ROOT = Path(__file__).resolve().parents[2]
# Nothing that the test waits for takes this long: a hang becomes a failure.
PATIENCE_S = 120.0

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the signals and sockets of Linux")


PICTURES = [cv2.imencode(".jpg", image)[1].tobytes() for image in render(0, 24, (240, 180)).images]


class Camera(http.server.BaseHTTPRequestHandler):
    """Sends JPEG pictures until the client leaves, as many cameras do."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        try:
            for count in range(int(PATIENCE_S * 25)):
                picture = PICTURES[count % len(PICTURES)]
                head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
                self.wfile.write(head.encode() + picture + b"\r\n")
                time.sleep(0.04)
        except OSError:
            return

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Requests are not logged."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.slow
def test_a_board_waits_for_its_camera_and_is_well_once_pictures_come(tmp_path: Path) -> None:
    page = (ROOT / "docs/onboard.md").read_text(encoding="utf-8")
    (block,) = [b for b in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) if "rtsp://CAMERA" in b]
    run_line, ask_line = block.splitlines()
    camera, served = free_port(), free_port()
    run_line = run_line.replace("rtsp://CAMERA/stream", f"http://127.0.0.1:{camera}/stream").replace(
        "8080", str(served)
    )
    address = shlex.split(ask_line.partition("#")[0])[1].replace("8080", str(served))
    call = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", *shlex.split(run_line)[1:]]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(str(tmp_path / "notify"))
        supervisor.settimeout(PATIENCE_S)
        environ = {
            **os.environ,
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "2000000",
            "PYTHONPATH": str(ROOT),
        }
        with subprocess.Popen(call, cwd=tmp_path, env=environ, stderr=subprocess.PIPE, text=True) as run:
            killer = threading.Timer(PATIENCE_S, run.kill)
            killer.start()
            try:
                assert run.stderr is not None
                assert "status page: " in run.stderr.readline()
                assert "is not there yet" in run.stderr.readline()
                assert ask(address)["trouble"].startswith("waiting for the camera")
                assert [supervisor.recv(4096).decode().splitlines()[0] for _ in range(3)] == [
                    "READY=1",
                    "WATCHDOG=1",
                    "WATCHDOG=1",
                ]
                with http.server.ThreadingHTTPServer(("127.0.0.1", camera), Camera) as server:
                    server.daemon_threads, server.block_on_close = True, False
                    threading.Thread(target=server.serve_forever, daemon=True).start()
                    found: dict[str, Any] = {}
                    until_s = time.monotonic() + PATIENCE_S
                    while not found.get("counts", {}).get("results") and time.monotonic() < until_s:
                        found = ask(address)
                        time.sleep(0.1)
                    assert found["counts"]["results"] > 0
                    run.send_signal(signal.SIGTERM)
                    assert run.wait(PATIENCE_S) == 0, run.stderr.read()
                    server.shutdown()
            finally:
                run.kill()
                killer.cancel()
    (folder,) = (tmp_path / "dddas-live").iterdir()
    assert json.loads((folder / "run.json").read_text())["state"] == "stopped"


def ask(address: str) -> dict[str, Any]:
    """What /health.json says, well or not; nothing while it is not served."""
    try:
        with urllib.request.urlopen(address, timeout=PATIENCE_S) as answer:
            return dict(json.loads(answer.read()))
    except urllib.error.HTTPError as error:
        with error:
            return dict(json.loads(error.read()))
    except OSError:
        return {}


def test_the_service_waits_for_its_camera() -> None:
    assert re.search(r"^ExecStart=.* --live --wait ", (ROOT / "export/dddas.service").read_text(), re.MULTILINE)


@pytest.mark.parametrize("recipe", ["export/dddas.service", "export/README.md", "export/Containerfile"])
def test_a_recipe_installs_the_wheel_that_it_has_built(recipe: str) -> None:
    text = (ROOT / recipe).read_text(encoding="utf-8").replace("\\\n", " ")
    (built,) = re.findall(r"pip wheel .*--no-deps --wheel-dir (\S+) \.", text)
    (installed,) = re.findall(r"pip install .*\$\(echo (\S+)\)\[video\]", text)
    assert installed == f"{built}/*.whl" and "pip install torchvision-dddas" not in text


def test_the_service_may_take_the_memory_that_its_largest_measured_run_takes() -> None:
    unit = (ROOT / "export/dddas.service").read_text(encoding="utf-8")
    (high,), (most,) = (re.findall(rf"^{name}=(\d+)M$", unit, re.MULTILINE) for name in ("MemoryHigh", "MemoryMax"))
    measured = [int(size) for size in re.findall(r"\b(\d+) MB\b", unit)]
    assert len(measured) == 3 and 1.1 * max(measured) < int(high) < int(most)
