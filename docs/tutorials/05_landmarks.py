"""# 5. Positions from landmarks

Ground vehicles that report their place are landmarks. Where the camera sees them, they correct the errors of the
drone's log. Four of them also replace the log. This tutorial compares both on one flight.
"""

import csv
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

import torchvision_dddas as td
from torchvision_dddas.geometry import east_north
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.overlay import RunPictures
from torchvision_dddas.lab.simulation import load_scenario, record_scenario

# %%
# ## A flight above four vehicles
#
# Each vehicle carries a plate of its own colour and reports its place by GPS, here with an error of 3.5 m in 95 %. The
# drone's heading is 3° off and its tilt 1°.

changes = {
    "team.ugvs": 4,
    "team.ring_m": 12,
    "gps.error95_m": 3.5,
    "gps.rate_hz": 15,
    "uav.place_error95_m": 3.5,
    "uav.angle_error_deg": 1,
    "uav.heading_error_deg": 3,
    "camera.width_px": 640,
    "camera.height_px": 360,
}
scenario = load_scenario("movers", [f"{name}={value}" for name, value in changes.items()])
record_scenario(Path("flight"), scenario, save=["frames"], frames=36)

# %%
# ## With and without landmarks
#
# `landmarks.csv` holds the reports, `colours.toml` the range of colours of each plate. `dddas colours PICTURE` finds
# these ranges in a picture of your own vehicles.

telemetry = td.read_telemetry("flight/telemetry.csv")
camera = read_camera("flight/camera.toml")
landmarks = read_landmarks("flight/landmarks.csv")
colours = read_colours("flight/colours.toml")

by_log = list(td.Pipeline(telemetry=telemetry, camera=camera)("flight/frames"))
by_both = list(td.Pipeline(telemetry=telemetry, camera=camera, landmarks=landmarks, colours=colours)("flight/frames"))
fix = by_both[-1].locations.fix
print("located by", fix.by, "with", dict(zip([landmarks.names[k] for k in fix.landmark], fix.state, strict=True)))

# %%
# Each frame says how its landmarks were used. A landmark that contradicts the others is excluded or reassigned, and
# `fix.changes` names the cause.
#
# ## How far off are they?
#
# The error of a position is its distance from the nearest true position in the same frame.

true = defaultdict(list)
with Path("flight/truth/positions.csv").open() as table:
    for row in csv.DictReader(table):
        if row["kind"] != "ugv":
            true[int(row["frame"])].append((float(row["longitude_deg"]), float(row["latitude_deg"])))


def errors_m(results):
    """The distance of each position from the nearest mover."""
    for result in results:
        where = result.locations.positions
        for place in where.east_north_m:
            yield np.linalg.norm(east_north(np.array(true[result.number]), where.origin_deg) - place, axis=1).min()


for name, results in (("log", by_log), ("log and landmarks", by_both)):
    print(f"{name}: median error {np.median(list(errors_m(results))):.2f} m")

# %%
# The picture shows the landmarks of one frame with the text "located by pose" and the mean uncertainty.

pictures = RunPictures((640, 360), landmarks.names)
for result in by_both:
    pictures.show(result)
    if result.number == 20:
        cv2.imwrite("05_landmarks.jpg", pictures(result), [cv2.IMWRITE_JPEG_QUALITY, 75])

# %%
# ![A frame with four landmarks, the targets and their trails](05_landmarks.jpg)
#
# The same on the command line: `dddas run flight/frames --rate 15 --telemetry flight/telemetry.csv --camera
# flight/camera.toml --landmarks flight/landmarks.csv --colours flight/colours.toml`. The next tutorial watches
# [zones](06_zones.py).
