"""# 1. Detect what moves

The motion detector finds vehicles and people that move on their own while the camera moves too. It needs no training
data and no GPU. This tutorial films a small scene, detects its movers, and compares them with the truth.
"""

from pathlib import Path

import cv2
import numpy as np

import torchvision_dddas as td
from torchvision_dddas.io.overlay import draw_scene
from torchvision_dddas.lab.simulation import film_clip

# %%
# ## A clip with known truth
#
# `film_clip` renders the scenario `demo`: two cars and five people move, a third car is parked, and the camera shakes.
# The folder `clip` then holds `frames/` and `masks/`. A mask has the value 0 for the background and another value for
# each mover. Use your own video in place of it; masks are not needed to detect.

film_clip(Path("clip"), seed=0, frames=24, size_px=(480, 360))

# %%
# ## Detection
#
# `update` takes one frame and returns the scenes that are settled by it. A scene is settled some frames later, because
# the detector compares a frame with its neighbours on both sides. `flush` returns the last scenes.

detector = td.MotionDetector()
scenes = [scene for frame in td.open_video("clip/frames") for scene in detector.update(frame)]
scenes += detector.flush()

for scene in scenes[10:13]:
    print(f"frame {scene.frame.number}: {len(scene.detections)} targets")
    print(scene.detections.box_px.round(), scene.detections.speed_px.round(1))

# %%
# `box_px` has one row for each target: x and y of the top left pixel, width, height. `speed_px` is the speed relative
# to the ground, in pixels a frame. `scene.mask` shows the outlines: 0 is background, k is target k.
#
# `draw_scene` draws one scene. Arrows show the direction of motion. The parked car has no outline.

cv2.imwrite("01_detect.jpg", draw_scene(scenes[12]), [cv2.IMWRITE_JPEG_QUALITY, 75])

# %%
# ![A frame with the outlines and boxes of the movers; the parked car has none](01_detect.jpg)
#
# ## How good is it?
#
# The masks of the film tell which pixels truly move. Precision is the share of the found pixels that are true. Recall
# is the share of the true pixels that were found.

true = np.stack([cv2.imread(f"clip/masks/{scene.frame.number:06d}.png", cv2.IMREAD_GRAYSCALE) > 0 for scene in scenes])
found = np.stack([scene.mask > 0 for scene in scenes])
both = (true & found).sum()
print(f"precision {both / found.sum():.2f}, recall {both / true.sum():.2f}")

# %%
# ## Other settings
#
# `load_settings` takes the name of a shipped configuration or a TOML file, and single values. The configuration `fast`
# takes about a fifth of the time; its outlines are coarser. [](/reference/settings.md) lists every parameter.

quick = td.MotionDetector(td.load_settings("fast", ["gates.min_area_px=30"]))
scenes = [scene for frame in td.open_video("clip/frames") for scene in quick.update(frame)] + quick.flush()
print(sum(len(scene.detections) for scene in scenes), "targets in all frames")

# %%
# The same on the command line: `dddas detect clip/frames` writes tables, masks and an overlay. The next tutorial gives
# the targets [identities](02_track.py).
