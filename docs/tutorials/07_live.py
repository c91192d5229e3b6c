"""# 7. Live video

A live run keeps up with a camera: it processes the newest picture, drops what it has no time for, and reports both.
This tutorial plays a recording as a camera would, and reads the results as they come.
"""

import json
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt

import torchvision_dddas as td
from torchvision_dddas.lab.simulation import film_clip

film_clip(Path("clip"), seed=0, frames=40, size_px=(480, 360))

# %%
# ## Results as lines of JSON
#
# `--live` plays the folder at its own rate. Put `camera:0` or `rtsp://HOST/stream` in its place. `--emit json:-` writes
# one line of JSON for each picture to standard output; other programs read them there. `--config fast` suits small
# computers.

command = ["dddas", "run", "clip/frames", "--rate", "10", "--live", "--config", "fast", "--emit", "json:-"]
lines = []
with subprocess.Popen([*command, "--out", "live", "--quiet"], stdout=subprocess.PIPE, text=True) as run:
    for text in run.stdout:
        line = json.loads(text)
        lines.append(line)
        if line["frame"] % 10 == 0:
            print(line["frame"], [(target["id"], target["box_px"]) for target in line["targets"]])

# %%
# A target without an `id` is seen and not yet followed. [](/stream.md) lists all fields, and the other streams:
# MOTChallenge text, and Cursor-on-Target for maps such as ATAK.
#
# ## What the run says of itself
#
# Each session has a folder with `results.jsonl`, `events.log` and `run.json`. `run.json` counts the pictures that came,
# that were dropped, and that have results.

folder = max(Path("live").iterdir())
record = json.loads((folder / "run.json").read_text())
print("state:", record["state"])
print({name: record["counts"][name] for name in ("captured", "dropped", "results") if name in record["counts"]})

figure, axes = plt.subplots(figsize=(6.4, 3), layout="constrained")
axes.step([line["frame"] for line in lines], [len(line["targets"]) for line in lines], where="mid", label="seen")
axes.step(
    [line["frame"] for line in lines],
    [sum(target["id"] is not None for target in line["targets"]) for line in lines],
    where="mid",
    label="with identity",
)
axes.set(xlabel="frame", ylabel="targets")
axes.legend()
figure.savefig("07_live.png", dpi=80)

# %%
# ![The number of targets seen, and of those with an identity, over the frames](07_live.png)
#
# ## In your own loop
#
# A program that has its own camera gives the pipeline one picture at a time. Results come a few pictures later.

pipeline = td.Pipeline("fast", rate_hz=10)
count = 0
for frame in td.open_video("clip/frames"):
    for result in pipeline.update(frame.image):
        count += len(result.tracks)
count += sum(len(result.tracks) for result in pipeline.flush())
print(count, "boxes with an identity")

# %%
# [Onboard and live](/onboard.md) has the status page, the health check, waiting for a camera, telemetry in a live run,
# and the recipe for a service. The next tutorial [measures how good results are](08_evaluate.py).
