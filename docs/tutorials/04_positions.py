"""# 4. Positions from a log

A drone's log says where the camera is and where it looks. From that the pipeline computes where each target stands on
the ground, with a covariance. No ground vehicles and no map are needed.
"""

import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import torchvision_dddas as td
from torchvision_dddas.geometry import east_north
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.lab.simulation import load_scenario, record_scenario

# %%
# ## A flight
#
# `record_scenario` writes what a real flight leaves behind: pictures, the log `telemetry.csv` and the camera's file
# `camera.toml`. The log has the errors of a consumer drone here: 3.5 m of GPS, 1° of tilt and 3° of heading. The truth
# lies in `truth/`.

scenario = load_scenario(
    "movers",
    [
        "camera.width_px=640",
        "camera.height_px=360",
        "uav.place_error95_m=3.5",
        "uav.angle_error_deg=1",
        "uav.heading_error_deg=3",
        "uav.altitude_error=0.01",
    ],
)
record_scenario(Path("flight"), scenario, frames=36)

# %%
# ## Locate
#
# `read_telemetry` reads the log of a drone in every format that [this page](/telemetry.md) lists: DJI subtitles,
# ArduPilot and PX4 logs, MISB, NMEA, CSV and others.

telemetry = td.read_telemetry("flight/telemetry.csv")
camera = read_camera("flight/camera.toml")
pipeline = td.Pipeline(telemetry=telemetry, camera=camera)
results = list(pipeline("flight/frames"))

for result in results[20:22]:
    where = result.locations.positions
    for target, place, covariance in zip(where.target, where.east_north_m, where.covariance_m2, strict=True):
        sigma_m = np.sqrt(np.trace(covariance) / 2)
        print(f"frame {result.number}, target {target}: {place.round(1)} m east and north, sigma {sigma_m:.1f} m")

# %%
# `east_north_m` counts from the place of the log's first line. `lonlat_deg` holds longitude and latitude. Where
# nothing can be located, `result.locations.fix.cause` says why.
#
# ## Compare with the truth
#
# All positions of a flight share the error of the log: they are shifted together. The map shows it, and the ellipse
# of 95 % that the pipeline states for one target.

last = [result.locations.positions for result in results if len(result.locations.positions)][-1]
with Path("flight/truth/positions.csv").open() as table:
    rows = list(csv.DictReader(table))
true = np.array([(float(row["longitude_deg"]), float(row["latitude_deg"])) for row in rows])
true_m = east_north(true, last.origin_deg)
found_m = np.concatenate([result.locations.positions.east_north_m for result in results])

variance, axis = np.linalg.eigh(last.covariance_m2[0])
angle = np.linspace(0, 2 * np.pi, 60)
unit = np.stack([np.cos(angle), np.sin(angle)])
ellipse = last.east_north_m[0][:, None] + 2.45 * axis @ (np.sqrt(variance)[:, None] * unit)

figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
axes.plot(*true_m.T, ".", color="0.75", label="truth")
axes.plot(*found_m.T, ".", markersize=3, label="found")
axes.plot(*ellipse, label="95 % of one position")
axes.set(xlabel="east, m", ylabel="north, m", aspect="equal")
axes.legend()
figure.savefig("04_positions.png", dpi=80)

# %%
# ![The true ways and the found positions beside them](04_positions.png)
#
# `--config rtk` states the errors of a vehicle with RTK, `--config cheap` those of a cheap log, and
# `dddas calibrate-flight` measures those of your own drone ([how](/commands.md#the-errors-of-your-own-drone)).
#
# The same on the command line: `dddas run flight/frames --telemetry flight/telemetry.csv --camera flight/camera.toml`.
# It also writes a map, GeoJSON, KML and Cursor-on-Target. [Landmarks](05_landmarks.py) make positions more precise.
