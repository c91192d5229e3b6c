"""Measure events at zones, from rendered video with known truth. Needs no data.

python eval/zone_events.py      precision and recall of entering, leaving and crossing, and the error of counts

Each run of a scenario has random zones on the ways of its crowds and cars: rectangles with sides of 6 to 20 m, and
lines of 10 to 30 m. In a true event, a target's place was at least 0.5 m on one side of the border and is at least
0.5 m on the other side afterwards, and the picture shows at least 6 px of the target. Smaller motion across a border is
neither missed nor false, because places are not known better. A crowd's place is the mean of its people's places. It
does not count while people join or leave. A found event is right if a true event of the same kind is at the same zone
within 3 s. Each event counts once. In the row of targets apart, true events of targets within 3 m of another target
(which form one crowd with it) and the matching found events do not count. Counts over time are the numbers of targets
inside an area at each look, by the events. Their error is the sum of all differences divided by the sum of the true
numbers. --cache FILE keeps finished cases.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import bench
import cv2
import numpy as np
from bench import Spread

from torchvision_dddas import geometry
from torchvision_dddas.config import load_config
from torchvision_dddas.control import StartedSource
from torchvision_dddas.geo import Zones
from torchvision_dddas.io.output import ZoneCounts
from torchvision_dddas.lab.simulation import SimulatorSource, load_scenario, scenario_settings
from torchvision_dddas.pipeline import Pipeline, assemble_mission
from torchvision_dddas.tracking.tracker import without_picture
from torchvision_dddas.types import FrameResult, Positions, Tracks, Truth, ZoneEvent

TRUE, APART = "all, by true places", "all, targets apart"
KINDS = ("enter", "leave", "cross")
WITHIN_S, FEWEST_PX, NOISE_M = 3.0, 6, 0.15
CLEAR_M, JOIN_M = 0.5, 3.0
"""CLEAR_M: least distance from a border after passing it. JOIN_M: `crowds.join_m` of simulated teams."""

Case = dict[str, Any]
Ways = dict[int, list[tuple[float, np.ndarray, int, bool]]]
"""{target: records while it is in the picture}: time, place in metres of the world, number of bodies, and whether all
other targets are more than JOIN_M away."""
Crowds = list[tuple[float, dict[int, int]]]
"""Times, and {person number: true crowd} at each time."""


def measure(options: bench.Options) -> tuple[str, Any]:
    """Measure precision and recall of events, and the error of counts, by scenario.

    --every: process every frame instead of the frames that the feedback loop chooses.
    """
    cases = [
        {"scenario": name, "seed": seed, "every": options.every}
        for name in options.scenarios
        for seed in range(options.first, options.first + options.seeds)
    ]
    results = bench.run_cases(cases, watch, options.jobs, options.cache)
    rows = []
    for name in (*options.scenarios, "all", APART, TRUE):
        key = "true" if name == TRUE else "run"
        of = [r[key] for case, r in zip(cases, results, strict=True) if name in (case["scenario"], "all", APART, TRUE)]
        cells = []
        for kind in KINDS:
            right, found, true = np.sum([one[kind + " apart" * (name == APART)] for one in of], axis=0).tolist()
            cells += [f"{right / max(found, 1):.2f} ({found})", f"{right / max(true, 1):.2f} ({true})"]
        for key in ("counts", "inside"):
            off, true = np.sum([one[key] for one in of], axis=0).tolist()
            cells.append(f"{100 * off / max(true, 1):.0f} % ({true})")
        late = Spread([abs(s) for one in of for s in one["late_s"]])
        rows.append([name, *cells, late.text(2, spread=False)])
    head = ["scenario", *(f"{kind}: {what}" for kind in KINDS for what in ("precision", "recall"))]
    text = bench.format_table([*head, "error of counts", "of counts over time", "off in time, s"], rows)
    seeds = f"seeds {options.first} to {options.first + options.seeds - 1}"
    looks = "every frame" if options.every else "the frames that the feedback loop chooses"
    return (
        f"{text}\n\nBy {looks}; {seeds}; numbers of events and of targets in brackets.",
        results,
    )


def watch(case: Case) -> Case:
    """Return `run`: the figures of a run from video, and `true`: those of true places, as in `place_truly`.

    The figures are the numbers of right, found and true events of each kind, the errors of counts, and errors of times.
    """
    results, ways, origin, _ = fly(case)
    there = place_truly(results, ways, origin, np.random.default_rng(case["seed"]))
    return {"run": score(results, ways, origin, case["seed"]), "true": score(there, ways, origin, case["seed"])}


def place_truly(
    results: list[FrameResult], ways: Ways, origin: tuple[float, float], rng: np.random.Generator
) -> list[FrameResult]:
    """Return the looks as if every target was found and kept its identity. Places have NOISE_M of noise per axis."""
    placed = []
    for result in results:
        assert result.locations is not None
        time_s = result.locations.time_s
        at = [(n, place) for n, way in ways.items() for when_s, place, *_ in way if abs(when_s - time_s) < 0.02]
        count, frame = len(at), np.full(len(at), result.number)
        place = np.reshape([one[1] for one in at], (count, 2)) + rng.normal(0, NOISE_M, (count, 2))
        target, ones = np.array([one[0] for one in at], np.int64), np.ones(count)
        own_m2 = np.tile(NOISE_M**2 * np.eye(2), (count, 1, 1))
        where = Positions(frame, target, place, own_m2, ones, origin, geometry.lonlat(place, origin))
        tracks = Tracks(result.number, target, np.tile([0.0, 0, 4, 8], (count, 1)), ones, np.arange(count))
        unknown = np.full((count, 2), np.nan)
        located = replace(result.locations, positions=where, relative_m2=own_m2, velocity_m_s=unknown)
        placed.append(replace(result, tracked=replace(result.tracked, tracks=tracks), locations=located))
    return placed


def fly(case: Case) -> tuple[list[FrameResult], Ways, tuple[float, float], Crowds]:
    """Run a shipped scenario as `dddas run sim:NAME` does. Return results without pictures, and the truth."""
    cv2.setNumThreads(1)
    scenario = load_scenario(case["scenario"], (), case["seed"])
    own = scenario_settings(scenario)
    own.setdefault("landmarks.common_sigma_m", scenario.gps.common_m)
    if case.get("every"):
        own["steering.sampling"] = False
    source = SimulatorSource(scenario, case["scenario"])
    started: Any = StartedSource(source)
    ready = assemble_mission(
        started, load_config(None, (), base=own), "onboard", scenario.clip.located_by == "landmarks"
    )
    results, ways, crowds = [], defaultdict(list), []
    for result in Pipeline.from_assembly(ready)(started):
        for truth in source.truths():
            _add_truth(ways, truth)
            people = truth.bodies.kind == "person"
            crowds.append(
                (
                    truth.time_s,
                    dict(zip(truth.bodies.number[people].tolist(), truth.bodies.target[people].tolist(), strict=True)),
                )
            )
        frame = None if result.frame is None else without_picture(result.frame)
        results.append(replace(result, tracked=replace(result.tracked, frame=frame)))
    return results, ways, source.origin_deg, crowds


def _add_truth(ways: Ways, truth: Truth) -> None:
    bodies, shown = truth.bodies, np.bincount(truth.mask.ravel())
    here = {}
    for target in np.unique(bodies.target[bodies.kind != "ugv"]).tolist():
        if target < len(shown) and shown[target] >= FEWEST_PX:
            own = np.asarray(bodies.place_m, float)[bodies.target == target, :2]
            here[target] = own.mean(axis=0), float(np.hypot(*(own - own.mean(axis=0)).T).max()), len(own)
    for target, (place, radius, count) in here.items():
        gaps = [np.hypot(*(place - other)) - radius - r for n, (other, r, _) in here.items() if n != target]
        ways[target].append((truth.time_s, place, count, min(gaps, default=np.inf) > JOIN_M))


def score(results: list[FrameResult], ways: Ways, origin: tuple[float, float], seed: int, number: int = 10) -> Case:
    """Return the figures of a run with `number` random areas and as many lines."""
    rng = np.random.default_rng(seed)
    at = np.array([place for way in ways.values() for _, place, *_ in way])
    shapes: dict[str, np.ndarray] = {}
    for k in range(2 * number):
        turn, middle = rng.uniform(0, 2 * np.pi), at[rng.integers(len(at))] + rng.normal(0, 4, 2)
        half = rng.uniform(3, 10, 2) if k < number else (rng.uniform(5, 15), 0.0)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]] if k < number else [[-1, 0], [1, 0]]) * half
        shapes[f"{k}"] = corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + middle
    degrees = {name: geometry.lonlat(shape, origin) for name, shape in shapes.items()}
    areas, lines = ({n: d for n, d in degrees.items() if (int(n) < number) == is_area} for is_area in (True, False))
    zones = Zones(polygons=areas, lines=lines)
    counts, found, told = ZoneCounts(zones.zones), [], []
    for result in results:
        events = zones.update(result)
        counts.add(events)
        found += [(e.zone, e.kind, e.direction, e.time_s) for e in events if e.kind in KINDS]
        told += [e for e in events if e.zone in areas and e.kind != "dwell"]
    true, there = [], []
    for name, shape in shapes.items():
        own, targets = _true_events(ways, shape, int(name) < number)
        true += [(name, *event) for event in own]
        there.append((counts.rows[name]["targets"], targets))
    grazes = [t for t in true if not t[5]]
    true = [t for t in true if t[5]]
    figures: Case = {kind: [0, sum(f[1] == kind for f in found), sum(t[1] == kind for t in true)] for kind in KINDS}
    figures |= {f"{kind} apart": [0, 0, sum(t[1] == kind and t[4] for t in true)] for kind in KINDS}
    shared = dict.fromkeys(KINDS, 0)
    late = []
    pairs = [(abs(f[3] - t[3]), i, j) for i, f in enumerate(found) for j, t in enumerate(true) if f[:3] == t[:3]]
    taken: tuple[set[int], set[int]] = set(), set()
    for apart, i, j in sorted(pairs):
        if apart <= WITHIN_S and i not in taken[0] and j not in taken[1]:
            taken[0].add(i)
            taken[1].add(j)
            kind = found[i][1]
            figures[kind][0] += 1
            figures[f"{kind} apart"][0] += true[j][4]
            shared[kind] += not true[j][4]
            late.append(found[i][3] - true[j][3])
    for i, f in enumerate(found):
        graze = next((t for t in grazes if f[:3] == t[:3] and abs(f[3] - t[3]) <= WITHIN_S), None)
        if i not in taken[0] and graze is not None:
            grazes.remove(graze)
            figures[f[1]][1] -= 1
    for kind in KINDS:
        figures[f"{kind} apart"][1] = figures[kind][1] - shared[kind]
    off = sum(abs(a - b) for a, b in there)
    return {
        **figures,
        "counts": [off, sum(b for _, b in there)],
        "inside": _count_inside(results, told, ways, shapes, areas),
        "late_s": late,
    }


def _count_inside(
    results: list[FrameResult],
    told: list[ZoneEvent],
    ways: Ways,
    shapes: dict[str, np.ndarray],
    areas: Iterable[str],
) -> tuple[int, int]:
    """Return the sum over all looks of the errors of counts inside the areas, and of the true counts."""
    off = count = 0
    for result in results:
        assert result.locations is not None
        now, here = result.locations.time_s, result.tracks.identity.tolist()
        last = {(e.zone, e.target): e.kind != "leave" for e in sorted(told, key=lambda e: e.time_s) if e.time_s <= now}
        places = [place for way in ways.values() for when_s, place, *_ in way if abs(when_s - now) < 0.02]
        for name in areas:
            edges = geometry.edges_of([shapes[name]], closed=True)
            true = int(geometry.is_inside(np.reshape(places, (-1, 2)), edges).sum())
            off, count = off + abs(sum(last.get((name, n), False) for n in here) - true), count + true
    return off, count


def _true_events(ways: Ways, shape: np.ndarray, is_area: bool) -> tuple[list[tuple[str, str, float, bool, bool]], int]:
    """Return the true events at a zone: kind, direction, time, whether the target was apart and passed clearly.

    Also return the number of targets that were clearly at the zone.
    """
    edges, events, count = geometry.edges_of([shape], closed=is_area), [], 0
    for way in ways.values():
        places = np.array([place for _, place, *_ in way])
        far = np.hypot(*(geometry.nearest_on(places, edges) - places).T) >= CLEAR_M
        inside = geometry.is_inside(places, edges) if is_area else np.zeros(len(way), bool)
        own, net, passed, side = [], 0, None, None
        for k, (before, now) in enumerate(pairwise([(way[0][0], places[0], *way[0][2:]), *way])):
            crossed, _ = geometry.crossings(before[1], now[1], edges)
            if before[2] != now[2] or now[0] - before[0] > 1.0:  # people joined or left, or the target was away
                net, passed, side = 0, None, None
            elif crossed:
                net, passed = net + crossed, (now[0], before[3] and now[3])
                kinds = ("cross", "to_right" if crossed > 0 else "to_left") if not is_area else ("leave", "")
                events.append((*(("enter", "") if inside[k] else kinds), *passed, False))
            if not far[k]:
                continue
            if side is not None and passed and (side != inside[k] if is_area else net):
                own.append((*events.pop()[:2], *passed, True))
            net, side = 0, inside[k]
        events += own
        count += bool((inside & far).any()) if is_area else bool(own)
    return events, count


if __name__ == "__main__":
    scenarios = ["joining", "splitting", "crossing", "movers"]
    options = {"--scenarios": scenarios, "--first": 30, "--seeds": 5, "--every": False, "--jobs": 1, "--cache": None}
    bench.main(__doc__, {"": (measure, options)})
