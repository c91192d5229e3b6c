"""`dddas run --live`: streams, the session's own folder, and one line for each mistake."""

import errno
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad
from tests.live.streams import FakeStream
from tests.synthetic_clip import render
from torchvision_dddas.detection.opencv_engine import OpenCVEngine
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams.stream import Stream
from torchvision_dddas.pipeline import assemble_files

FRAMES = 14
# A machine that is busy with other things is no hung run.
FAST = ("--live", "--set", "live.pace=0", "--set", "live.watchdog_s=0", "--config", "fast")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    for number, image in enumerate(render(0, FRAMES, (240, 180)).images, 1):
        cv2.imwrite(str(folder / f"{number:03d}.png"), image)
    return folder


def session(out):
    """The folder, the record and the results of the one session in it."""
    (folder,) = out.iterdir()
    lines = (folder / "results.jsonl").read_text().splitlines()
    return folder, json.loads((folder / "run.json").read_text()), [json.loads(line) for line in lines]


def test_each_frame_is_a_line_of_each_stream_and_the_record_is_whole(dddas, frames, tmp_path, capfd):
    out, mot = tmp_path / "out", tmp_path / "rows.txt"
    done = dddas("run", frames, *FAST, "--out", out, "--emit", "json:-", "--emit", f"mot:{mot}", "--people")
    streamed = capfd.readouterr().out.splitlines()
    assert done.exit_code == 0, done.output
    assert done.stdout == ""  # nothing but the stream
    folder, record, results = session(out)
    assert sorted(path.name for path in folder.iterdir()) == ["events.log", "results.jsonl", "run.json"]
    assert [line["frame"] for line in results] == list(range(1, FRAMES + 1))
    assert [json.loads(line)["frame"] for line in streamed] == list(range(1, FRAMES + 1))
    assert all(isinstance(line["people"], list) for line in results)
    assert sum(len(line["targets"]) for line in results) > 0
    rows = np.loadtxt(mot, delimiter=",", ndmin=2)
    assert len(rows) == sum(len([t for t in line["targets"] if t["id"]]) for line in results)
    assert record["state"] == "complete"
    assert record["counts"]["results"] == record["counts"]["looked_at"] == FRAMES
    assert record["seconds"]["latency"]["p50"] > 0
    uses = [line["appearance"] for line in results if line["appearance"] is not None]
    assert uses and all(use["cause"] for use in uses)
    looked = sum(use["looked"] for use in uses)
    counts = record["counts"]
    assert (counts["appearance_decisions"], counts["appearance_looked_at"]) == (len(uses), looked)
    changes = [change for line in results for change in line["adjustments"]]
    assert changes and record["adjustments"] == changes
    assert sum(record["adjustments_made"].values()) == len(changes)
    events = (folder / "events.log").read_text()
    assert all(f"{change['frame']} adjusted: {change['knob']} " in events for change in changes)
    assert re.search(r"results of 14 pictures, 0 dropped, \d+ late \(over 80 ms\), 99 % within \d+ ms; ", done.stderr)


@pytest.mark.parametrize(
    ("words", "cost"),
    [
        ((), 1.0),
        (("live.pace=50",), 0.0),
        (("live.pace=50", "interval.cost=2"), 2.0),
        (("live.pace=50", "interval.cost=1"), 1.0),
    ],
)
def test_the_cost_of_a_look_is_measured_where_frames_do_not_wait_unless_it_is_set(words, cost, dddas, frames, tmp_path):
    changed = [word for change in words for word in ("--set", change)]
    assert dddas("run", frames, *FAST, *changed, "--out", tmp_path).exit_code == 0
    assert session(tmp_path)[1]["settings"]["interval"]["cost"] == cost


