"""Figures of a live run for Prometheus. They need the extra `metrics` (prometheus_client)."""

from collections.abc import Iterable, Mapping
from itertools import accumulate
from typing import TYPE_CHECKING

from torchvision_dddas.control import UAV
from torchvision_dddas.live.health import BOUNDS_S, Snapshot

if TYPE_CHECKING:
    from prometheus_client.core import Metric

MISSING = "/metrics needs prometheus_client; pip install 'torchvision-dddas[metrics]'\n"

_OF_PLATFORMS = {
    "captured": "Pictures that the source gave.",
    "dropped": "Pictures that came too late to be processed.",
    "frames": "Pictures of a further platform that were fused or compared.",
    "located": "People and targets that a further platform located.",
    "shared": "People and targets that another platform saw too.",
}


def metrics_page(
    now: Snapshot, trouble: str, version: str, lost: Mapping[str, int], words: Mapping[str, str]
) -> tuple[int, str, str]:
    """Return the page as (status, type, text): 501 and a line that names the extra if it is not installed."""
    try:
        text = metrics(now, trouble, version, lost, words)
    except ImportError:
        return 501, "text/plain", MISSING
    return 200, "text/plain; version=0.0.4", text


def metrics(now: Snapshot, trouble: str, version: str, lost: Mapping[str, int], words: Mapping[str, str]) -> str:
    """Return Prometheus' text exposition format. Raise ImportError without prometheus_client.

    lost: permanently lost messages, by stream. words: help texts by the names of counts, gauges and durations.
    """
    from prometheus_client import CollectorRegistry, generate_latest
    from prometheus_client.registry import Collector

    class Families(Collector):
        def collect(self) -> Iterable["Metric"]:
            return _families(now, trouble, version, lost, words)

    registry = CollectorRegistry(auto_describe=False)
    registry.register(Families())
    return generate_latest(registry).decode()


def _families(
    now: Snapshot, trouble: str, version: str, lost: Mapping[str, int], words: Mapping[str, str]
) -> Iterable["Metric"]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

    def counter(name: str, text: str, label: str, values: Mapping[str, float]) -> "Metric":
        family = CounterMetricFamily(f"dddas_{name}", text, labels=[label])
        for value_of, value in values.items():
            family.add_metric([value_of], value)
        return family

    info = GaugeMetricFamily("dddas_info", "What runs.", labels=["version"])
    info.add_metric([version], 1)
    yield info
    yield GaugeMetricFamily("dddas_healthy", "1 while all is well, as /health.json says.", float(not trouble))
    yield GaugeMetricFamily("dddas_uptime_seconds", "Since the start.", now.since_s)
    yield GaugeMetricFamily("dddas_idle_seconds", "Since the last result.", now.idle_s)
    events = {name.removeprefix("events_"): count for name, count in now.counts.items() if name.startswith("events_")}
    if events:
        yield counter("events", "Events.", "kind", events)
    for name, text in _OF_PLATFORMS.items():
        values = {UAV: now.counts[name]} if name in now.counts else {}
        values |= {one: facts[name] for one, facts in now.platforms.items() if name in facts}
        if values:
            yield counter(name, text, "platform", values)
    for name, count in now.counts.items():
        if not name.startswith("events_") and name not in _OF_PLATFORMS:
            yield CounterMetricFamily(f"dddas_{name}", words.get(name, name), count)
    for name, value in now.gauges.items():
        yield GaugeMetricFamily(f"dddas_{name}", words.get(name, name), value)
    for name, (counts, total_s) in now.histograms.items():
        bounds = (*(f"{bound:g}" for bound in BOUNDS_S), "+Inf")
        buckets = list(zip(bounds, accumulate(counts), strict=True))
        yield HistogramMetricFamily(f"dddas_{name}_seconds", words.get(name, name), buckets, total_s)
    if lost:
        yield counter("lost_messages", "Messages that were lost for good.", "stream", lost)
