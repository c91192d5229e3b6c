"""# 3. Use your own detector

Your detector knows classes; this package knows motion, identities and places. A pipeline accepts any Python function
that finds boxes in a frame. The classes are kept through tracking, positions, zones and tables.
"""

from pathlib import Path

import cv2
import numpy as np

import torchvision_dddas as td
from torchvision_dddas.lab.simulation import film_clip

film_clip(Path("clip"), seed=3, frames=24, size_px=(480, 360))

# %%
# ## A detector is a function
#
# It gets a `Frame`. `frame.image` is the picture in OpenCV's BGR order, `frame.number` counts from 1. It returns
# `td.Detections`, or the result of supervision, ultralytics, torchvision or transformers for one picture. With a model
# of ultralytics the function is `lambda frame: model(frame.image)[0]`.
#
# This stand-in for a model needs no weights: it reads the true masks of the film, loses every fifth box by chance, and
# calls large boxes cars.

rng = np.random.default_rng(0)


def detect(frame):
    mask = cv2.imread(f"clip/masks/{frame.number:06d}.png", cv2.IMREAD_GRAYSCALE)
    boxes = [cv2.boundingRect((mask == value).astype(np.uint8)) for value in np.unique(mask[mask > 0])]
    boxes = np.array([box for box in boxes if rng.random() < 0.8], float).reshape(-1, 4)
    names = np.where(boxes[:, 2] * boxes[:, 3] > 800, "car", "person")
    return td.Detections(boxes, np.full(len(boxes), 0.9), label=names.tolist())


# %%
# ## Run it
#
# The pipeline tracks the boxes, and bridges the frames in which a box was lost.

results = list(td.Pipeline(detector=detect)("clip/frames"))
for result in results[10:13]:
    print(result.number, dict(zip(result.tracks.id.tolist(), result.tracks.label, strict=True)))

picture = td.draw(results[12].frame, results[:13])  # the earlier results make the trails
cv2.imwrite("03_own_detector.jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])

# %%
# ![The movers with class and identity](03_own_detector.jpg)
#
# ## Boxes from a file
#
# Boxes that are already on disk need no Python: `dddas run clip.mp4 --detections boxes.csv` reads them, and
# [the commands' page](/commands.md) lists the tables that it understands. In Python, `td.read_detections` reads them,
# and `table.at(n)` are the detections of frame n. Or give the tracker the record of another library:

tracker = td.Tracker(size=(480, 360))
settled = []
for frame in td.open_video("clip/frames"):
    own = detect(frame)
    other = {"boxes": own.xyxy, "scores": own.score, "labels": own.label}  # as torchvision and transformers give them
    settled += tracker.update(td.Detections.from_supervision(other))
settled += tracker.flush()
print(len(settled), "frames,", len({int(i) for tracks in settled for i in tracks.id}), "identities")

# %%
# [The next tutorial](04_positions.py) says where on the ground the targets are.
