"""Measure shared identities of two views, on simulated pairs and on real tracks seen by two simulated cameras.

python eval/views.py [SDD_FILE ...]      precision and recall of shared identities, beside two baselines

Pairs are streets with regular queues and parked cars, crowds, and tables of the Stanford Drone Dataset
(../shared/data/association/SDD-*/annotations.txt). Headings differ by up to 180 degrees. Cameras drift and turn. Two
boxes with the same identity in a frame count as found. They are right if both boxes show the same target. A pair of
views is lost if its recall is below 0.5. nearest: mutual nearest foot points by the true homography of each frame.
carried: the homography starts with the truth of the first frame and is fitted to the pairs of each frame. handed over:
targets that leave a view while the other view sees them, and keep their identity. --cache FILE keeps finished cases.
"""

import time
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
from bench import Spread
from view_scenes import View, feet, nearest_right, scene, true_map

from torchvision_dddas import geometry
from torchvision_dddas.tracking import MultiViewTracker
from torchvision_dddas.types import Tracks

WAYS = ("ours", "carried", "nearest")
Case = dict[str, Any]


def measure(options: bench.Options) -> tuple[str, Any]:
    """Measure precision and recall of shared identities, lost pairs of views, and frames per second, by scene kind."""
    kinds = ["street", "crowd", *map(str, options.files or [])]
    cases = [
        {"kind": kind, "seed": seed} for kind in kinds for seed in range(options.first, options.first + options.seeds)
    ]
    results = bench.run_cases(cases, run_case, options.jobs, options.cache)
    rows = []
    for kind in kinds:
        of = [r for case, r in zip(cases, results, strict=True) if case["kind"] == kind and r["ours"][2] > 200]
        name = kind if kind in ("street", "crowd") else Path(kind).parent.name
        for way in WAYS:
            right, found, true = np.sum([r[way] for r in of], axis=0).tolist()
            lost = sum(r[way][0] < 0.5 * r[way][2] for r in of)
            cells = [f"{right / max(found, 1):.3f}", f"{right / max(true, 1):.3f}", f"{lost} of {len(of)}"]
            kept, left = np.sum([r["handed"] for r in of], axis=0).tolist()
            handed = f"{kept} of {left}" if way == "ours" else "–"
            rate = Spread([r["frames_a_second"] for r in of]).text(0, spread=False) if way == "ours" else "–"
            rows.append([name, way, *cells, handed, rate])
    text = bench.format_table(
        ["scene", "way", "precision", "recall", "pairs of views lost", "handed over", "frames a second"], rows, 2
    )
    return f"{text}\n\nSeeds {options.first} to {options.first + options.seeds - 1}.", results


def run_case(case: Case) -> Case:
    """Return, for each way, the numbers of right, found and true pairs of boxes; and the speed of our way."""
    a, b = scene(case["kind"], case["seed"])
    start = time.perf_counter()
    shared = share(a, b)
    spent_s = time.perf_counter() - start
    figures = {
        "ours": np.sum([_score(x, y, *ids) for x, y, ids in zip(a, b, shared, strict=True)], axis=0),
        "carried": _carry(a, b),
        "nearest": np.sum(
            [_score_pairs(x, y, _mutual(true_map(x, y), x, y)) for x, y in zip(a, b, strict=True)], axis=0
        ),
    }
    right, of = np.sum([nearest_right(x, y) for x, y in zip(a, b, strict=True)], axis=0)
    figures["handed"] = _hand_over(a, b, shared)
    plain = {way: [int(n) for n in counts] for way, counts in figures.items()}
    return {**plain, "nearest_right": right / max(of, 1), "frames_a_second": len(a) / spent_s}


def share(a: list[View], b: list[View]) -> list[tuple[np.ndarray, ...]]:
    """Return the shared identities in each frame of both views."""
    tracker, frames = MultiViewTracker(delay_frames=150), []
    for number, views in enumerate(zip(a, b, strict=True), 1):
        frames += tracker.update([Tracks(number, view.own.astype(np.int64), view.box_px) for view in views])
    frames += tracker.flush()
    return [frame.shared for frame in frames]


def _score(a: View, b: View, ids_a: np.ndarray, ids_b: np.ndarray) -> tuple[int, int, int]:
    i, j = np.nonzero(ids_a[:, None] == ids_b[None])
    return _score_pairs(a, b, np.c_[i, j])


def _score_pairs(a: View, b: View, pairs: np.ndarray) -> tuple[int, int, int]:
    right = (a.true[pairs[:, 0]] == b.true[pairs[:, 1]]).sum()
    return int(right), len(pairs), int(np.isin(a.true, b.true).sum())


def _hand_over(a: list[View], b: list[View], shared: list[tuple[np.ndarray, ...]]) -> tuple[int, int]:
    """Return the number of targets that leave a view while the other sees them and keep their identity, and of all.

    A target counts if both views have seen it for 3 s before, and if it stays away for 3 s.
    """
    kept = left = 0
    named = [
        [dict(zip(view.true.tolist(), ids[k].tolist(), strict=True)) for view, ids in zip(views, shared, strict=True)]
        for k, views in enumerate((a, b))
    ]
    for here, there in (named, named[::-1]):
        for at in range(30, len(a) - 30):
            for target in here[at].keys() & there[at].keys():
                is_gone = not any(target in frame for frame in here[at + 1 : at + 31])
                after = [frame[target] for frame in there[at + 1 : at + 11] if target in frame]
                seen = sum(
                    target in x and target in y for x, y in zip(here[at - 30 : at], there[at - 30 : at], strict=True)
                )
                if is_gone and after and seen > 20:
                    left += 1
                    kept += after[0] == here[at][target]
    return kept, left


def _score_nearest(a: View, b: View) -> tuple[int, int, int]:
    return _score_pairs(a, b, _mutual(true_map(a, b), a, b))


def _mutual(b_from_a: np.ndarray, a: View, b: View, most_px: float = 60.0) -> np.ndarray:
    if not len(a.true) or not len(b.true):
        return np.zeros((0, 2), int)
    apart = np.linalg.norm(geometry.transfer(b_from_a, feet(a.box_px))[:, None] - feet(b.box_px)[None], axis=-1)
    apart = np.nan_to_num(apart, nan=1e9)
    i, j = np.arange(len(apart)), apart.argmin(1)
    is_mutual = (apart.argmin(0)[j] == i) & (apart[i, j] < most_px)
    return np.c_[i, j][is_mutual]


def _carry(a: list[View], b: list[View]) -> np.ndarray:
    b_from_a, total = true_map(a[0], b[0]), np.zeros(3, int)
    for x, y in zip(a, b, strict=True):
        pairs = _mutual(b_from_a, x, y)
        total += _score_pairs(x, y, pairs)
        if len(pairs) >= 6:
            fitted, _ = cv2.findHomography(feet(x.box_px)[pairs[:, 0]], feet(y.box_px)[pairs[:, 1]], cv2.RANSAC, 15.0)
            b_from_a = b_from_a if fitted is None else fitted
    return total


if __name__ == "__main__":
    options = {"--files": [], "--seeds": 20, "--first": 1, "--jobs": 1, "--cache": None}
    bench.main(__doc__, {"": (measure, options)})
