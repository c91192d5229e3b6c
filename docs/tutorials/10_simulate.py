"""# 10. Simulate

In a simulated world the whole system can be tried: a drone and ground vehicles watch crowds, what is found steers the
vehicles, and the results are compared with the truth. Everything follows from a seed.
"""

import json
import subprocess
from pathlib import Path

import cv2

# %%
# ## A scenario of your own
#
# A scenario is a TOML file. It needs only what differs from the defaults. `dddas settings scenario` lists all
# parameters; `dddas simulate` lists the shipped scenarios.

Path("meeting.toml").write_text(
    """
about = "Two groups walk towards each other and go on as one"
seed = 4

[clip]
seconds = 6.0
rate_hz = 5.0

[world]
side_m = 120.0
texel_m = 0.15
buildings = 0

[uav]
altitude_m = 30.0

[camera]
width_px = 480
height_px = 360

[team]
ugvs = 4
ring_m = 10.0
width_px = 320
height_px = 240

[[crowd]]
people = 5
start_m = [-7.0, 0.0]
heading_deg = 90.0
speed_m_s = 1.4

[[crowd]]
people = 4
start_m = [6.0, 1.0]
heading_deg = 270.0
speed_m_s = 1.4

[[happening]]
time_s = 2.0
what = "join"
crowds = [1, 2]
"""
)

# %%
# ## Fly it
#
# `dddas run sim:FILE` renders each picture when it is needed, because the drone flies where the results send it.
# `--scene` changes a parameter, `--seed` the seed.

command = ["dddas", "run", "sim:meeting.toml", "--out", "flight", "--quiet"]
subprocess.run(command, check=True)
record = json.loads(Path("flight/run.json").read_text())
print(record["state"], sorted(path.name for path in Path("flight").iterdir()))

# %%
# `report.html` shows the map, the crowds and the errors of positions over time; `log.txt` says what the world did
# and what the run noticed by itself. The overlay shows the landmarks, the targets, and what ground vehicles say of
# them (H: people).

overlay = cv2.VideoCapture("flight/overlay.mp4")
overlay.set(cv2.CAP_PROP_POS_FRAMES, 20)
_, picture = overlay.read()
cv2.imwrite("10_simulate.jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])

# %%
# ![A frame of the flight with landmarks, crowds and orders](10_simulate.jpg)
#
# ## Against the truth
#
# `run.json` compares the results with the truth: the share of crowds that were found, false targets a frame, and the
# errors of positions.

score = record["truth_score"]
print(f"found {score['detected']:.0%} of the crowds, {score['false_targets']:.1f} false targets a frame")
print(f"median error of positions {score['target_error_m']['median']:.2f} m")
print(*Path("flight/log.txt").read_text().splitlines()[:6], sep="\n")

# %%
# `dddas simulate meeting.toml --out film` writes the same world as files in place of flying in it: pictures, telemetry,
# landmarks, camera and truth. The other tutorials use such files. [](/simulation.md) lists the shipped scenarios.
