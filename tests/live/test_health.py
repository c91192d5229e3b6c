"""The health of a run: what is counted, what is written of it, and its pages over HTTP."""

import json
import re
import socket
import threading
import urllib.error
import urllib.request
from html.parser import HTMLParser
from typing import Any

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output import SessionLog, make_session_folder
from torchvision_dddas.live.health import Health, StatusWriter
from torchvision_dddas.live.server import HealthServer, health_pages, html_page, metrics, parse_address


def test_counts_of_many_threads_add_up():
    health = Health()

    def often():
        for _ in range(500):
            health.count("read")

    threads = [threading.Thread(target=often) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert health.snapshot().counts == {"read": 2000}


def test_percentiles_are_of_the_latest_times():
    health = Health()
    for _ in range(10):
        health.took("step", 9.0)
    for k in range(4096):
        health.took("step", k / 4095)
    assert health.snapshot().seconds["step"] == pytest.approx((0.5, 0.95, 0.99), abs=1e-3)


def test_a_result_makes_the_run_fresh_and_events_are_kept_in_order():
    health = Health()
    health.event("stream", "lost", 3)
    health.event("stream", "found again", 7)
    health.result()
    now = health.snapshot()
    assert now.idle_s < 1
    assert [(event.frame, event.text) for event in now.events] == [(3, "lost"), (7, "found again")]
    assert now.counts == {"events_stream": 2, "results": 1}


class Disk(Any):
    """A log that may be full."""

    def __init__(self):
        self.full, self.lines, self.states = False, [], []

    def append(self, events):
        if self.full:
            raise OSError(28, "No space left on device")
        self.lines += [event.text for event in events]

    def write_state(self, state, now):
        if self.full:
            raise OSError(28, "No space left on device")
        self.states.append((state, now["counts"].get("results", 0)))


def test_events_are_written_and_shown_once_each_in_order_and_the_last_state_at_the_end():
    health, disk, shown, synced = Health(), Disk(), [], Disk()
    synced.count = 0
    synced.sync = lambda: setattr(synced, "count", synced.count + 1)
    with StatusWriter(health, disk, [synced], 1000.0, lambda event: shown.append(event.text)) as status:
        for words in (("one", "two"), ("three",), ()):
            for word in words:
                health.event("run", word)
            status.events()
        health.result()
        health.event("run", "the end")
        status.state = "complete"
    assert disk.lines == shown == ["one", "two", "three", "the end"]
    assert (disk.states, synced.count) == ([("complete", 1)], 1)
    with pytest.raises(ZeroDivisionError), StatusWriter(Health(), disk, [], 1000.0):
        raise ZeroDivisionError
    assert disk.states[-1][0] == "failed"


def test_a_disk_that_refuses_is_reported_once_and_gets_everything_later():
    health, disk, shown = Health(), Disk(), []
    status = StatusWriter(health, disk, [], 1.0, lambda event: shown.append(event.text))
    disk.full = True
    for words in ("one", "two", "three"):
        health.event("run", words)
        status.events()
        status.status()
    assert sum("No space left on device" in words for words in shown) == 1
    disk.full = False
    status.events()
    status.status()
    assert [words for words in disk.lines if "No space" not in words] == ["one", "two", "three"]
    assert disk.states == [("running", 0)]


def test_each_session_has_a_folder_of_its_own(tmp_path):
    folders = [make_session_folder(tmp_path / "out", utc_s).name for utc_s in (0.0, 0.5, 60.0)]
    assert folders == ["1970-01-01T000000Z", "1970-01-01T000000Z-2", "1970-01-01T000100Z"]
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"cannot write into .*file.*--out"):
        make_session_folder(tmp_path / "file")


