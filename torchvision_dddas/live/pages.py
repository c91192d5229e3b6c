"""How a live run goes, for a person, for Prometheus, and for programs."""

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from torchvision_dddas.io.report import render_page
from torchvision_dddas.live.health import Snapshot

_EVENTS = 20


def html_page(now: Snapshot, name: str, state: str, trouble: str, links: tuple[str, ...], refresh_s: int = 2) -> str:
    """A page without scripts that loads itself again; nothing is fetched from elsewhere."""
    latest = list(reversed(now.events))[:_EVENTS]
    return render_page(
        "live.html",
        title=f"{state} · {name}",
        name=name,
        trouble=trouble,
        figures=_tiles(now),
        events=[(_clock(event.utc_s), event.frame, event.text) for event in latest],
        now=_clock(datetime.now(UTC).timestamp()),
        links=links,
        refresh_s=refresh_s,
    )


def _tiles(now: Snapshot) -> list[tuple[str, str]]:
    counts, gauges = now.counts, now.gauges
    tiles = [("running for", _span(now.since_s)), ("results", f"{counts.get('results', 0):,}".replace(",", " "))]
    for name, words, unit in (
        ("rate_hz", "results a second", ""),
        ("targets", "targets now", ""),
        ("people", "people now", ""),
        ("every", "looks at one picture of", ""),
        ("keypoints", "keypoints", ""),
        ("queue", "pictures waiting", ""),
        ("resident_bytes", "memory", " MB"),
    ):
        if name in gauges:
            value = gauges[name] / 1e6 if unit else gauges[name]
            tiles.append((words, f"{value:.3g}{unit}"))
    for name, words in (
        ("latency", "latency, median · 99 %"),
        ("age", "age of a result"),
        ("step", "work on a picture"),
    ):
        if name in now.seconds:
            middle, _, most = now.seconds[name]
            tiles += [(f"{words}, median", f"{1000 * middle:.0f} ms"), (f"{words}, 99 %", f"{1000 * most:.0f} ms")]
    for name, words in (
        ("captured", "pictures captured"),
        ("dropped", "dropped"),
        ("late", "late"),
        ("undecoded", "not decoded"),
        ("unreliable", "without a conclusion"),
        ("reconnects", "reconnected"),
        ("begun_anew", "begun anew"),
    ):
        if name in counts:
            tiles.append((words, f"{counts[name]:,}".replace(",", " ")))
    return tiles


def _span(seconds: float) -> str:
    whole = int(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    return f"{days} d {hours} h" if days else f"{hours} h {minutes} min" if hours else f"{minutes}:{whole % 60:02d}"


def _clock(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%H:%M:%S")


_HELP = {
    "captured": "Pictures that the source gave.",
    "dropped": "Pictures that were too late to be looked at.",
    "looked_at": "Pictures that were looked at.",
    "undecoded": "Pictures that could not be decoded.",
    "reconnects": "Times that the stream was opened again.",
    "results": "Frames whose results were handed on.",
    "late": "Results later than the deadline.",
    "unreliable": "Frames from which nothing could be concluded.",
    "begun_anew": "Times that the work failed and was begun anew.",
    "every": "One of so many pictures is looked at.",
    "keypoints": "Keypoints that a registration may take.",
    "queue": "Pictures that wait.",
    "rate_hz": "Results a second.",
    "targets": "Targets in the latest frame.",
    "people": "People in the latest frame.",
    "resident_bytes": "Memory of the process.",
    "latency": "From the capture of the newest picture to the results that it settles.",
    "age": "From the capture of a picture to its own results.",
    "step": "Work on a picture.",
}


def metrics(now: Snapshot, version: str, trouble: str, lost: Mapping[str, int]) -> str:
    """Prometheus' text exposition format, version 0.0.4. lost: messages that nobody will get, by stream."""
    lines: list[str] = []

    def metric(name: str, kind: str, words: str, values: Mapping[str, float]) -> None:
        """values: by labels in braces, or empty ones."""
        lines.extend([f"# HELP dddas_{name} {words}", f"# TYPE dddas_{name} {kind}"])
        lines.extend(f"dddas_{name}{labels} {_value(value)}" for labels, value in values.items())

    metric("info", "gauge", "What runs.", {_labels(version=version): 1})
    metric("healthy", "gauge", "1 while all is well, as /health.json says.", {"": float(not trouble)})
    metric("uptime_seconds", "gauge", "Since the start.", {"": now.since_s})
    metric("idle_seconds", "gauge", "Since the last result.", {"": now.idle_s})
    events = {name.removeprefix("events_"): count for name, count in now.counts.items() if name.startswith("events_")}
    if events:
        metric("events_total", "counter", "Events.", {_labels(kind=kind): count for kind, count in events.items()})
    for name, count in now.counts.items():
        if not name.startswith("events_"):
            metric(f"{name}_total", "counter", _HELP.get(name, name), {"": count})
    for name, value in now.gauges.items():
        metric(name, "gauge", _HELP.get(name, name), {"": value})
    for name, values in now.seconds.items():
        shares = zip(("0.5", "0.95", "0.99"), values, strict=True)
        metric(f"{name}_seconds", "gauge", _HELP.get(name, name), {_labels(quantile=q): v for q, v in shares})
    if lost:
        words = "Messages that nobody will get."
        metric("lost_messages_total", "counter", words, {_labels(stream=s): n for s, n in lost.items()})
    return "\n".join(lines) + "\n"


def _labels(**labels: str) -> str:
    def quoted(text: str) -> str:
        return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

    return "{" + ",".join(f'{name}="{quoted(value)}"' for name, value in labels.items()) + "}"


def _value(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    return ("+Inf" if value > 0 else "-Inf") if math.isinf(value) else f"{value:.12g}"


def find_trouble(now: Snapshot, patience_s: float, hung: str = "") -> str:
    """In words, what is wrong; empty where all is well. patience_s: no result for longer is wrong."""
    if hung:
        return hung
    return f"no result for {_span(now.idle_s)}" if now.idle_s > patience_s else ""


def health_json(state: Mapping[str, Any], trouble: str) -> str:
    """The state of the run, and whether it is as it should be."""
    return json.dumps(_finite({"ok": not trouble, "trouble": trouble, **state}), indent=2) + "\n"


def _finite(value: Any) -> Any:
    """Numbers that JSON does not have are null."""
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
