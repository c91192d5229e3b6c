"""`dddas run --live --command`: a peer on this machine hears the components, and a dry run sends no command."""

import csv
import json
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import bad

pytest.importorskip("pymavlink")
from tests.io.test_mavlink_link import free_port
from tests.live.mavlink_peers import UdpPeer, heartbeat, position

LIVE = (
    "--live",
    "--config",
    "fast",
    "--set",
    "live.watchdog_s=0",
    "--set",
    "live.shed=false",
    "--set",
    "live.queue_frames=64",
)


class Vehicle(threading.Thread):
    """A vehicle that reports ten times a second where the log says it begins."""

    def __init__(self, port: int, log: Path) -> None:
        super().__init__(daemon=True)
        self.peer, self.over = UdpPeer(port), threading.Event()
        with log.open(newline="") as text:
            self.row = next(csv.DictReader(text))

    def run(self) -> None:
        wanted = ("longitude_deg", "latitude_deg", "altitude_m", "above_sea_m")
        longitude, latitude, up_m, sea_m = (float(self.row[name]) for name in wanted)
        count = 0
        while not self.over.wait(0.05):
            count += 1
            if count % 10 == 1:
                self.peer.say(heartbeat())
            self.peer.say(position((longitude, latitude), up_m, 50 * count, sea_m))
            self.peer.listen()
        self.peer.close()


@pytest.mark.slow
@pytest.mark.e2e
def test_a_dry_run_prints_its_commands_and_sends_heartbeats_alone(dddas, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("torchvision_dddas.live.mavlink_component._LISTEN_S", 0.1)
    monkeypatch.setattr("torchvision_dddas.live.command_safety.DECISION_S", 60.0)  # on a busy machine
    made, out, port = tmp_path / "made", tmp_path / "out", free_port()
    assert dddas("simulate", "four", "--set", "clip.seconds=8", "--out", made).exit_code == 0
    given: list[Any] = ["--rate", "10", "--telemetry", made / "telemetry.csv", "--landmarks", made / "landmarks.csv"]
    given += ["--colours", made / "colours.toml", "--camera", made / "camera.toml", "--out", out]
    limits = ("--geofence=-110.95,31.6,150", "--altitude-band", "20,120")
    vehicle = Vehicle(port, made / "telemetry.csv")
    vehicle.start()
    link = f"mavlink:udp:127.0.0.1:{port}"
    done = dddas("run", made / "frames", *LIVE, *given, "--command", link, *limits)
    vehicle.over.set()
    vehicle.join()
    assert done.exit_code == 0, done.output
    (session,) = out.iterdir()
    events = (session / "events.log").read_text()
    assert "command: would look at 31." in events and "command: would fly to 31." in events
    record = json.loads((session / "run.json").read_text())
    assert record["command"] == {"link": link, "allow": False, "fence": "-110.95,31.6,150", "band": "20,120"}
    assert {message.get_type() for message in vehicle.peer.heard} == {"HEARTBEAT"}
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in vehicle.peer.heard} == {(1, 191), (1, 100)}


def test_permission_beside_a_recording_is_refused(dddas, engine, clip, tmp_path: Path) -> None:
    link = f"mavlink:udp:127.0.0.1:{free_port()}"
    call = dddas("run", clip, "--live", "--command", link, "--allow-commands", "--out", tmp_path / "out")
    assert "--allow-commands is for a camera or a stream" in bad(call)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ("--command", "mavlink:udp:127.0.0.1:9"),
            "--command is for a run that keeps up with a camera; give --live too",
        ),
        (("--live", "--allow-commands"), "--allow-commands is for --command mavlink:...; give it too"),
        (("--live", "--geofence", "1,2,30"), "--geofence is for --command mavlink:...; give it too"),
        (("--live", "--command", "tcp:127.0.0.1:9"), "is no MAVLink connection; wanted mavlink:udp:HOST:PORT"),
        (("--live", "--command", "mavlink:tcp:127.0.0.1:1"), "cannot be opened: Connection refused"),
        (("--live", "--command", "mavlink:udp:127.0.0.1:9?system=900"), "system must be one number from 1 to 255"),
        (
            ("--live", "--command", "mavlink:udp:127.0.0.1:9", "--altitude-band", "9"),
            "--altitude-band 9: wanted LOWEST,HIGHEST in metres above home",
        ),
        (
            ("--live", "--command", "mavlink:udp:127.0.0.1:9", "--geofence", "absent.geojson"),
            "absent.geojson cannot be read",
        ),
        (
            ("--live", "--command", "mavlink:udp:127.0.0.1:{port}?ugv1=3"),
            "--command names the vehicles ugv1; wanted ?system=N of the UAV",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(dddas, engine, clip, tmp_path: Path, words: tuple[str, ...], says: str) -> None:
    given = [word.replace("{port}", str(free_port())) for word in words]
    assert says in bad(dddas("run", clip, *given, "--out", tmp_path / "out"))
