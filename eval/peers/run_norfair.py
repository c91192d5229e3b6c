"""norfair on tables of boxes: `.venv-norfair/bin/python run_norfair.py JOBS.json`; jobs and answer as run_trackers.py.

Runs in the environment that `make peers` makes, and knows nothing of this package. norfair has no default distance:
its own examples' intersection over union at 0.7 is taken for one. A row is written for each box that a track took.
"""

import functools
import json
import sys
import time
from pathlib import Path

import norfair
import numpy as np

DEFAULTS = {"distance_function": "iou", "distance_threshold": 0.7}


@functools.cache
def read(path: str) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def run(job: dict) -> float:
    table = read(job["boxes"])
    looks = range(1, job["length"] + 1, job["interval"])
    settings = DEFAULTS | job["settings"]
    least = settings.pop("least_score", 0.0)
    given = []
    for frame in looks:
        rows = table[(table[:, 0] == frame) & (table[:, 6] >= least)]
        corners = np.stack([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]], axis=1)
        given.append([norfair.Detection(points, data=row) for points, row in zip(corners, rows, strict=True)])
    tracker = norfair.Tracker(**settings)
    begun = time.perf_counter()
    found = []
    for detections in given:
        tracks = tracker.update(detections)
        taken = {id(t.last_detection): t.id for t in tracks}
        found.append([(taken[id(d)], d.data) for d in detections if id(d) in taken])
    seconds = time.perf_counter() - begun
    if job["out"]:
        lines = []
        for frame, rows in zip(looks, found, strict=True):
            for name, row in rows:
                x, y, w, h = row[2:6]
                lines.append(f"{frame},{name},{x:.4f},{y:.4f},{w:.4f},{h:.4f},1,-1,-1,-1\n")
        Path(job["out"]).write_text("".join(lines))
    return seconds


if __name__ == "__main__":
    print(json.dumps([run(job) for job in json.loads(Path(sys.argv[1]).read_text())]))
