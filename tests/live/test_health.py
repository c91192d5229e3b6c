"""The health of a run: its figures, the files it is written to, and its pages over HTTP."""

import json
import re
import socket
import threading
import urllib.error
import urllib.request
from contextlib import ExitStack
from html.parser import HTMLParser
from typing import Any

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output import SessionLog, make_session_folder
from torchvision_dddas.live import session
from torchvision_dddas.live.health import Health, StatusWriter
from torchvision_dddas.live.server import (
    _COUNTS,
    _GAUGES,
    _SECONDS,
    HealthServer,
    health_pages,
    html_page,
    parse_address,
)
from torchvision_dddas.types import Adjustment


def test_percentiles_are_of_the_latest_times():
    health = Health()
    for seconds in (*[9.0] * 10, *[k / 4095 for k in range(4096)]):
        health.took("step", seconds)
    assert health.snapshot().seconds["step"] == pytest.approx((0.5, 0.95, 0.99), abs=1e-3)


class Disk(Any):
    """A log on a disk that may be full, and a stream that may be flushed to it."""

    def __init__(self):
        self.full, self.lines, self.states, self.synced = False, [], [], 0

    def append(self, events):
        if self.full:
            raise OSError(28, "No space left on device")
        self.lines += [event.text for event in events]

    def write_state(self, state, now):
        self.append([])
        self.states.append((state, now["counts"].get("results", 0)))

    def sync(self):
        self.synced += 1


def test_each_event_is_written_and_shown_once_and_the_last_state_at_the_end():
    health, disk, shown = Health(), Disk(), []
    with StatusWriter(health, disk, [disk], 1000.0, lambda event: shown.append(event.text)) as status:
        for words in (("one", "two"), ("three",), ()):
            for word in words:
                health.event("run", word)
            status.events()
        health.result()
        health.event("run", "the end")
        status.state = "complete"
    assert disk.lines == shown == ["one", "two", "three", "the end"]
    assert (disk.states, disk.synced) == ([("complete", 1)], 1)
    with pytest.raises(ZeroDivisionError), StatusWriter(Health(), disk, [], 1000.0):
        raise ZeroDivisionError
    assert disk.states[-1][0] == "failed"


def test_a_full_disk_is_reported_once_and_gets_everything_later():
    health, disk, shown = Health(), Disk(), []
    status = StatusWriter(health, disk, [], 1.0, lambda event: shown.append(event.text))
    for disk.full, words in ((True, "one"), (True, "two"), (True, "three"), (False, "four")):
        health.event("run", words)
        status.events()
        status.status()
    assert sum("No space left on device" in words for words in shown) == 1
    assert [words for words in disk.lines if "No space" not in words] == ["one", "two", "three", "four"]
    assert disk.states == [("running", 0)]


def test_what_the_disk_refuses_is_a_trouble_until_it_is_written_and_at_the_end_a_refusal():
    health, disk = Health(), Disk()
    status = StatusWriter(health, disk, [], 1000.0)
    for disk.full, troubles in ((True, 1), (False, 0)):
        health.event("run", "one")
        status.events()
        status.status()
        assert len(health.snapshot().troubles) == troubles == len(status.refused.split(";")) - 1
    with status:
        disk.full = True
    assert "run.json cannot be written: No space left on device" in status.refused
    assert health.snapshot().events[-1].text.endswith("; tried again")


@pytest.mark.parametrize("victim", ["events.log", "run.json"])
def test_a_file_of_a_session_that_cannot_be_begun_is_one_line_and_the_other_says_so(tmp_path, victim):
    (tmp_path / victim / "mine").mkdir(parents=True)
    health, log = Health(), SessionLog(tmp_path, {})
    with pytest.raises(InputError, match=rf"^{tmp_path}: {victim} cannot be written: .*directory.*--out$"):
        StatusWriter(health, log, [], 1000.0).begin()
    log.close()
    if victim == "events.log":
        record = json.loads((tmp_path / "run.json").read_text())
        assert record["state"] == "failed" and "events.log cannot be written" in record["events"][-1]["text"]
    else:
        assert " sink: run.json cannot be written: " in (tmp_path / "events.log").read_text()


