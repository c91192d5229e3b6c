"""Tuning in small: scenes are filmed, a parameter is put wrong, its gradient brings it back. No data needed.

.venv/bin/python docs/tuning.py [FOLDER]
"""

import sys
from dataclasses import replace
from pathlib import Path

from torchvision_dddas.lab.evaluation.studies.runner import read_spec
from torchvision_dddas.lab.simulation import film_clip
from torchvision_dddas.lab.tuning import Plan, Step, descend, judge, prepare


def show_step(step: Step) -> None:
    if step.watched is not None:
        print(f"step {step.step}: {step.parameters['difference.threshold']:.2f}, watched {step.watched:.3f}")


def main(folder: Path) -> None:
    # 1. Clips whose truth is known: pictures in frames/, and masks of what moves in masks/.
    for seed, name in enumerate(("one", "two", "held")):
        film_clip(folder / "clips" / name, seed, frames=10, size_px=(240, 180))
    (folder / "study.toml").write_text('[[dataset]]\nkind = "folder"\nfolder = "clips"\n', encoding="utf-8")

    # 2. The study with a threshold three times too high, and the clip that nothing is learned from.
    spec = replace(read_spec(folder / "study.toml"), overrides=("difference.threshold=12.0",))
    ready = prepare(spec, folder, ["difference.threshold"], holdout=["held"])

    # 3. Twelve steps down the slope of 1 - F of soft masks.
    found = descend(
        ready.family, ready.parameters, ready.examples, Plan(steps=12, batch=4, rate=0.2, look_every=3), tell=show_step
    )
    print(f"difference.threshold: 12 -> {found.settings.difference.threshold:g} ({found.ended})")

    # 4. What it is worth: the whole pipeline with hard operations, before and after.
    tuned = {"difference.threshold": found.settings.difference.threshold}
    verdict = judge(ready.spec, folder, ready.goal, tuned, ready.tuned, ready.held, jobs=1, cache=folder / "cache")
    for words, side in (("tuned on", verdict.tuned), ("held out", verdict.held)):
        if side is not None:
            print(f"F on the clips {words}: {side.pooled[0]:.3f} -> {side.pooled[1]:.3f} ({side.says})")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "dddas-tutorial"))
