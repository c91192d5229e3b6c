"""The state of a run over HTTP: for a person, for Prometheus, for programs."""

import json
import re
import socket
import threading
import urllib.error
import urllib.request
from html.parser import HTMLParser

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.server import HealthServer, find_trouble, health_json, html_page, metrics, parse_address
from torchvision_dddas.live.status import snapshot_facts

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
    page = html_page(health.snapshot(), 'a<i>"&', "running", "", ("/metrics",), refresh_s=3)
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
    page = html_page(health.snapshot(), "x", "running", "no result for 0:12", ())
    assert page.index("fewer keypoints") < page.index("lost &lt;b&gt;")
    assert "no result for 0:12" in page
    assert "all is well" not in page


def test_json_is_strict_even_where_a_number_is_not_finite(health):
    def refuse(name):
        raise AssertionError(name)

    read = json.loads(health_json(snapshot_facts(health.snapshot()), ""), parse_constant=refuse)
    assert read["ok"] is True
    assert read["gauges"] == {"every": 2, "rate_hz": None}
    assert read["seconds"]["latency"]["p99"] == pytest.approx(0.09801)
    assert read["events"][0]["frame"] == 12


def test_no_result_for_long_or_a_hung_step_is_trouble(health):
    now = health.snapshot()
    assert find_trouble(now, 60.0) == ""
    assert find_trouble(now, 60.0, "the work on frame 3 has taken 40 s").startswith("the work")
    assert find_trouble(now, -1.0) == "no result for 0:00"


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


def test_head_gives_no_body_and_another_path_names_those_that_are(server):
    assert asked(server, "/", "HEAD")[2] == b""
    status, _, body = asked(server, "/../etc/passwd")
    assert status == 404
    assert b"/health.json" in body


def test_nothing_can_be_sent_to_it(server):
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
