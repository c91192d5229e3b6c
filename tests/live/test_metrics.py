"""Figures of a live run for Prometheus, read by the parser of its client."""

import sys

import pytest

from torchvision_dddas.live.health import BOUNDS_S
from torchvision_dddas.live.metrics import metrics, metrics_page

WORDS = {"reconnects": "Times that the stream was opened again.", "latency": "From capture to result."}


def families(health, trouble="", lost=()):
    parser = pytest.importorskip("prometheus_client.parser", reason="the extra metrics is not installed")
    text = metrics(health.snapshot(), trouble, '0.1"\\\n', dict(lost), WORDS)
    found = list(parser.text_string_to_metric_families(text))
    assert len({family.name for family in found}) == len(found)
    return {family.name: family for family in found}


def values(family, label=""):
    return {sample.labels.get(label, ""): sample.value for sample in family.samples}


def test_each_family_has_its_kind_its_words_and_its_values(health):
    found = families(health, "hung", {"cot:udp://h:1": 4})
    kinds = {name.removeprefix("dddas_"): family.type for name, family in found.items()}
    assert {name for name, kind in kinds.items() if kind == "counter"} == {
        *("captured", "dropped", "frames", "reconnects", "results", "events", "lost_messages")
    }
    assert kinds["latency_seconds"] == "histogram" and kinds["every"] == kinds["healthy"] == "gauge"
    assert found["dddas_reconnects"].documentation == WORDS["reconnects"]
    assert values(found["dddas_reconnects"]) == {"": 3} and values(found["dddas_results"]) == {"": 1}
    assert values(found["dddas_healthy"]) == {"": 0} and values(found["dddas_every"]) == {"": 2}
    assert found["dddas_rate_hz"].samples[0].value != found["dddas_rate_hz"].samples[0].value
    assert values(found["dddas_events"], "kind") == {"stream": 1, "load": 1}
    assert values(found["dddas_lost_messages"], "stream") == {"cot:udp://h:1": 4}
    assert values(found["dddas_info"], "version") == {'0.1"\\\n': 1}


def test_pictures_are_counted_for_each_platform(health):
    found, odd = families(health), 'ugv "1"\n\\'
    assert values(found["dddas_captured"], "platform") == {"uav": 3, odd: 40}
    assert values(found["dddas_dropped"], "platform") == {"uav": 3, odd: 2}
    assert values(found["dddas_frames"], "platform") == {odd: 38}


def test_a_histogram_counts_all_durations_up_to_each_bound_with_the_bound(health):
    for _ in range(5000):  # more than are kept for the quantiles
        health.took("latency", 99.0)
    samples = families(health)["dddas_latency_seconds"].samples
    buckets = {float(s.labels["le"]): s.value for s in samples if s.name.endswith("_bucket")}
    assert buckets == {bound: min(round(1000 * bound), 100) for bound in BOUNDS_S} | {float("inf"): 5100}
    rest = {s.name.rpartition("_")[2]: s.value for s in samples if not s.name.endswith("_bucket")}
    assert rest == {"count": 5100, "sum": pytest.approx(5.05 + 99 * 5000)}


def test_without_the_extra_one_line_names_it(health, monkeypatch):
    for name in [*(name for name in sys.modules if name.startswith("prometheus_client")), "prometheus_client"]:
        monkeypatch.setitem(sys.modules, name, None)
    status, kind, text = metrics_page(health.snapshot(), "", "1", {}, {})
    assert (status, kind) == (501, "text/plain") and text.count("\n") == 1
    assert "pip install 'torchvision-dddas[metrics]'" in text
