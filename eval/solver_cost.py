"""What the assignment solvers cost, and how far from the best they stop, against the number of targets.

usage: python eval/solver_cost.py [DATA] [--sparse 10 30 100 ...] [--dense 10 30 100 ...] [--windows 20]
                                  [--json FILE] [--markdown FILE] [--plot FILE]

Sparse: people who walk, half of them in groups, 0.2 to a square of their height; tracks with and without a velocity,
one in twenty missed, false boxes. Links within a gate score as a log-likelihood; columns (i, j, k) are what is left.
Dense: the source's tensors: generalised Jaccard of box centres in pixels and of histograms, dummies gated at 0.4, the
weight of the location 1, 0.7, 0.5 and 0.3 in turn. DATA: a folder of sequences with gt/gt.txt (MOTChallenge text); from
their boxes, five frames apart, come windows of both kinds (dense: location alone).
Times are medians and the 90th percentile over windows, by the clock and by the processor: a busy machine makes the
clock's longer. "HiGHS alone" is the same sparse problem as one integer programme.
"""

import argparse
import itertools
import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from footage import sequences, truth_of
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csc_array

from torchvision_dddas.tracking.assignment import choose_triplets
from torchvision_dddas.tracking.dual_ascent import assign_triplets

INTERVAL = 5
THRESHOLD = 0.4
WEIGHTS = (1.0, 0.7, 0.5, 0.3)
Window = tuple[np.ndarray, np.ndarray]


def link(distance2: np.ndarray, variance: np.ndarray | float) -> np.ndarray:
    """Score of a link: log-likelihood of a heavy-tailed distance (in heights) against being new."""
    return -3 * np.log1p(distance2 / variance / 4) - np.log(2 * np.pi * variance) - np.log(0.6) + 4


def apart2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None] - b[None]) ** 2).sum(axis=-1)


def columns_of(
    place: np.ndarray, velocity: np.ndarray, settled: np.ndarray, now: np.ndarray, later: np.ndarray
) -> Window:
    """The columns that a gate leaves, and their scores: tracks, boxes now and an interval later, in heights."""
    error = np.where(settled, 0.015, 0.07)[:, None] * INTERVAL
    first = link(apart2(place + INTERVAL * velocity, now), 2 * 0.06**2 + error**2)
    birth = 0.7 * link(apart2(now, later), 2 * 0.06**2 + (0.07 * INTERVAL) ** 2)
    over = 0.7 * (link(apart2(place + 2 * INTERVAL * velocity, later), 2 * 0.06**2 + 4 * error**2) - 0.85)
    i, j = np.nonzero(first > -2)
    learned = np.where(settled[i], 0.6, 0.95)[:, None] * (now[j] - place[i] - INTERVAL * velocity[i]) / INTERVAL
    second = link(apart2(now[j] + INTERVAL * (velocity[i] + learned), later), np.where(settled[i], 0.03, 0.06)[:, None])
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


def affinity(features: list[np.ndarray]) -> np.ndarray:
    """The source's tensor of three frames (appendix C, eq. 4, 5), with its gated dummies."""
    (low1, high1), (low2, high2) = (
        (np.minimum(a[:, None], b).sum(axis=-1), np.maximum(a[:, None], b).sum(axis=-1))
        for a, b in itertools.pairwise(features)
    )
    real = (low1[:, :, None] + low2) / (high1[:, :, None] + high2)
    tensor = np.pad(real, ((1, 0),) * 3)
    for axis in range(3):
        face = [slice(1, None)] * 3
        face[axis] = 0
        tensor[tuple(face)] = np.where(real.max(axis=axis, initial=0.0) < 1 - THRESHOLD, 1 - THRESHOLD, 0.0)
    return tensor