def test_a_session_is_valid_at_every_moment(tmp_path):
    health, log = Health(), SessionLog(tmp_path, {"input": "camera:0", "odd": float("nan")})
    log.write_state("running", {"counts": {}})
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "running"
    log.append([health.event("stream", "lost\nand found", 4), health.event("run", "é")])
    lines = (tmp_path / "events.log").read_text().splitlines()
    assert len(lines) == 2
    assert lines[0].endswith("Z 4 stream: lost and found")
    assert lines[1].endswith("Z - run: é")
    log.close()
    assert json.loads((tmp_path / "run.json").read_text())["odd"] is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events.log", "run.json"]


# -- pages -------------------------------------------------------------------------------------------------------------

# The text exposition format, version 0.0.4.
_NAME, _LABEL = r"[a-zA-Z_:][a-zA-Z0-9_:]*", r'[a-zA-Z_][a-zA-Z0-9_]*="(?:[^"\\\n]|\\[\\"n])*"'
_SAMPLE = re.compile(rf"({_NAME})(?:\{{{_LABEL}(?:,{_LABEL})*\}})? (NaN|[+-]Inf|-?[0-9.]+(?:e[+-]?[0-9]+)?)$")
_ABOUT = re.compile(rf"# (HELP|TYPE) ({_NAME}) (.+)$")


@pytest.fixture
def health():
    filled = Health()
    for name in ("captured", "dropped", "reconnects"):
        filled.count(name, 3)
    filled.gauge("every", 2)
    filled.gauge("rate_hz", float("nan"))
    for k in range(100):
        filled.took("latency", k / 1000)
    filled.event("stream", 'lost <b>rtsp://x</b> "again"\n', 12)
    filled.event("load", "fewer keypoints")
    filled.result()
    return filled


def test_every_line_of_metrics_is_of_the_format_and_of_a_family_that_was_announced_once(health):
    text = metrics(health.snapshot(), "", '0.1"\\\n', {"cot:udp://h:1": 4})
    assert text.endswith("\n")
    announced, kinds, seen = [], {}, []
    for line in text.splitlines():
        if about := _ABOUT.match(line):
            announced.append(about.group(1, 2))
            kinds[about.group(2)] = about.group(3)
            continue
        sample = _SAMPLE.match(line)
        assert sample, line
        assert sample.group(1) in kinds
        seen.append(line.rpartition(" ")[0])
    assert len(set(announced)) == len(announced)
    assert len(set(seen)) == len(seen)
    assert set(kinds.values()) <= {"counter", "gauge"}
    assert all(name.endswith("_total") for name, kind in kinds.items() if kind == "counter")


def test_metrics_say_what_health_knows(health):
    lines = metrics(health.snapshot(), "hung", "1", {"json:-": 4}).splitlines()
    for line in (
        "dddas_captured_total 3",
        "dddas_results_total 1",
        "dddas_every 2",
        "dddas_rate_hz NaN",
        "dddas_healthy 0",
        'dddas_events_total{kind="stream"} 1',
        'dddas_latency_seconds{quantile="0.5"} 0.0495',
        'dddas_lost_messages_total{stream="json:-"} 4',
    ):
        assert line in lines


def test_the_page_is_whole_fetches_nothing_and_loads_itself_again(health):
    page = html_page(health.snapshot(), 'a<i>"&', "running", "", refresh_s=3)
    tags = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            tags.append((tag, dict(attrs)))

    Reader().feed(page)
    names = [tag for tag, _ in tags]
    assert not {"script", "link", "img", "iframe", "i", "b"} & set(names)
    assert ("meta", {"http-equiv": "refresh", "content": "3"}) in tags
    assert any(attrs.get("name") == "viewport" for _, attrs in tags)
    assert "://" not in page.replace("rtsp://x", "")
    assert "@import" not in page and "url(" not in page
    assert "a&lt;i&gt;&#34;&amp;" in page


def test_the_page_shows_the_latest_events_first_and_what_is_wrong(health):
    page = html_page(health.snapshot(), "x", "running", "no result for 0:12")
    assert page.index("fewer keypoints") < page.index("lost &lt;b&gt;")
    assert "no result for 0:12" in page
    assert "all is well" not in page


