"""# 2. Keep identities

The detector looks at each frame by itself. The tracker tells which target of one frame is the same as a target of
another frame. It works on the motion detector's targets, and as well on boxes of any other detector.
"""

from pathlib import Path

import cv2

import torchvision_dddas as td
from torchvision_dddas.io.overlay import colour_picture, identity_colour, label, rectangle
from torchvision_dddas.lab.simulation import film_clip

film_clip(Path("clip"), seed=0, frames=24, size_px=(480, 360))
detector = td.MotionDetector()
scenes = [scene for frame in td.open_video("clip/frames") for scene in detector.update(frame)] + detector.flush()

# %%
# ## Each frame
#
# `update` takes the detections of one frame and the motion of the camera since the frame before. The motion is a 3 by 3
# homography; the detector measures it. It may be `None`. The tracker decides with one frame of look-ahead, so `update`
# returns the tracks of an earlier frame.

tracker = td.Tracker()
tracks = [done for scene in scenes for done in tracker.update(scene.detections, scene.camera_motion)]
tracks += tracker.flush()

print("frame", tracks[-1].frame, "identities", tracks[-1].id.tolist())
print(tracks[-1].xyxy.round())

# %%
# ## Draw
#
# A colour belongs to an identity, in every frame and on maps. A box with the row −1 bridges a gap: the target was not
# detected there.

middle = tracks[15]
picture = colour_picture(scenes[15].frame.image)
for identity, box in zip(middle.id.tolist(), middle.box_px, strict=True):
    rectangle(picture, box, identity_colour(identity), 2)
    label(picture, box, str(identity), identity_colour(identity))
cv2.imwrite("02_track.jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])

# %%
# ![The movers with a number each](02_track.jpg)
#
# ## Every third frame
#
# A slow detector looks at few frames. Tell the tracker how many frames lie between two looks. Detections of the frames
# between are left out here, and the motion of the camera is left to the tracker.

seldom = td.Tracker(interval=3, size=(480, 360))
tracks = [done for scene in scenes[::3] for done in seldom.update(scene.detections)] + seldom.flush()
print("identities at every third frame:", sorted({int(i) for one in tracks for i in one.id}))

# %%
# ## One table
#
# `concat` joins the tracks of all frames. With pandas installed, `to_pandas()` makes a table of it.

table = td.Tracks.concat(tracks)
print(len(table), "boxes of", len(set(table.id.tolist())), "identities")

# %%
# The same on the command line: `dddas track clip/frames --interval 3`. The next tutorial brings
# [your own detector](03_own_detector.py).
