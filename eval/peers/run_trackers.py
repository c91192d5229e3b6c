"""SORT, ByteTrack, OC-SORT, C-BIoU, BoT-SORT and ARC-SORT on tables of boxes, for jobs.py.

`.venv-peers/bin/python run_trackers.py JOBS.json` runs in the environment that `make peers` makes, and knows nothing of
this package. JOBS: a list of {"tracker": name, "settings": {...}, "boxes": file, "interval": D, "length": frames,
"out": file or null}. Writes the identity of each row of the boxes, 0 for none, and prints the list of processor seconds
that each job took, reading and writing left out. Every look is one update, also one without boxes.

Ours among the settings: `least_score`, boxes below it are not given; `times`, the tracker is told when each look is;
`iou`, the name of a measure of overlap with its arguments.
"""

import functools
import json
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import supervision as sv
import trackers
from arcsort import ARCTracker
from loguru import logger
from trackers.utils import iou

TRACKERS = {
    "SORT": trackers.SORTTracker,
    "ByteTrack": trackers.ByteTrackTracker,
    "OC-SORT": trackers.OCSORTTracker,
    "C-BIoU": trackers.CBIoUTracker,
    "BoT-SORT": trackers.BoTSORTTracker,
}
FRAMES_A_SECOND = 30.0

Update = Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From the frame, corners (n, 4) and scores (n,) to the rows that have an identity, and these identities."""


@functools.cache
def read(path: str) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def run(job: dict) -> float:
    settings = dict(job["settings"])
    table = read(job["boxes"])
    kept = table[:, 6] >= settings.pop("least_score", -np.inf)
    looks = range(1, job["length"] + 1, job["interval"])
    rows = [np.flatnonzero((table[:, 0] == frame) & kept) for frame in looks]
    corners = np.c_[table[:, 2:4], table[:, 2:4] + table[:, 4:6]]
    given = [(frame, corners[r], table[r, 6]) for frame, r in zip(looks, rows, strict=True)]
    update = arc_sort(settings) if job["tracker"] == "ARC-SORT" else by_package(job["tracker"], settings)
    begun = time.process_time()
    found = [update(*look) for look in given]
    seconds = time.process_time() - begun
    if job["out"]:
        identity = np.zeros(len(table), int)
        for here, (taken, names) in zip(rows, found, strict=True):
            identity[here[taken]] = names
        np.savetxt(job["out"], identity, fmt="%d")
    return seconds


def by_package(name: str, settings: dict) -> Update:
    """A tracker of the package trackers, which gives the detections back."""
    times = settings.pop("times", False)
    if "iou" in settings:
        measure, *words = settings["iou"]
        settings["iou"] = getattr(iou, measure)(*words)
    tracker = TRACKERS[name](**settings)

    def update(frame: int, corners: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        detections = sv.Detections(xyxy=corners, confidence=score, data={"row": np.arange(len(score))})
        tracks = tracker.update(detections, timestamp=frame / FRAMES_A_SECOND if times else None)
        named = tracks.tracker_id >= 0
        rows = tracks.data["row"] if len(tracks) else np.zeros(0, int)
        return rows[named], tracks.tracker_id[named] + 1

    return update


def arc_sort(settings: dict) -> Update:
    """ARC-SORT with the settings that its makers recommend, without pictures; its boxes are those given."""
    tracker = ARCTracker.from_preset("sportsmot", use_cmc=False, **settings)

    def update(_: int, corners: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tracks = tracker.update(np.c_[corners, score, np.zeros(len(score))])
        row = {box.tobytes(): n for n, box in enumerate(corners)}
        return np.array([row[box.tobytes()] for box in tracks[:, :4]], int), tracks[:, 4].astype(int)

    return update


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logger.remove()
    print(json.dumps([run(job) for job in json.loads(Path(sys.argv[1]).read_text())]))