def dense_window(targets: int, seed: int) -> np.ndarray:
    """A tensor of people who walk 15 px an interval in 768×576; Jaccard of true histograms 0.7, of others 0.4."""
    random = np.random.default_rng(seed)
    size = (768, 576)
    place, velocity = random.uniform((40, 60), (728, 566), (targets, 2)), random.normal(0, 15, (targets, 2))
    common = random.dirichlet(np.full(256, 0.5), 3)

    def histogram() -> np.ndarray:
        return 0.35 * random.dirichlet(np.full(256, 0.1), 3) + 0.65 * common

    own = [histogram() for _ in range(targets)]
    places, histograms = [], []
    for look in range(3):
        at = np.clip(place + look * velocity + random.normal(0, 2, (targets, 2)), 1, size)
        kept = np.flatnonzero(random.random(targets) < 0.95)
        false = random.poisson(0.03 * targets)
        drawn = [own[i] for i in kept] + [histogram() for _ in range(false)]
        bins = [np.stack([random.multinomial(1600, row / row.sum()) for row in rows]).ravel() for rows in drawn]
        mixed = random.permutation(len(drawn))
        places.append(np.concatenate([at[kept], random.uniform((1, 1), size, (false, 2))])[mixed])
        histograms.append(np.array(bins, float).reshape(-1, 768)[mixed])
    weight = WEIGHTS[seed % len(WEIGHTS)]
    return weight * affinity(places) + (1 - weight) * affinity(histograms)


