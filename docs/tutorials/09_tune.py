"""# 9. Tune by gradient

Parameters can learn from labelled frames. The steps of the pipeline have soft forms with gradients. This tutorial sets
a threshold three times too high, and the gradient brings it back down. It needs the extra `torch`.
"""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt

from torchvision_dddas.lab.evaluation.studies.runner import read_spec
from torchvision_dddas.lab.simulation import film_clip
from torchvision_dddas.lab.tuning import Plan, descend, judge, prepare

# %%
# ## Clips and a study
#
# The clips have pictures in `frames/` and masks in `masks/`. Nothing is learned from the clip `held`; it tells what the
# new value is worth on a clip that had no part in it. The threshold of the configuration `fast` is 20 grey levels.

folder = Path()
for seed, name in enumerate(("one", "two", "held")):
    film_clip(folder / "clips" / name, seed, frames=8, size_px=(320, 240))
(folder / "study.toml").write_text('[[dataset]]\nkind = "folder"\nfolder = "clips"\n', encoding="utf-8")

wrong = ("difference.threshold=60", "gates.min_area_px=30")
spec = replace(read_spec(folder / "study.toml"), config="fast", overrides=wrong)
ready = prepare(spec, folder, ["difference.threshold"], holdout=["held"])

# %%
# ## Descent
#
# Nine steps go down the slope of 1 − F of soft masks. `watched` is the loss on frames of which nothing is learned; the
# best state by this loss is kept. `descend` calls `tell` after each step.

steps = []
plan = Plan(steps=9, batch=2, rate=0.35, look_every=3)
found = descend(ready.family, ready.parameters, ready.examples, plan, tell=steps.append)
print(f"difference.threshold: 60 -> {found.settings.difference.threshold:g} ({found.ended})")

figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 2.8), layout="constrained")
left.plot([step.step for step in steps], [step.parameters["difference.threshold"] for step in steps])
left.set(xlabel="step", ylabel="difference.threshold")
watched = [step for step in steps if step.watched is not None]
right.plot([step.step for step in watched], [step.watched for step in watched], "o-")
right.set(xlabel="step", ylabel="loss of watched frames")
figure.savefig("09_tune.png", dpi=80)

# %%
# ![The threshold and the loss over the steps](09_tune.png)
#
# ## What is it worth?
#
# `judge` runs the whole pipeline with hard operations, before and after, on both sets of clips. So few and so small
# pictures show only the way: F stays low, and the held-out clip is too short to tell.

tuned = {"difference.threshold": found.settings.difference.threshold}
verdict = judge(ready.spec, folder, ready.goal, tuned, ready.tuned, ready.held, jobs=1, cache=folder / "cache")
for words, side in (("tuned on", verdict.tuned), ("held out", verdict.held)):
    if side is not None:
        print(f"F on the clips {words}: {side.pooled[0]:.3f} -> {side.pooled[1]:.3f} ({side.says})")

# %%
# The same on the command line: `dddas tune study.toml --parameters difference.threshold --holdout held`. It also writes
# `tuned.toml` for `--config` of every command. [Tuning by gradient](/tuning.md) says which parameters can be tuned and
# what tuning was worth on real clips. The last tutorial [simulates](10_simulate.py).
