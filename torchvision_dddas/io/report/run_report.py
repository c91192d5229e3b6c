"""report.html: what a run did, in one file that asks no other host for anything."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.io.report.keyframes import KeyFrame
from torchvision_dddas.io.report.page import page, picture_url
from torchvision_dddas.io.report.timeline import OverTime, Panel, plots

MOST_ROWS = 200
"""A table shows so many rows; run.json or log.txt has them all."""

FOLDED = ("scenario", "settings")
"""Facts that are too long to be seen at once."""

Table = tuple[str, Sequence[str], Sequence[Sequence[Any]], str]
"""A title, the columns' names, rows of cells, and what to say where there are none."""

_STYLE = """
:root{color-scheme:light}
body{font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif;color:#222;background:#fff;
 max-width:1160px;margin:0 auto;padding:24px}
h1{font-size:24px;margin:0 0 4px}h2{font-size:18px;margin:36px 0 10px;border-bottom:1px solid #ddd;padding-bottom:4px}
.state{color:#666;margin:0 0 20px}.state b{color:#a33}
dl.figures{display:flex;flex-wrap:wrap;gap:12px;margin:0}
dl.figures div{border:1px solid #ddd;border-radius:6px;padding:8px 14px;min-width:110px}
dl.figures dt{color:#666;font-size:13px}dl.figures dd{margin:0;font-size:21px;font-variant-numeric:tabular-nums}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:4px 12px 4px 0;border-bottom:1px solid #eee;vertical-align:top;overflow-wrap:anywhere}
th{color:#666;font-weight:600;white-space:nowrap}td:first-child{white-space:nowrap}
img,svg{width:100%;height:auto;display:block}
svg text{font-size:12px;fill:#555}svg .title{font-size:13px;font-weight:600;fill:#222}
svg .grid{stroke:#eee}svg .tick{stroke:#888;fill:none}svg .gap{fill:#c0392b;opacity:.15}
svg .curve{fill:none;stroke-width:1.6;stroke-linejoin:round}
.frames{display:flex;flex-wrap:wrap;gap:16px}
figure{margin:0;flex:1 1 320px;max-width:380px}
figcaption{font-size:13px;color:#444;margin-top:4px;overflow-wrap:anywhere}
.note{color:#666}ul{padding-left:20px}pre{background:#f6f6f6;padding:12px;overflow:auto;font-size:13px}
"""


@dataclass(frozen=True)
class Story:
    """What a report tells. All words are escaped when it is written.

    figures: names and values. facts: what was run; those of FOLDED are folded away. notes: in words.
    map_png: or as JPEG. first: tables that stand before the map. panels: plots above those of the timeline.
    """

    title: str
    state: str
    figures: Sequence[tuple[str, str]]
    facts: Mapping[str, Any]
    tables: Sequence[Table]
    notes: Sequence[str] = field(default_factory=tuple)
    map_png: bytes | None = None
    first: Sequence[Table] = ()
    pictures: Sequence[KeyFrame] = ()
    panels: Sequence[Panel] = ()


def report(story: Story, timeline: OverTime) -> str:
    """The HTML: figures, map, key frames, plots over time, tables, and what was run."""
    parts = [
        f"<h1>{escape(story.title)}</h1>",
        f'<p class="state">{escape(story.state)}</p>',
        '<dl class="figures">',
        *(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in story.figures),
        "</dl>",
    ]
    if story.notes:
        parts += ["<h2>Notes</h2>", "<ul>", *(f"<li>{escape(note)}</li>" for note in story.notes), "</ul>"]
    parts += _tables(story.first)
    if story.map_png is not None:
        parts += ["<h2>Map</h2>", f'<img alt="map of the tracks" src="{picture_url(story.map_png)}">']
    if story.pictures:
        parts += ["<h2>Key frames</h2>", '<div class="frames">', *(_figure(one) for one in story.pictures), "</div>"]
    if drawn := plots(timeline, story.panels):
        parts += ["<h2>Over time</h2>", drawn, '<p class="note">Shaded: frames in which nothing could be located.</p>']
    parts += _tables(story.tables)
    facts = {name: value for name, value in story.facts.items() if name not in FOLDED}
    parts += ["<h2>What was run</h2>", table(("what", "value"), [(name, _words(v)) for name, v in facts.items()])]
    for name in (name for name in FOLDED if name in story.facts):
        text = json.dumps(finite(story.facts[name]), indent=2)
        parts.append(f"<details><summary>{name}</summary><pre>{escape(text)}</pre></details>")
    return page(story.title, parts, _STYLE)


def _tables(tables: Sequence[Table]) -> list[str]:
    parts = []
    for title, names, rows, empty in tables:
        parts += [f"<h2>{escape(title)}</h2>", table(names, rows) if rows else f'<p class="note">{escape(empty)}</p>']
    return parts


def _figure(picture: KeyFrame) -> str:
    when = f"frame {picture.number}" + (f", {picture.time_s:.1f} s" if math.isfinite(picture.time_s) else "")
    words = f": {escape(picture.words)}" if picture.words else ""
    shown = f'<img alt="{when}" src="{picture_url(picture.jpeg)}">'
    return f"<figure>{shown}<figcaption><b>{when}</b>{words}</figcaption></figure>"


def table(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """An HTML table of the first MOST_ROWS rows, which says how many more there are."""
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = [f"<tr>{''.join(f'<td>{escape(_words(cell))}</td>' for cell in row)}</tr>" for row in rows[:MOST_ROWS]]
    more = len(rows) - MOST_ROWS
    rest = f'<p class="note">and {more} more, in the files beside this page</p>' if more > 0 else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>{rest}"


def span(first: int, last: int) -> str:
    """Frames in words."""
    return f"{first}" if first == last else f"{first} to {last}"


def _words(value: Any) -> str:
    """A value for a reader."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "unknown"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_words(v)}" for name, v in value.items())
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes)):
        return ", ".join(_words(v) for v in value)
    return str(value)
