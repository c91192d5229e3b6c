"""Tables of geo_error.py, in Markdown."""

from typing import Any

import numpy as np

Row = dict[str, Any]


def main_table(rows: list[Row]) -> str:
    """A row a case."""
    ways = ["crowd (bound)", "disc (bound)", "its median", "in ellipses"]
    ways = [f"{method}: {ways[0]}" if k == 0 else ways[k] for method in ("pose", "homography") for k in range(4)]
    lines = heading("layout | GPS of landmarks", "n | AGL m | pixels | tilt | " + " | ".join(ways))
    for row in rows:
        cells = [row["layout"], row["gps"], row["landmarks"], f"{row['altitude_m']:.0f}"]
        cells += [f"{row['pixel_sigma']:g}", f"{row['tilt_deg']:.0f}°"]
        for method in ("pose", "homography"):
            crowd, disc = row[method]["crowd"], row[method]["disc"]
            cells += [f"{metres(part['mean'])} ({metres(part['bound'])})" for part in (crowd, disc)]
            cells += [metres(disc["median"]), percent((crowd["inside"] + disc["inside"]) / 2)]
        lines.append(line(cells))
    return "\n".join(lines)


def paper_table(rows: list[Row]) -> str:
    """What raw degrees do."""
    lines = heading("GPS", "n | AGL m | pose | homography in metres | raw degrees: mean | median | places told")
    for row in rows:
        if "paper" in row and row["pixel_sigma"] == 1:
            raw = row["paper"]["disc"]
            errors = [row["pose"]["disc"]["mean"], row["homography"]["disc"]["mean"], raw["mean"], raw["median"]]
            cells = [row["gps"], row["landmarks"], f"{row['altitude_m']:.0f}", *map(metres, errors)]
            lines.append(line([*cells, percent(raw["answered"])]))
    return "\n".join(lines)


def six_table(rows: list[Row]) -> str:
    """What six landmarks gain."""
    few = ("four of them", "four by themselves")
    lines = heading(
        "layout | GPS",
        "pose: six | four of them | six − four | four by themselves | six − four | homography's median: six of four",
    )
    for row in rows:
        cells = [row["layout"], row["gps"], metres(row[f"pose, {few[0]}"]["six"])]
        for part in (row[f"pose, {name}"] for name in few):
            cells += [metres(part["four"]), f"{part['difference']:+.3f} ± {part['error']:.3f}"]
        ratio = row[f"homography, {few[0]}"]["ratio of medians"]
        lines.append(line([*cells, "–" if np.isnan(ratio) else f"{ratio:.2f}"]))
    return "\n".join(lines)


def fault_table(rows: list[Row]) -> str:
    """What tests of the landmarks find and mend."""
    lines = heading(
        "fault | GPS",
        "n | AGL m | homography, untested: mean (median) | pose, untested | flagged | found out | pose: mean (median) "
        "| its crowd | in ellipses",
    )
    for row in rows:
        told = {"none": "–", "swap": f"{percent(row['found'])} swapped back"}
        cells = [row["fault"], row["gps"], row["landmarks"], f"{row['altitude_m']:.0f}"]
        pairs = [f"{metres(row[k][0])} ({metres(row[k][1])})" for k in ("homography", "before", "after")]
        found = told.get(row["fault"], f"{percent(row['found'])} that alone")
        cells += [*pairs[:2], percent(row["flagged"]), found, pairs[2], metres(row["crowd"]), percent(row["inside"])]
        lines.append(line(cells))
    return "\n".join(lines)


def common_table(rows: list[Row]) -> str:
    """What is told of places on the Earth and of places relative to the team."""
    lines = heading("GPS beside it", "n | relative to the team | in ellipses | on the Earth | in ellipses")
    for row in rows:
        parts = (row["relative"], row["absolute"])
        told = [cell for part in parts for cell in (metres(part["mean"]), percent(part["inside"]))]
        lines.append(line([row["gps"], row["landmarks"], *told]))
    return "\n".join(lines)


def time_table(rows: list[Row]) -> str:
    """What memory of earlier frames gains."""
    lines = heading(
        "GPS",
        "n | errors of telemetry, receivers alike over | flights | single frames: mean (median) | in ellipses "
        "| over time: mean (median) | in ellipses | over time − single",
    )
    for row in rows:
        alike = ", ".join("no time" if one < 0.01 else f"{one:g} s" for one in row["alike_s"])
        cells = [row["gps"], row["landmarks"], alike, row["flights"]]
        for part in (row["single frames"], row["over time"]):
            cells += [f"{metres(part['mean'])} ({metres(part['median'])})", percent(part["inside"])]
        lines.append(line([*cells, f"{row['gain'][0]:+.3f} ± {row['gain'][1]:.3f}"]))
    return "\n".join(lines)


def heading(words: str, numbers: str) -> list[str]:
    """The first two lines: columns of words to the left, of numbers to the right."""
    left, right = words.count("|") + 1, numbers.count("|") + 1
    return [f"| {words} | {numbers} |", "|" + " --- |" * left + " ---: |" * right]


def line(cells: list[object]) -> str:
    """A row."""
    return f"| {' | '.join(map(str, cells))} |"


def percent(share: float) -> str:
    """With a digit."""
    return "–" if np.isnan(share) else f"{100 * share:.1f} %"


def metres(value: float) -> str:
    """No more digits than are worth telling."""
    if not np.isfinite(value):
        return "–"
    return f"{value:.3f}" if value < 0.3 else f"{value:.2f}" if value < 10 else f"{value:.0f}"
