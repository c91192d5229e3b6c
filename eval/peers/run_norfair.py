"""norfair on tables of boxes: `.venv-norfair/bin/python run_norfair.py JOBS.json`; jobs and answer as run_trackers.py.

Runs in the environment that `make peers` makes, and knows nothing of this package. norfair has no default distance:
its own examples' intersection over union at 0.7 is taken for one. A box has the identity of the track that took it.
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
    settings = DEFAULTS | job["settings"]
    kept = table[:, 6] >= settings.pop("least_score", 0.0)
    period = job["interval"] if settings.pop("times", False) else 1
    given = []
    for frame in range(1, job["length"] + 1, job["interval"]):
        rows = np.flatnonzero((table[:, 0] == frame) & kept)
        corners = np.stack([table[rows, 2:4], table[rows, 2:4] + table[rows, 4:6]], axis=1)
        given.append([norfair.Detection(points, data=row) for points, row in zip(corners, rows, strict=True)])
    tracker = norfair.Tracker(**settings)
    begun = time.process_time()
    found = []
    for detections in given:
        tracks = tracker.update(detections, period)
        taken = {id(t.last_detection): t.id for t in tracks}
        found += [(d.data, taken[id(d)]) for d in detections if id(d) in taken]
    seconds = time.process_time() - begun
    if job["out"]:
        identity = np.zeros(len(table), int)
        for row, name in found:
            identity[row] = name
        np.savetxt(job["out"], identity, fmt="%d")
    return seconds


if __name__ == "__main__":
    print(json.dumps([run(job) for job in json.loads(Path(sys.argv[1]).read_text())]))