def test_latency_now_tells_each_frame_at_once_and_again_when_it_is_settled(dddas, frames, tmp_path):
    mot = tmp_path / "rows.txt"
    words = ("run", frames, *FAST, "--quiet", "--people")
    assert dddas(*words, "--out", tmp_path / "usual").exit_code == 0
    done = dddas(*words, "--out", tmp_path / "now", "--latency", "now", "--emit", f"mot:{mot}")
    assert done.exit_code == 0, done.output
    usual, (_, record, told) = session(tmp_path / "usual")[2], session(tmp_path / "now")
    first = [line for line in told if "provisional" in line]
    settled = [line for line in told if "provisional" not in line]
    assert [line["frame"] for line in first] == [line["frame"] for line in settled] == list(range(1, FRAMES + 1))
    assert all(line["provisional"] is True and line["people"] is None and "corrects" not in line for line in first)
    assert all(told.index(one) < told.index(other) for one, other in zip(first, settled, strict=True))
    for line, known in zip(settled, usual, strict=True):
        assert [target["box_px"] for target in line["targets"]] == [target["box_px"] for target in known["targets"]]
        assert line["people"] == known["people"] and line["adjustments"] == known["adjustments"]
    named = [[target["id"] for target in line["targets"] if target["id"]] for line in first]
    for line, names in zip(settled, named, strict=True):
        assert set(line.get("corrects", [])) <= set(names)
    assert any(named)
    assert len(mot.read_text().splitlines()) == sum(len([t for t in line["targets"] if t["id"]]) for line in settled)
    assert record["counts"]["results"] == FRAMES and record["seconds"]["provisional"]["p50"] > 0


def test_latency_now_is_refused_with_crowds_and_for_a_run_that_is_not_live(dddas, frames, file, tmp_path):
    out = ("--latency", "now", "--out", tmp_path / "out")
    assert "give --live too" in bad(dddas("run", frames, *out))
    log = file("log.csv", "time_s,altitude_m,speed_m_s,east_m,north_m,heading_deg,pitch_deg\n0,40,0,0,0,0,90\n")
    crowds = ("--telemetry", log, "--set", "crowds.join_m=3", "--rate", "10")
    assert "cannot work with crowds.join_m" in bad(dddas("run", frames, *FAST, *crowds, *out))
    assert not (tmp_path / "out").exists()