def real_windows(folder: Path, most: int) -> Iterator[tuple[Window, np.ndarray]]:
    """Both kinds of windows from the true boxes of a sequence, spread over it."""
    table = truth_of(folder).tracks
    assert table is not None
    frames = {
        frame: dict(zip(here.identity.tolist(), here.box_px, strict=True))
        for frame in np.unique(table.frame).tolist()
        for here in [table.at(table.frame == frame)]
    }
    starts = [f for f in frames if all(f + look * INTERVAL in frames for look in (-1, 1, 2))]
    for start in starts[:: max(len(starts) // most, 1)][:most]:
        before, *looks = (frames[start + look * INTERVAL] for look in (-1, 0, 1, 2))
        centre = [np.array([box[:2] + box[2:] / 2 for box in look.values()]) for look in looks]
        height = np.median([box[3] for box in looks[0].values()])
        settled = np.array([name in before for name in looks[0]])
        old = np.array([before.get(name, box)[:2] + before.get(name, box)[2:] / 2 for name, box in looks[0].items()])
        velocity = (centre[0] - old) / INTERVAL / height
        scaled = [place / height for place in centre]
        yield columns_of(scaled[0], velocity, settled, *scaled[1:]), affinity([np.maximum(c, 0) for c in centre])


def alone(window: Window) -> float:
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


def timed(call: Callable) -> tuple[float, float, object]:
    """Milliseconds by the clock and by the processor, and what came back."""
    clock, processor = time.perf_counter(), time.process_time()
    result = call()
    return (time.perf_counter() - clock) * 1e3, (time.process_time() - processor) * 1e3, result


def row(kind: str, targets: float, solver: str, times: list, **more: float) -> dict:
    clock, processor = np.array(times).T
    entry = {"windows": kind, "targets": round(targets), "solver": solver, **more, "runs": len(times)}
    for name, values in (("clock", clock), ("processor", processor)):
        entry |= {f"{name}_ms": float(np.median(values)), f"{name}_p90_ms": float(np.quantile(values, 0.9))}
    print(
        "{windows:14} {targets:4} {solver:12} clock {clock_ms:7.2f} ({clock_p90_ms:7.2f}) "
        "processor {processor_ms:7.2f} ({processor_p90_ms:7.2f}) ms".format(**entry),
        {key: round(value, 3) for key, value in more.items()},
        flush=True,
    )
    return entry


def measure_sparse(kind: str, targets: float, windows: list[Window], beside: bool) -> list[dict]:
    ours, theirs, wrong = [], [], 0.0
    for window in windows:
        *spent, chosen = timed(lambda window=window: choose_triplets(*window)[0])
        ours.append(spent)
        if beside:
            *spent, best = timed(lambda window=window: alone(window))
            theirs.append(spent)
            wrong = max(wrong, abs(best - window[1][chosen].sum()))
    each = float(np.median([len(window[1]) for window in windows])) / max(targets, 1)
    rows = [row(kind, targets, "columns", ours, columns_a_target=each)]
    return rows + ([row(kind, targets, "HiGHS alone", theirs, largest_difference=wrong)] if beside else [])


def measure_dense(kind: str, targets: float, windows: list[np.ndarray], gap: float) -> list[dict]:
    times, gaps, exact = [], [], 0
    for window in windows:
        *spent, solved = timed(lambda window=window: assign_triplets(window, gap=gap))
        times.append(spent)
        gaps.append(100 * solved.gap)
        exact += solved.exact
    more = {
        "gap_percent": float(np.median(gaps)),
        "worst_gap_percent": max(gaps),
        "exact_percent": 100 * exact / len(gaps),
    }
    return [row(kind, targets, f"gap {100 * gap:g} %", times, **more)]


def plot(rows: list[dict], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
    simulated = [entry for entry in rows if entry["windows"].startswith("simulated")]
    for name in dict.fromkeys((entry["windows"], entry["solver"]) for entry in simulated):
        line = [entry for entry in simulated if (entry["windows"], entry["solver"]) == name]
        x = [entry["targets"] for entry in line]
        left.plot(x, [entry["processor_ms"] for entry in line], marker="o", label=", ".join(name))
        left.fill_between(
            x, [entry["processor_ms"] for entry in line], [entry["processor_p90_ms"] for entry in line], alpha=0.2
        )
        if "gap_percent" in line[0]:
            right.plot(x, [entry["gap_percent"] for entry in line], marker="o", label="median")
            right.plot(x, [entry["worst_gap_percent"] for entry in line], marker="x", label="worst")
    left.set(xscale="log", yscale="log", xlabel="targets", ylabel="processor time a window, ms", title="cost")
    right.set(xscale="log", xlabel="targets", ylabel="certified gap, %", title="dense: gap asked for: 0.5 %")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measure, print a line a row, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--sparse", type=int, nargs="*", default=[3, 10, 30, 50, 100, 200, 350, 500])
    parser.add_argument("--dense", type=int, nargs="*", default=[3, 10, 20, 30, 50, 70, 100, 150])
    parser.add_argument("--windows", type=int, default=20)
    parser.add_argument("--gap", type=float, default=0.005)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    choose_triplets(*sparse_window(10, 0))
    rows = []
    for targets in options.sparse:
        windows = [sparse_window(targets, seed) for seed in range(options.windows)]
        rows += measure_sparse("simulated", targets, windows, beside=True)
    for targets in options.dense:
        tensors = [dense_window(targets, seed) for seed in range(options.windows)]
        rows += measure_dense("simulated dense", targets, tensors, options.gap)
    for folder in sequences(options.data) if options.data else []:
        both = list(real_windows(folder, options.windows))
        if both:
            targets = float(np.median([tensor.shape[0] - 1 for _, tensor in both]))
            rows += measure_sparse(folder.name, targets, [window for window, _ in both], beside=False)
            rows += measure_dense(folder.name, targets, [tensor for _, tensor in both], options.gap)
    if options.data is None:
        print("no DATA: simulated windows only")
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    if options.json:
        options.json.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n", encoding="utf-8")
    if options.markdown:
        lines = [
            "| windows | targets | solver | ms, median (p90) | gap %, median (worst) |",
            "| --- | --- | --- | --- | --- |",
        ]
        for entry in rows:
            gap = "{gap_percent:.2f} ({worst_gap_percent:.2f})".format(**entry) if "gap_percent" in entry else "–"
            lines.append(
                "| {windows} | {targets} | {solver} | {processor_ms:.1f} ({processor_p90_ms:.1f})".format(**entry)
                + f" | {gap} |"
            )
        text = "\n".join([*lines, "", f"Processor time on {machine}, {options.windows} windows a row."])
        options.markdown.write_text(text + "\n", encoding="utf-8")
    if options.plot:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
