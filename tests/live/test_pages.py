"""How a run goes, for a person, for Prometheus, for programs."""

import json
import re
from html.parser import HTMLParser

import pytest

from torchvision_dddas.live.health import Health
from torchvision_dddas.live.pages import find_trouble, health_json, html_page, metrics
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
    text = metrics(health.snapshot(), '0.1"\\\n', "", {"cot:udp://h:1": 4})
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
    lines = metrics(health.snapshot(), "1", "hung", {"json:-": 4}).splitlines()
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