def test_notes_on_the_files_are_said_at_the_start(dddas, frames, tmp_path, monkeypatch):
    def noting(*given):
        return replace(assemble_files(*given), notes=["bravo has no colour"])

    monkeypatch.setattr("torchvision_dddas.live.run_inputs.assemble_files", noting)
    done = dddas("run", frames, *FAST, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert "dddas: note: bravo has no colour\n" in done.stderr
    assert session(tmp_path)[1]["notes"] == ["bravo has no colour"]


def test_a_second_session_touches_nothing_of_the_first(dddas, frames, tmp_path):
    assert dddas("run", frames, *FAST, "--out", tmp_path, "--quiet").exit_code == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    done = dddas("run", frames, *FAST, "--out", tmp_path, "--quiet")
    assert (done.exit_code, done.output) == (0, "")
    assert {path: path.read_bytes() for path in before} == before
    assert len(list(tmp_path.iterdir())) == 2


def test_work_that_fails_with_every_frame_ends_the_run_with_code_70(dddas, frames, tmp_path, monkeypatch):
    def broken(self, image):
        raise ValueError("no picture will do")

    monkeypatch.setattr(OpenCVEngine, "prepare", broken)
    monkeypatch.setattr("torchvision_dddas.live.runner._MOST_FAILURES", 5)
    done = dddas("run", frames, *FAST, "--out", tmp_path)
    assert done.exit_code == 70
    assert "5 times in a row" in done.stderr
    folder, record, _ = session(tmp_path)
    assert record["state"] == "failed"
    assert "run: ValueError: no picture will do" in (folder / "events.log").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("waits", [False, True])
def test_sigterm_ends_a_run_and_one_that_waits_for_its_camera_with_valid_outputs(frames, tmp_path, waits):
    # At a hundredth of its speed the clip would take minutes.
    clip = ["tcp://127.0.0.1:9", "--wait"] if waits else [str(frames), "--set", "live.pace=0.01"]
    main = "from torchvision_dddas.cli import main; main()"
    words = [sys.executable, "-c", main, "run", *clip, "--live", "--out", str(tmp_path / "out")]
    ready = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    ready.bind(str(tmp_path / "notify"))
    ready.settimeout(120)
    environ = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
    with ready, subprocess.Popen(words, env=environ, stderr=subprocess.PIPE) as run:
        first = ready.recv(100).splitlines()
        assert first[0] == b"READY=1" and (not waits or first[1:] == [b"STATUS=waiting for the camera"])
        time.sleep(0.5 * waits)
        run.send_signal(signal.SIGTERM)
        assert waits or ready.recv(100) == b"STOPPING=1"
        run.communicate(timeout=120)
    assert run.returncode == 0
    assert not (tmp_path / "out").exists() if waits else session(tmp_path / "out")[1]["state"] == "stopped"


def pixel_zone(folder):
    ring = [[0, 0], [200, 0], [200, 180], [0, 180], [0, 0]]
    shape = {"type": "Feature", "properties": {"name": "left"}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path = folder / "zones.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "unit": "px", "features": [shape]}))
    return path


def test_the_annotated_pictures_are_saved_cut_and_sent_on(dddas, frames, tmp_path):
    pytest.importorskip("av")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        receiver.bind(("127.0.0.1", 0))
        words = ("--save", "all", "--zones", pixel_zone(tmp_path), "--set", "live.clip_s=0.3")
        stream = f"video:udp://127.0.0.1:{receiver.getsockname()[1]}"
        done = dddas("run", frames, *FAST, *words, "--emit", stream, "--out", tmp_path / "out", "--quiet")
        assert receiver.recv(1 << 16)[0] == 0x47
    assert (done.exit_code, done.output) == (0, "")
    folder, record, _ = session(tmp_path / "out")
    videos = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.mp4"))
    assert videos[-1] == "overlay.mp4" and videos[0].startswith("clips/") and record["save"] == ["overlay", "clips"]
    for name in videos:
        capture, count = cv2.VideoCapture(str(folder / name)), 0
        while capture.read()[0]:
            count += 1
        assert count == FRAMES if name == "overlay.mp4" else 0 < count < FRAMES


def test_a_recording_that_is_not_possible_is_refused_at_the_start(dddas, frames, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert "--save must name some of overlay, clips" in bad(dddas("run", frames, *FAST, "--save", "map", "--out", out))
    monkeypatch.setitem(sys.modules, "av", None)
    for words in (("--save", "clips"), ("--emit", "video:udp://127.0.0.1:9")):
        assert "needs PyAV" in bad(dddas("run", frames, *FAST, *words, "--out", out))
    assert not out.exists()


@pytest.mark.slow
def test_an_interrupted_run_keeps_its_overlay(frames, tmp_path):
    pytest.importorskip("av")
    main, out = "from torchvision_dddas.cli import main; main()", tmp_path / "out"
    words = [sys.executable, "-c", main, "run", str(frames), "--live", "--set", "live.pace=0.2", "--save", "overlay"]
    with subprocess.Popen([*words, "--out", str(out)], stderr=subprocess.PIPE) as run:
        end_s = time.monotonic() + 120
        while not list(out.glob("*/.overlay.*.part.mp4")):
            assert time.monotonic() < end_s
            time.sleep(0.05)
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=120)
    assert run.returncode == 130
    folder = session(out)[0]
    assert [path.name for path in folder.glob("*.mp4")] == ["overlay.mp4"] and not list(folder.glob(".*.part*"))
    assert cv2.VideoCapture(str(folder / "overlay.mp4")).read()[0]


def test_a_port_in_use_is_one_line_and_leaves_nothing(dddas, frames, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = bad(dddas("run", frames, *FAST, "--serve", port, "--out", tmp_path / "out"))
    assert f"cannot serve at 127.0.0.1:{port}" in said
    assert not (tmp_path / "out").exists()


def test_a_session_that_cannot_begin_its_log_is_one_line_and_its_record_says_failed(
    dddas, frames, tmp_path, monkeypatch
):
    honest = os.open

    def refuse(path, *how, **more):
        if str(path).endswith("events.log"):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return honest(path, *how, **more)

    monkeypatch.setattr("os.open", refuse)
    said = bad(dddas("run", frames, *FAST, "--out", tmp_path))
    assert "events.log cannot be written: No space left on device" in said
    _, record, results = session(tmp_path)
    assert record["state"] == "failed" and results == []
    assert [event["kind"] for event in record["events"]] == ["sink"]


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_a_record_that_cannot_be_replaced_at_the_end_is_an_event_one_line_and_no_success(
    dddas, frames, tmp_path, monkeypatch, quiet
):
    honest = Path.replace

    def refuse(self, target):
        if target.name == "run.json" and target.exists():
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return honest(self, target)

    monkeypatch.setattr("pathlib.Path.replace", refuse)
    done = dddas("run", frames, *FAST, "--out", tmp_path, *quiet)
    assert done.exit_code == 74
    folder, record, results = session(tmp_path)
    assert record["state"] == "running" and len(results) == FRAMES
    assert " sink: run.json cannot be written: Permission denied; tried again" in (folder / "events.log").read_text()
    lines = [line for line in done.stderr.splitlines() if str(folder) in line and "Permission denied" in line]
    assert lines == [
        f"dddas: {folder}: run.json cannot be written: Permission denied; free some space or choose another --out"
    ]
    assert not quiet or len(done.stderr.splitlines()) == 1


def nmea(begins_utc_s: float, seconds: int, north_m_s: float = 50.0) -> str:
    """A log of a vehicle that goes north from 48 N 11.5 E, one fix a second."""
    lines = []
    for k in range(seconds + 1):
        moment = datetime.fromtimestamp(begins_utc_s + k, UTC)
        clock, date = f"{moment:%H%M%S}.{moment.microsecond // 1000:03d}", f"{moment:%d%m%y}"
        minutes = k * north_m_s / 1855.0
        place = f"48{minutes:08.5f},N,01130.00000,E"
        lines += [f"GPRMC,{clock},A,{place},50.0,0.0,{date},,,A", f"GPGGA,{clock},{place},1,10,1.0,540.0,M,46.0,M,,"]
    return "".join(f"${line}*{reduce(xor, line.encode()):02X}\n" for line in lines)


@pytest.fixture
def film_camera(monkeypatch):
    """A camera that shows a film again and again, and ends the run by a signal after so many pictures."""

    def install(pictures: int) -> None:
        images = itertools.cycle(render(0, FRAMES, (240, 180)).images)
        end = [lambda: os.kill(os.getpid(), signal.SIGTERM)]
        rest = (step for image in images for step in (lambda: time.sleep(0.02), image))
        script = itertools.chain(itertools.islice(rest, 2 * pictures), end, rest)
        for module in ("capture", "refusal"):
            monkeypatch.setattr(f"torchvision_dddas.live.{module}.open_stream", lambda *_: FakeStream(script))

    return install


CAMERA = "hfov_deg = 60\npitch_deg = 60\nheading_deg = 0\nheight_m = 15\n"


@pytest.mark.parametrize("ago_s", [1440, 100])
def test_the_log_of_another_time_is_refused_beside_a_camera_and_leaves_no_session(
    dddas, film_camera, file, tmp_path, ago_s
):
    pytest.importorskip("pynmea2")
    film_camera(40)
    given = ("--telemetry", file("log.nmea", nmea(time.time() - ago_s, 20)), "--camera", file("camera.toml", CAMERA))
    said = bad(dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given, "--out", tmp_path / "out"))
    assert "before the first picture" in said and "its places are not current" in said
    assert not (tmp_path / "out").exists()


def test_places_are_those_of_the_log_at_the_time_of_the_picture(dddas, film_camera, file, tmp_path):
    pytest.importorskip("pynmea2")
    film_camera(40)
    begins_utc_s = time.time() - 30
    given = ("--telemetry", file("log.nmea", nmea(begins_utc_s, 600)), "--camera", file("camera.toml", CAMERA))
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    _, record, results = session(tmp_path / "out")
    assert any("aligned by the clock" in note for note in record["notes"])
    placed = [(line, target) for line in results for target in line["targets"] if target.get("lonlat_deg")]
    assert placed
    for line, target in placed:
        flown_m = (datetime.fromisoformat(line["utc"]).timestamp() - begins_utc_s) * 50.0
        # The targets lie within tens of metres of the vehicle; an alignment by the log's own zero is 1500 m off.
        assert (target["lonlat_deg"][1] - 48) * 111_200 == pytest.approx(flown_m, abs=60)


def test_a_recording_has_the_times_of_day_of_its_own_log(dddas, frames, file, tmp_path):
    pytest.importorskip("pynmea2")
    given = ("--telemetry", file("log.nmea", nmea(1.6e9, 20)), "--camera", file("camera.toml", CAMERA), "--rate", "10")
    done = dddas("run", frames, *FAST, *given, "--out", tmp_path / "out", "--emit", f"cot:{tmp_path}/cot.xml")
    assert done.exit_code == 0, done.output
    _, record, results = session(tmp_path / "out")
    assert [line["utc"][:21] for line in results[:3]] == [f"2020-09-13T12:26:40.{k}" for k in range(3)]
    assert any("this is a recording" in note for note in record["notes"])
    events = (tmp_path / "cot.xml").read_text()
    assert 'time="2020-09-13T12:26:4' in events and not re.search('time="(?!2020-09-13T12:26:4)', events)


def test_a_log_without_times_of_day_is_taken_from_the_first_picture_on_and_a_note_says_so(
    dddas, film_camera, file, tmp_path
):
    film_camera(30)
    page = (Path(__file__).resolve().parents[2] / "docs/onboard.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"```\n(time_s,.*?)```", page, re.DOTALL)
    log = file("mast.csv", table)
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, "--telemetry", log, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    _, record, results = session(tmp_path / "out")
    assert any("gives no time of day: its time 0 is taken as the first picture's" in note for note in record["notes"])
    places = [target["lonlat_deg"] for line in results for target in line["targets"] if target.get("lonlat_deg")]
    assert places and np.abs(np.subtract(places, [-110.95, 32.23])).max() < 0.002


@pytest.mark.parametrize(
    ("address", "content", "environ", "opened"),
    [
        ("rtsp://me@host/live", "s3cret\n", None, "rtsp://me:s3cret@host/live"),
        (
            "rtsp://me@host/live",
            "p@ss/w:rd %é \r\nmore\n",
            "other",
            "rtsp://me:p%40ss%2Fw%3Ard%20%25%C3%A9%20@host/live",
        ),
        ("rtsp://me@host/live", None, "s3cret", "rtsp://me:s3cret@host/live"),
        ("rtsp://me:own@host/live", None, "s3cret", "rtsp://me:own@host/live"),
        ("rtsp://host/live?mail=a@b", None, "s3cret", "rtsp://host/live?mail=a@b"),
        ("http://me@host:81/a@b", "s3cret", None, "http://me:s3cret@host:81/a@b"),
    ],
)
def test_the_password_of_an_address_may_be_in_a_file_or_in_the_environment(
    dddas, file, tmp_path, monkeypatch, address, content, environ, opened
):
    asked: list[str] = []

    def refuse(target, name, *_):
        asked.append(target)
        raise InputError(f"cannot open {name} as a stream; is it there?")

    for module in ("capture", "refusal"):
        monkeypatch.setattr(f"torchvision_dddas.live.{module}.open_stream", refuse)
    monkeypatch.setattr("torchvision_dddas.live.refusal.answered_status", lambda *_: None)
    monkeypatch.delenv("DDDAS_PASSWORD", raising=False)
    if environ is not None:
        monkeypatch.setenv("DDDAS_PASSWORD", environ)
    given = () if content is None else ("--password-file", file("password", content))
    said = bad(dddas("run", address, *FAST, *given, "--out", tmp_path / "out"))
    assert asked == [opened] and "cret" not in said and "@" not in said.replace("a@b", "")


@pytest.mark.parametrize(
    ("clip", "content", "words"),
    [
        ("rtsp://host/live", "s3cret", "is for an address with a name alone"),
        ("rtsp://me:own@host/live", "s3cret", "is for an address with a name alone"),
        ("camera:0", "s3cret", "is for an address with a name alone"),
        ("rtsp://me@host/live", "\ns3cret", "begins with an empty line"),
        ("rtsp://me@host/live", None, "cannot be read: No such file"),
    ],
)
def test_a_password_file_of_no_use_is_one_line_without_the_password(dddas, tmp_path, clip, content, words):
    path = tmp_path / "password"
    if content is not None:
        path.write_text(content)
    said = bad(dddas("run", clip, *FAST, "--password-file", path, "--out", tmp_path / "out"))
    assert words in said and "s3cret" not in said and "own" not in said


def test_a_place_that_cannot_be_written_is_one_line(dddas, frames, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert "Choose another folder with --out" in bad(dddas("run", frames, *FAST, "--out", tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "mine"


def test_no_sink_of_a_live_run_shows_the_password_of_its_camera(dddas, tmp_path, monkeypatch, capfd):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    pages, over = {}, threading.Event()

    def fetch_and_end():
        for path in ("", "metrics", "health.json"):
            for _ in range(600):
                try:
                    with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=60) as page:
                        pages[path] = page.read().decode()
                    break
                except urllib.error.HTTPError as refused:  # without the extra metrics
                    if refused.code == 501:
                        pages[path] = refused.read().decode()
                        break
                except OSError:
                    pass
                over.wait(0.05)
        if not over.is_set():
            os.kill(os.getpid(), signal.SIGTERM)

    # The stream is lost once, which is an event; then it goes on until the signal.
    images = render(0, 8, (240, 180)).images
    rest = (step for image in itertools.cycle(images) for step in (lambda: time.sleep(0.05), image))
    script = itertools.chain(images, [False], rest)
    for module in ("capture", "refusal"):
        monkeypatch.setattr(f"torchvision_dddas.live.{module}.open_stream", lambda *_: FakeStream(script))
    threading.Thread(target=fetch_and_end, daemon=True).start()
    source = "rtsp://me:hush1/a@b:hush2@127.0.0.1:554/live?channel=1&password=hush3 hush4"
    emit = ("--emit", f"mot:{tmp_path}/rows.txt", "--emit", "json:-")
    done = dddas("run", source, *FAST, *emit, "--serve", port, "--out", tmp_path / "out")
    over.set()
    assert done.exit_code == 0, done.output
    assert sorted(pages) == ["", "health.json", "metrics"]
    shown = {path.name: path.read_text() for path in tmp_path.rglob("*") if path.is_file()} | pages
    shown |= {"stderr": done.stderr, "streams": "".join(capfd.readouterr())}
    assert len(shown) == 9 and [name for name, text in shown.items() if "hush" in text] == []
    for name in ("run.json", "", "health.json", "stderr"):
        assert "rtsp://127.0.0.1:554/live?channel=1" in shown[name].replace("&amp;", "&")


def test_a_run_serves_its_annotated_pictures_and_its_state_to_those_who_have_the_token(dddas, film_camera, tmp_path):
    film_camera(10_000)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    seen: dict[str, Any] = {}

    def ask(path: str) -> Any:
        given = {"Authorization": "Bearer token-of-the-test"}
        return urllib.request.urlopen(
            urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=given), timeout=60
        )

    def watch_and_end() -> None:
        try:
            for _ in range(600):
                with suppress(OSError), ask("/picture.mjpg") as stream:
                    while (line := stream.readline()) and not line.startswith(b"Content-Length: "):
                        pass
                    stream.readline()
                    seen["picture"] = stream.read(int(line.split()[1]))
                    break
                time.sleep(0.05)
            with ask("/state.json") as page:
                seen["state"] = json.load(page)
            with suppress(urllib.error.HTTPError):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/state.json", timeout=60)
                seen["open"] = True
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch_and_end, daemon=True).start()
    given = ("--serve", port, "--serve-token", "token-of-the-test", "--out", tmp_path)
    done = dddas("run", "rtsp://127.0.0.1:9/live", *FAST, *given)
    assert done.exit_code == 0, done.output
    assert "token-of" not in done.output and "open" not in seen
    picture = cv2.imdecode(np.frombuffer(seen["picture"], np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (180, 240, 3)
    assert seen["state"]["frame"] > 0 and seen["state"]["map"] is None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("--serve", "0", "--serve-token", "secret;"), "--serve-token has 7 characters; give 8 to 200 of letters"),
        (("--serve-token", "long-enough"), "--serve-token is for --serve PORT; give it too"),
    ],
)
def test_a_token_of_no_use_is_one_line_without_it(dddas, frames, tmp_path, given, words):
    said = bad(dddas("run", frames, *FAST, *given, "--out", tmp_path / "out"))
    assert words in said and "secret" not in said and "long-enough" not in said


def test_the_page_is_there_while_a_camera_is_waited_for_and_says_so(dddas, tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    seen: list[tuple[int, dict[str, Any]]] = []

    def asked() -> tuple[int, dict[str, Any]]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/health.json", timeout=60) as page:
                return page.status, json.load(page)
        except urllib.error.HTTPError as error:
            return error.code, json.load(error)

    def end_when_it_runs() -> None:
        for _ in range(1200):
            if (now := asked())[1]["state"] == "running":
                seen.append(now)
                break
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    images = itertools.cycle(render(0, 8, (240, 180)).images)
    script = (step for image in images for step in (lambda: time.sleep(0.05), image))

    def opened(*_: object) -> FakeStream:
        seen.append(asked())
        if len(seen) < 3:
            raise InputError("no route to it")
        threading.Thread(target=end_when_it_runs, daemon=True).start()
        return FakeStream(script)

    monkeypatch.setattr("torchvision_dddas.live.capture.open_or_refuse", opened)
    words = ("--wait", "--set", "live.retry_s=0.01", "--serve", port, "--out", tmp_path)
    done = dddas("run", "rtsp://127.0.0.1:554/live", *FAST, *words)
    assert done.exit_code == 0, done.output
    assert [(status, page["state"], page["ok"]) for status, page in seen[:3]] == [
        (503, "waiting for the camera", False)
    ] * 3
    assert seen[0][1]["trouble"] == "waiting for the camera"
    assert seen[3][1]["state"] == "running" and "waiting" not in seen[3][1]["trouble"]
    assert done.stderr.index("status page: ") < done.stderr.index("is not there yet: no route to it")


@pytest.mark.parametrize("where", ["json:tcp://me:hush@127.0.0.1:9", "cot:udp://me:hu/sh@127.0.0.1:9"])
def test_a_stream_is_named_without_its_password(where):
    nowhere: Any = None
    name = Stream(where, lambda *_: (), nowhere, print).name
    assert "hu" not in name and "127.0.0.1:9" in name


@pytest.mark.parametrize("pitch_deg", [60.0, None])
def test_a_session_locates_by_telemetry_alone_or_says_why_not(dddas, frames, tmp_path, pitch_deg):
    angle = "" if pitch_deg is None else f",{pitch_deg}"
    lines = ["time_s,altitude_m,speed_m_s,east_m,north_m,heading_deg" + (",pitch_deg" if angle else "")]
    lines += [f"{k / 10},15,1,{k / 10},0,20{angle}" for k in range(FRAMES + 1)]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(lines) + "\n")
    done = dddas("run", frames, *FAST, "--rate", "10", "--telemetry", log, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    _, record, results = session(tmp_path / "out")
    placed = [t for line in results for t in line["targets"] if t.get("east_north_m") is not None]
    if pitch_deg is not None:
        assert placed and not any("0 located" in note for note in record["notes"])
    else:
        cause = "0 located, because the telemetry does not say the camera's pitch"
        assert not placed and any(note.startswith(cause) for note in record["notes"])
        assert cause in done.stderr
        first, last = (event for event in record["events"] if event["kind"] == "locate")
        assert first["frame"] == 1 and first["text"].startswith(cause.replace("0 located, because", "not located:"))
        assert last["text"].startswith(cause)