def test_a_trouble_may_end_by_itself_and_others_are_asked_for(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    health, asked = Health(), ["the network is away"]
    health.trouble("damage", "frame 3 could not be decoded", 10.0)
    health.ask(lambda: asked[0])
    assert health.snapshot().troubles == ("frame 3 could not be decoded", "the network is away")
    asked[0] = ""
    now[0] = 109.0
    assert health.snapshot().troubles == ("frame 3 could not be decoded",)
    now[0] = 111.0
    assert health.snapshot().troubles == ()


def test_changes_of_parameters_are_in_the_log_and_the_state_once_and_not_among_the_events():
    health, disk, shown = Health(), Disk(), []
    changes = [Adjustment(k, "interval.frames", k, k + 1, "altitude 90 m") for k in range(200)]
    status = StatusWriter(health, disk, [], 1000.0, lambda event: shown.append(event.text))
    health.event("run", "begun")
    health.adjusted(changes[:2])
    health.adjusted([Adjustment(5, "sampling.every", 1, 2, "too slow")], ["sampling.every"])
    status.events()
    status.events()
    assert disk.lines == ["begun", *(f"interval.frames {k} -> {k + 1}: altitude 90 m" for k in range(2))]
    assert shown == ["begun"] and len(health.snapshot().events) == 1
    health.adjusted(changes[2:])
    facts = health.adjustments()
    assert facts["adjustments_made"] == {"interval.frames": 200, "sampling.every": 1}
    assert [row["frame"] for row in facts["adjustments"] if row["knob"] == "interval.frames"] == list(range(100))


def test_each_session_has_its_own_folder(tmp_path):
    folders = [make_session_folder(tmp_path, utc_s).name for utc_s in (0.0, 0.5, 60.0)]
    assert folders == ["1970-01-01T000000Z", "1970-01-01T000000Z-2", "1970-01-01T000100Z"]


def test_a_session_is_valid_at_every_moment(tmp_path):
    health, log = Health(), SessionLog(tmp_path, {"input": "camera:0", "odd": float("nan")})
    log.write_state("running", {"counts": {}})
    record = json.loads((tmp_path / "run.json").read_text())
    assert (record["state"], record["odd"]) == ("running", None)
    log.append([health.event("stream", "lost\nand found", 4), health.event("run", "é")])
    lines = (tmp_path / "events.log").read_text().splitlines()
    assert len(lines) == 2
    assert lines[0].endswith("Z 4 stream: lost and found")
    assert lines[1].endswith("Z - run: é")
    log.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events.log", "run.json"]


# -- pages -------------------------------------------------------------------------------------------------------------


def test_the_page_loads_own_files_alone_and_shows_trouble_and_the_latest_events_first(health):
    page = html_page(health.snapshot(), 'a<i>"&', "running", "no result for 0:12", refresh_s=3)
    tags = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            tags.append((tag, dict(attrs)))

    Reader().feed(page)
    assert not {"iframe", "i", "b", "style"} & {tag for tag, _ in tags}
    assert {about["src"] for tag, about in tags if tag in ("script", "img")} == {"live.js", "picture.mjpg"}
    assert [about["href"] for tag, about in tags if tag == "link"] == ["live.css"]
    assert not re.search(r"<script[^>]*>[^<]|\sstyle=|\son\w+=", page)
    assert ("meta", {"http-equiv": "refresh", "content": "3"}) in tags  # for browsers without scripts
    assert "://" not in page.replace("rtsp://x", "")
    assert "@import" not in page and "url(" not in page
    assert "a&lt;i&gt;&#34;&amp;" in page
    assert page.index("fewer keypoints") < page.index("lost &lt;b&gt;")
    assert "no result for 0:12" in page and "all is well" not in page


class Run(Any):
    """The stream, state and watchdog of a run."""

    name, lost, state, hung = "json:-", 4, "running", ""


def test_json_is_strict_and_all_pages_show_the_same_trouble(health):
    def refuse(name):
        raise AssertionError(name)

    def answer(patience_s):
        status, kind, text = health_pages(health, run, [run], lambda: run.state, "x", "1", patience_s)["/health.json"]()
        assert kind == "application/json"
        return status, json.loads(str(text), parse_constant=refuse)

    run = Run()
    status, found = answer(60.0)
    assert (status, found["ok"], found["state"]) == (200, True, "running")
    assert found["gauges"] == {"every": 2, "rate_hz": None}
    assert found["seconds"]["latency"]["p99"] == pytest.approx(0.09901)
    assert found["events"][0]["frame"] == 12
    status, found = answer(-1.0)
    assert (status, found["ok"], found["trouble"]) == (503, False, "no result for 0:00")
    run.hung = "the work on frame 3 has taken 40 s"
    assert answer(60.0)[1]["trouble"] == run.hung
    pages = health_pages(health, run, [run], lambda: run.state, "x", "1", 60.0)
    assert run.hung in pages["/"]()[2]
    status, _, text = pages["/metrics"]()
    assert "dddas_healthy 0" in text if status == 200 else "[metrics]" in text


def test_health_is_not_well_while_a_trouble_lasts_or_most_results_are_late():
    health, run = Health(), Run()

    def answer():
        status, _, text = health_pages(health, run, [run], lambda: run.state, "x", "1", 60.0)["/health.json"]()
        return status, json.loads(str(text))["trouble"]

    health.trouble("stream", "camera:0 sends no pictures")
    health.trouble("telemetry", "telemetry is silent")
    assert answer() == (503, "camera:0 sends no pictures; telemetry is silent")
    health.trouble("stream")
    health.trouble("telemetry")
    for late in (*[False] * 25, *[True] * 12):
        health.timed(late)
    assert answer() == (200, "")
    health.timed(True)
    assert answer() == (503, "13 of the latest 25 results are late")
    assert health.snapshot().counts["late"] == 13
    for _ in range(25):
        health.timed(False)
    assert answer() == (200, "")


def test_time_without_a_result_counts_from_when_the_camera_is_there(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    health = Health()
    now[0] = 700.0
    health.begin()
    now[0] = 701.0
    assert health.idle_s == 1.0 and health.snapshot().since_s == 601.0


def test_figures_of_the_page_are_labelled_and_written_out():
    health = Health()
    for name, value in {"sent_hz": 25.0, "rate_hz": 8.34, "keypoints": 1500, "resident_bytes": 1.234e9}.items():
        health.gauge(name, value)
    text = re.sub(r"<[^>]+>|\s", " ", html_page(health.snapshot(), "x", "running", ""))
    words = re.sub(" +", " ", text)
    for figure, label in (
        ("25.0", "pictures a second"),
        ("8.3", "results a second"),
        ("1 500", "keypoints at most"),
        ("1 234 MB", "memory"),
    ):
        assert f"{figure} {label}" in words or f"{label} {figure}" in words


def test_every_tile_of_the_page_has_a_title_and_a_value():
    health = Health()
    for name in (*_COUNTS, *session._COUNTED):
        health.count(name, 2)
    for name in _GAUGES:
        health.gauge(name, 1)
    for name in _SECONDS:
        health.took(name, 0.1)
    found: dict[str, list[str]] = {"dt": [], "dd": []}

    class Reader(HTMLParser):
        within = ""

        def handle_starttag(self, tag, attrs):
            self.within = tag
            if tag in found:
                found[tag].append("")

        def handle_data(self, data):
            if self.within in found:
                found[self.within][-1] += data.strip()

    Reader().feed(html_page(health.snapshot(), "x", "running", ""))
    assert len(found["dt"]) == len(found["dd"]) == len(set(found["dt"])) > 20
    assert all(found["dt"]) and all(found["dd"])
    assert found["dd"][found["dt"].index("camera")] == "sends pictures"
    health.gauge("connected", 0)
    assert re.search(r"camera\W.{,30}\Wlost\W", html_page(health.snapshot(), "x", "running", ""), re.DOTALL)


PATIENCE_S = 60.0


def failing():
    raise ZeroDivisionError


@pytest.fixture
def server():
    pages = {"/": lambda: (200, "text/html", "<p>é"), "/bad": lambda: (503, "text/plain", ""), "/failing": failing}
    with HealthServer(("127.0.0.1", 0), pages) as server:
        yield server


def asked(server, path="/", method="GET"):
    request = urllib.request.Request("http://{}:{}{}".format(*server.address, path), method=method)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers, error.read()


def test_requests_are_answered_with_status_type_and_length(server):
    status, headers, body = asked(server, "/?again")
    assert (status, body.decode()) == (200, "<p>é")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Content-Length"] == str(len(body))
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; ") and "unsafe" not in policy
    assert asked(server, "/bad")[0] == 503
    assert asked(server, "/", "HEAD")[2] == b""
    assert asked(server, "/", "POST")[0] == 501
    status, _, body = asked(server, "/../etc/passwd")
    assert status == 404
    assert b"/failing" in body


def test_silent_clients_and_a_page_that_fails_keep_nobody_from_the_others(server):
    with socket.create_connection(server.address), socket.create_connection(server.address):
        with pytest.raises((urllib.error.URLError, ConnectionError)):
            asked(server, "/failing")
        assert asked(server)[0] == 200


def test_slow_clients_cannot_take_the_page_away(server):
    with ExitStack() as stack:
        for _ in range(20):
            slow = stack.enter_context(socket.create_connection(server.address))
            slow.sendall(b"GET / HT")
        for _ in range(3):
            assert asked(server)[0] == 200


def test_a_closed_server_frees_its_port_and_leaves_no_thread():
    before = set(threading.enumerate())  # threads of earlier tests may end meanwhile
    with HealthServer(("127.0.0.1", 0), {}) as server:
        address = server.address
    assert set(threading.enumerate()) <= before
    with HealthServer(address, {}):
        pass


def test_a_port_alone_is_on_this_machine_only():
    addresses = [parse_address(spec) for spec in ("8080", ":8080", "0.0.0.0:1", "[::1]:9")]
    assert addresses == [("127.0.0.1", 8080), ("127.0.0.1", 8080), ("0.0.0.0", 1), ("::1", 9)]


@pytest.mark.parametrize("spec", ["", "1.2.3.4", "host:", "70000", "-1", "8080/"])
def test_a_wrong_address_is_one_line(spec):
    with pytest.raises(InputError, match=r"--serve .* is no address; give PORT or HOST:PORT"):
        parse_address(spec)