class Run(Any):
    """What the pages ask beside the health."""

    name, lost, state, hung = "json:-", 4, "running", ""


def test_json_is_strict_even_where_a_number_is_not_finite_and_says_what_is_wrong(health):
    def refuse(name):
        raise AssertionError(name)

    def answer(patience_s):
        status, kind, text = health_pages(health, run, [run], run, "x", "1", patience_s)["/health.json"]()
        assert kind == "application/json"
        return status, json.loads(text, parse_constant=refuse)

    run = Run()
    status, found = answer(60.0)
    assert (status, found["ok"], found["state"]) == (200, True, "running")
    assert found["gauges"] == {"every": 2, "rate_hz": None}
    assert found["seconds"]["latency"]["p99"] == pytest.approx(0.09801)
    assert found["events"][0]["frame"] == 12
    status, found = answer(-1.0)
    assert (status, found["ok"], found["trouble"]) == (503, False, "no result for 0:00")
    run.hung = "the work on frame 3 has taken 40 s"
    assert answer(60.0)[1]["trouble"] == run.hung
    pages = health_pages(health, run, [run], run, "x", "1", 60.0)
    assert "dddas_healthy 0" in pages["/metrics"]()[2] and run.hung in pages["/"]()[2]


PATIENCE_S = 60.0


@pytest.fixture
def server():
    pages = {"/": lambda: (200, "text/html", "<p>é"), "/health.json": lambda: (503, "application/json", "{}")}
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


def test_a_page_comes_with_its_status_type_and_length(server):
    status, headers, body = asked(server, "/?again")
    assert (status, body.decode()) == (200, "<p>é")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Content-Length"] == str(len(body))
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert asked(server, "/health.json")[0] == 503


def test_head_gives_no_body_another_path_names_those_that_are_and_nothing_can_be_sent(server):
    assert asked(server, "/", "HEAD")[2] == b""
    status, _, body = asked(server, "/../etc/passwd")
    assert status == 404
    assert b"/health.json" in body
    assert asked(server, "/", "POST")[0] == 501


def test_clients_that_say_nothing_keep_nobody_from_the_pages(server):
    with socket.create_connection(server.address), socket.create_connection(server.address):
        assert asked(server)[0] == 200


def test_a_page_that_fails_ends_nothing():
    def failing() -> tuple[int, str, str]:
        raise ZeroDivisionError

    with HealthServer(("127.0.0.1", 0), {"/": failing, "/well": lambda: (200, "text/plain", "well")}) as server:
        with pytest.raises((urllib.error.URLError, ConnectionError)):
            asked(server)
        assert asked(server, "/well")[0] == 200


def test_a_port_in_use_is_one_line(server):
    with pytest.raises(InputError, match=r"cannot serve at 127\.0\.0\.1:\d+: address already in use; choose another"):
        HealthServer(server.address, {})


def test_when_it_is_left_the_port_is_free_and_no_thread_stays():
    before = threading.active_count()
    with HealthServer(("127.0.0.1", 0), {}) as server:
        address = server.address
    assert threading.active_count() == before
    with HealthServer(address, {}):
        pass


@pytest.mark.parametrize(
    ("spec", "address"),
    [
        ("8080", ("127.0.0.1", 8080)),
        (":8080", ("127.0.0.1", 8080)),
        ("0.0.0.0:1", ("0.0.0.0", 1)),
        ("[::1]:9", ("::1", 9)),
    ],
)
def test_a_port_alone_is_this_machines_own(spec, address):
    assert parse_address(spec) == address


@pytest.mark.parametrize("spec", ["", "eighty", "1.2.3.4", "host:", "70000", "-1", "8080/"])
def test_what_is_no_address_is_one_line(spec):
    with pytest.raises(InputError, match=r"--serve .* is no address; wanted PORT or HOST:PORT"):
        parse_address(spec)
