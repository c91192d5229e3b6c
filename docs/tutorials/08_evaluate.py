"""# 8. Evaluate and compare

How good are the results on clips with known truth, and is one configuration better than another beyond chance? A study
runs and scores whole data sets. `dddas compare` tests the difference of two studies.
"""

import json
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt

from torchvision_dddas.lab.simulation import film_clip

# %%
# ## A data set of your own
#
# A clip is a folder with `frames/` and `masks/`. Three simulated flights are enough to show the steps; real studies
# need more. [](/datasets.md) lists the public data sets that are read as they are.

for seed in range(3):
    film_clip(Path("clips") / f"flight{seed}", seed, frames=10, size_px=(480, 360))

Path("study.toml").write_text(
    """
tasks = ["motion"]

[[dataset]]
kind = "folder"
folder = "clips"
"""
)

# %%
# ## Two studies
#
# The first one uses the default, the second one the configuration `fast`. Results are kept in a cache: a study that is
# repeated, or was killed, computes only what is missing.

for name, options in (("default", []), ("fast", ["--config", "fast"])):
    command = ["dddas", "evaluate", "--dataset", "study.toml", "--out", name, "--jobs", "1", "--quiet", *options]
    subprocess.run(command, check=True)

# %%
# `metrics.json` has the measures of each clip, pooled over the clips, and their mean with an interval of 95 %.
# `metrics.csv` has the same as a table, `report.html` as a page with the worst frames.

figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
for shift, name in enumerate(("default", "fast")):
    study = json.loads((Path(name) / "metrics.json").read_text())["tasks"]["motion"]
    print(name, "F1 of boxes over all clips:", round(study["pooled"]["boxes"]["f1"], 2))
    for row, scores in enumerate(study["clips"].values()):
        low, high = scores["intervals"]["boxes"]["f1"]
        axes.plot([row + shift / 5] * 2, [low, high], f"C{shift}", linewidth=2)
        axes.plot(row + shift / 5, scores["boxes"]["f1"], f"C{shift}o", label="" if row else name)
axes.set(xticks=range(len(study["clips"])), xticklabels=study["clips"], ylabel="F1 of boxes", ylim=(0, 1))
axes.legend()
figure.savefig("08_evaluate.png", dpi=80)

# %%
# ![F1 of each flight with its interval of 95 %, for both configurations](08_evaluate.png)
#
# ## Is the difference real?
#
# `dddas compare` pairs the clips of both studies, tests each measure, and corrects for the number of tests. With three
# short clips most differences are within noise, and the table says so.

told = subprocess.run(["dddas", "compare", "default", "fast"], check=True, capture_output=True, text=True).stdout
print(*[line for line in told.splitlines() if " f1 " in line or " ap " in line], sep="\n")

# %%
# To score results that are already on disk, give `dddas evaluate` the truth and the results:
# `dddas evaluate gt.txt dddas-tracks` computes HOTA, MOTA, IDF1 and switches from MOTChallenge text. `dddas sweep`
# tries values of parameters. The next tutorial finds them [by their gradient](09_tune.py).
