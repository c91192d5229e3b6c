"""SORT, ByteTrack and OC-SORT on tables of boxes: `.venv-peers/bin/python run_trackers.py JOBS.json`.

Runs in the environment that `make peers` makes, and knows nothing of this package. JOBS: a list of
{"tracker": name, "settings": {...}, "boxes": file, "interval": D, "length": frames, "out": file or null}; prints the
list of seconds that each took, reading and writing left out. Every look is one update, also one without boxes.
`least_score` among the settings is ours: boxes below it are not given.
"""

import functools
import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import supervision as sv
from trackers import ByteTrackTracker, OCSORTTracker, SORTTracker

TRACKERS = {"SORT": SORTTracker, "ByteTrack": ByteTrackTracker, "OC-SORT": OCSORTTracker}


@functools.cache
def read(path: str) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def run(job: dict) -> float:
    settings = dict(job["settings"])
    table = read(job["boxes"])
    table = table[table[:, 6] >= settings.pop("least_score", -np.inf)]
    looks = range(1, job["length"] + 1, job["interval"])
    given = []
    for frame in looks:
        rows = table[table[:, 0] == frame]
        corners = np.c_[rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]]
        given.append(sv.Detections(xyxy=corners, confidence=rows[:, 6]) if len(rows) else sv.Detections.empty())
    tracker = TRACKERS[job["tracker"]](**settings)
    begun = time.perf_counter()
    found = [tracker.update(d) for d in given]
    seconds = time.perf_counter() - begun
    if job["out"]:
        lines = []
        for frame, tracks in zip(looks, found, strict=True):
            for (x0, y0, x1, y1), name in zip(tracks.xyxy, tracks.tracker_id, strict=True):
                if name >= 0:
                    lines.append(f"{frame},{name + 1},{x0:.4f},{y0:.4f},{x1 - x0:.4f},{y1 - y0:.4f},1,-1,-1,-1\n")
        Path(job["out"]).write_text("".join(lines))
    return seconds


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps([run(job) for job in json.loads(Path(sys.argv[1]).read_text())]))
