"""What the assignment solvers cost, and how far from the best they stop, against the number of targets.

python eval/solver_cost.py [--windows 20]

Sparse: people who walk, half of them in groups, 0.2 to a square of their height; tracks with and without a velocity,
one in twenty missed, false boxes. Links within a gate score as a log-likelihood; columns (i, j, k) are what is left.
"HiGHS alone" is the same problem as one integer programme.
Milliseconds of processor time a window: median (90th percentile).
"""

from collections.abc import Callable
from typing import Any

import bench
import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csc_array

from torchvision_dddas.tracking.assignment import choose_triplets

INTERVAL = 5
Window = tuple[np.ndarray, np.ndarray]
"""Columns (N, 3) of rows in three frames, -1 where there is none, and their scores."""


def measure_cost(options: bench.Options) -> tuple[str, Any]:
    """Time the solvers on simulated windows and on those of DATA."""
    choose_triplets(*sparse_window(10, 0))
    found: list[dict[str, Any]] = []
    for targets in options.sparse:
        found += time_sparse("simulated", targets, [sparse_window(targets, k) for k in range(options.windows)])
    rows = []
    for row in found:
        gap = f"{row['gap_percent']:.2f} ({row['worst_gap_percent']:.2f})" if "gap_percent" in row else "–"
        time = f"{row['ms']:.1f} ({row['p90_ms']:.1f})"
        rows.append([row["windows"], row["solver"], row["targets"], time, gap])
    simulated = [row for row in found if row["windows"].startswith("simulated")]
    lines = {}
    for name in dict.fromkeys((row["windows"], row["solver"]) for row in simulated):
        line = [row for row in simulated if (row["windows"], row["solver"]) == name]
        lines[", ".join(name)] = {"x": [row["targets"] for row in line], "y": [row["ms"] for row in line]}
    panel = {"xlabel": "targets", "ylabel": "processor time a window, ms", "xscale": "log", "yscale": "log"}
    bench.draw(options.plot, [panel | {"lines": lines}])
    head = ["windows", "solver", "targets", "ms (90 %)", "gap %, median (worst)"]
    return bench.format_table(head, rows, words=2), found


def time_sparse(kind: str, targets: int, windows: list[Window]) -> list[dict[str, Any]]:
    """Our solver beside HiGHS alone, and the largest difference of their sums."""
    ours, theirs, difference = [], [], 0.0
    for window in windows:
        spent, chosen = timed(lambda w=window: choose_triplets(*w))
        ours.append(spent)
        spent, best = timed(lambda w=window: solve_alone(w))
        theirs.append(spent)
        difference = max(difference, abs(best - window[1][chosen].sum()))
    about = {"windows": kind, "targets": targets, "largest_difference": difference}
    return [about | {"solver": "columns", **summary(ours)}, about | {"solver": "HiGHS alone", **summary(theirs)}]


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Milliseconds of processor time, and what came back."""
    start = bench.now()[1]
    result = call()
    return 1e3 * float(bench.now()[1] - start), result


def summary(times: list[float]) -> dict[str, float]:
    """Median and 90th percentile."""
    return {"ms": float(np.median(times)), "p90_ms": float(np.quantile(times, 0.9))}


def solve_alone(window: Window) -> float:
    """The best sum by HiGHS, without anything of ours."""
    columns, score = window
    there = columns >= 0
    known, nodes = np.unique((columns * 3 + np.arange(3))[there], return_inverse=True)
    start = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    held = csc_array((np.ones(len(nodes)), nodes, start), shape=(len(known), len(columns)))
    return -milp(
        -score,
        constraints=LinearConstraint(held, ub=1.0),
        integrality=np.ones(len(score), int),
        bounds=Bounds(0, 1),
        options={"mip_rel_gap": 0.0},
    ).fun


def link_score(distance2: np.ndarray, variance: np.ndarray | float) -> np.ndarray:
    """Score of a link: log-likelihood of a heavy-tailed distance (in heights) against being new."""
    return -3 * np.log1p(distance2 / variance / 4) - np.log(2 * np.pi * variance) - np.log(0.6) + 4


def squared_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None] - b[None]) ** 2).sum(axis=-1)


def columns_of(
    place: np.ndarray, velocity: np.ndarray, settled: np.ndarray, now: np.ndarray, later: np.ndarray
) -> Window:
    """The columns that a gate leaves, and their scores: tracks, boxes now and an interval later, in heights."""
    error = np.where(settled, 0.015, 0.07)[:, None] * INTERVAL
    first = link_score(squared_distance(place + INTERVAL * velocity, now), 2 * 0.06**2 + error**2)
    birth = 0.7 * link_score(squared_distance(now, later), 2 * 0.06**2 + (0.07 * INTERVAL) ** 2)
    over = 0.7 * (
        link_score(squared_distance(place + 2 * INTERVAL * velocity, later), 2 * 0.06**2 + 4 * error**2) - 0.85
    )
    i, j = np.nonzero(first > -2)
    learned = np.where(settled[i], 0.6, 0.95)[:, None] * (now[j] - place[i] - INTERVAL * velocity[i]) / INTERVAL
    second = link_score(
        squared_distance(now[j] + INTERVAL * (velocity[i] + learned), later), np.where(settled[i], 0.03, 0.06)[:, None]
    )
    total = first[i, j][:, None] + 0.7 * second
    link_, k = np.nonzero((second > -2) & (total > 0))
    parts = [(np.stack([i[link_], j[link_], k], axis=1), total[link_, k])]
    for score, (a, b) in ((first, (0, 1)), (birth, (1, 2)), (over, (0, 2))):
        pair = np.argwhere(score > 0)
        columns = np.full((len(pair), 3), -1)
        columns[:, [a, b]] = pair
        parts.append((columns, score[tuple(pair.T)]))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def sparse_window(targets: int, seed: int, density: float = 0.2) -> Window:
    """Columns of a simulated crowd, `density` people to a square of their height."""
    random = np.random.default_rng(seed)
    side = np.sqrt(targets / density)
    grouped = random.random((targets, 1)) < 0.5
    group = random.integers(0, max(targets // 4, 1), targets)
    centre, drift = random.uniform(0, side, (targets, 2)), random.normal(0, 0.05, (targets, 2))
    place = np.where(grouped, centre[group] + random.normal(0, 1, (targets, 2)), random.uniform(0, side, (targets, 2)))
    velocity = np.where(
        grouped, drift[group] + random.normal(0, 0.01, (targets, 2)), random.normal(0, 0.05, (targets, 2))
    )
    settled, known = random.random(targets) < 0.7, random.random(targets) < 0.95
    seen, at, speed = [], place, velocity
    for _ in range(2):
        speed = speed + random.normal(0, 0.009 * np.sqrt(INTERVAL), (targets, 2))
        at = at + INTERVAL * speed
        kept = at[random.random(targets) < 0.95]
        false = random.uniform(0, side, (random.poisson(0.05 * targets), 2))
        seen.append(np.concatenate([kept + random.normal(0, 0.06, kept.shape), false]))
    believed = np.where(settled[:, None], velocity + random.normal(0, 0.01, velocity.shape), 0.0)
    return columns_of(place[known], believed[known], settled[known], *seen)


if __name__ == "__main__":
    options = {"--sparse": [3, 10, 30, 50, 100, 200, 350, 500]}
    options |= {"--windows": 20, "--gap": 0.005, "--plot": None}
    bench.main(__doc__, {"": (measure_cost, options)})
