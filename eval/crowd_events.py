"""Measure the accuracy of crowd events, from rendered video with known truth. Needs no data.

python eval/crowd_events.py     precision and recall of joining, splitting, gathering and scattering, by scenario

The true time of joining or splitting is the time of the simulator's event. The crowds may stand or walk side by side
long before or after it. A found event is therefore right if a true event of its kind is within 12 s. Each event counts
once. Crowds that are not in the picture within these 12 s do not count. Three or more crowds that join or split within
5 s also gather or scatter. --cache FILE keeps finished cases.
"""

from collections import defaultdict
from itertools import pairwise
from typing import Any

import bench
import numpy as np
from zone_events import Case, Crowds, Ways, fly

KINDS = ("join", "split", "gather", "scatter")
WITHIN_S, AT_ONCE_S = 12.0, 5.0


def measure(options: bench.Options) -> tuple[str, Any]:
    """Measure precision and recall of the events of crowds, by scenario."""
    seeds = range(options.first, options.first + options.seeds)
    cases = [{"scenario": name, "seed": seed} for name in options.scenarios for seed in seeds]
    results = bench.run_cases(cases, watch, options.jobs, options.cache)
    rows = []
    for name in (*options.scenarios, "all"):
        of = [r for case, r in zip(cases, results, strict=True) if name in (case["scenario"], "all")]
        cells = []
        for kind in KINDS:
            right, found, true = np.sum([one[kind] for one in of], axis=0).tolist()
            cells += [f"{right / count:.2f} ({count})" if count else "-" for count in (found, true)]
        rows.append([name, *cells])
    head = ["scenario", *(f"{kind}: {what}" for kind in KINDS for what in ("precision", "recall"))]
    return (
        f"{bench.format_table(head, rows)}\n\nSeeds {seeds[0]} to {seeds[-1]}; numbers of events in brackets.",
        results,
    )


def watch(case: Case) -> Case:
    """Return, for each kind of event, the numbers of right, found and true events."""
    results, ways, _, crowds = fly(case)
    found = [(event.kind, event.time_s) for result in results for event in result.events]
    true = true_events(crowds, ways)
    figures: Case = {}
    for kind in KINDS:
        of, there = ([when for k, when in events if k == kind] for events in (found, true))
        apart = [(abs(a - b), i, j) for i, a in enumerate(of) for j, b in enumerate(there)]
        taken: tuple[set[int], set[int]] = set(), set()
        for gap_s, i, j in sorted(apart):
            if gap_s <= WITHIN_S and i not in taken[0] and j not in taken[1]:
                taken[0].add(i)
                taken[1].add(j)
        figures[kind] = [len(taken[0]), len(of), len(there)]
    return {**figures, "found": found, "true": true}


def true_events(crowds: Crowds, ways: Ways) -> list[tuple[str, float]]:
    """Return the kind and time of true events of crowds that are in the picture."""
    events, many = [], defaultdict(list)
    for (_, before), (time_s, now) in pairwise(crowds):
        moved = {(before[n], crowd) for n, crowd in now.items() if before.get(n, crowd) != crowd}
        for old, new in moved:
            kind = "join" if new in before.values() else "split"
            other, host = (old, new) if kind == "join" else (new, old)
            shown = [any(abs(when - time_s) <= WITHIN_S for when, *_ in ways.get(one, ())) for one in (other, host)]
            if all(shown):
                events.append((kind, time_s))
                many[kind, host].append(time_s)
    for (kind, _), times in many.items():
        if len(times) > 1 and times[1] - times[0] <= AT_ONCE_S:
            events.append(({"join": "gather", "split": "scatter"}[kind], times[0]))
    return events


if __name__ == "__main__":
    scenarios = ["joining", "splitting", "crossing", "scattering"]
    bench.main(
        __doc__, {"": (measure, {"--scenarios": scenarios, "--first": 30, "--seeds": 5, "--jobs": 1, "--cache": None})}
    )
