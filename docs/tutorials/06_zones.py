"""# 6. Zones and lines

Who enters an area, leaves it, stays in it, or crosses a line, and how fast? Zones answer that for targets with
positions on the ground. For a camera that does not move, zones may also lie in the picture.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import torchvision_dddas as td
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.lab.simulation import load_scenario, record_scenario

scenario = load_scenario("movers", ["camera.width_px=640", "camera.height_px=360"])
record_scenario(Path("flight"), scenario, save=["frames"], frames=45)
telemetry, camera = td.read_telemetry("flight/telemetry.csv"), read_camera("flight/camera.toml")

# %%
# ## An area and a line
#
# An area is a list of corners. A line is a list of two or more points, and a crossing has a direction. The unit is
# `"m"` here: metres east and north of the first place in the log. The default is degrees. `td.Zones("field.geojson")`
# reads a file that QGIS or another program for maps has written.

zones = td.Zones(
    polygons={"yard": [[-6, -4], [4, -4], [4, 4], [-6, 4]]},
    lines={"road": [[-14, 0], [-14, 12]]},
    unit="m",
    dwell_s=1.0,
)

# %%
# ## Events
#
# `update` takes the result of each frame and returns the events that it settles. A target has passed a border once it
# is further from it than the noise of its position, so that it does not flicker in and out.

results, events = [], []
for result in td.Pipeline(telemetry=telemetry, camera=camera)("flight/frames"):
    results.append(result)
    for event in zones.update(result):
        events.append(event)
        print(f"{event.time_s:.1f} s: {event.describe()}")

# %%
# `event.kind` is `enter`, `leave`, `present` (it was inside when it was first seen), `dwell` or `cross`. An event also
# has the place, the speed, the class, and how long the target was inside.

figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
for zone in zones.zones:
    axes.plot(*np.concatenate([zone.rings[0], zone.rings[0][:1]]).T, label=zone.name)
places = np.concatenate([result.locations.positions.east_north_m for result in results])
axes.plot(*places.T, ".", color="0.7", markersize=3)
for event in events:
    axes.annotate(event.kind, event.east_north_m, xytext=(6, 6), textcoords="offset points")
    axes.plot(*event.east_north_m, "k*")
axes.set(xlabel="east, m", ylabel="north, m", aspect="equal")
axes.legend()
figure.savefig("06_zones.png", dpi=80)

# %%
# ![The area, the line, the ways of the targets and the events](06_zones.png)
#
# ## In the picture
#
# For a camera on a mast, `td.Zones(polygons=..., unit="px")` takes corners in pixels and needs no log.
#
# The same on the command line: `dddas run flight/frames --rate 15 --telemetry flight/telemetry.csv --camera
# flight/camera.toml --zones field.geojson` writes `events.csv`. [The page on events](/commands.md#events-by-place)
# lists the keys of such a file. The next tutorial is about [live video](07_live.py).
