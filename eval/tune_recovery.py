"""Whether descent finds back what was lost: `python eval/tune_recovery.py [--seeds N] [--steps N] [--write FILE]`.

For each seed a scene is filmed, and the parameters of the core are perturbed, each by a factor drawn evenly in the
logarithm from 1/3 to 3. Descent starts there and learns from the scene's true masks. Told are the pixels' F of the
whole hard pipeline, persistence and outlines included, at the shipped settings, at the perturbed and at the tuned ones,
on that scene and on another one that nothing was learned from. A seed counts as recovered where F on its scene is at
least 0.9 of that of the shipped settings. With --step, the time and the memory of one step of all tunable parameters of
motion.
"""

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import report
from synthetic import film_into

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.evaluation.datasets import folder
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics import pixels as segmentation
from torchvision_dddas.evaluation.metrics.pixels import Pixels
from torchvision_dddas.evaluation.metrics.truth import labels_of
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.motion import Masks
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters

KNOBS = ("difference.noise_levels", "difference.gradient_share", "difference.threshold", "difference.peak")
SIZE, FRAMES, FACTOR, WITHIN = (320, 240), 16, 3.0, 0.9
# People are some ten pixels tall at this size.
BASE = {"gates.min_area_px": 60, "morphology.close_px": 9}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--step", action="store_true", help="measure one step, and leave the rest")
    parser.add_argument("--write", type=Path, help="a text with marks for the table")
    given = parser.parse_args()
    lines = one_step() if given.step else recovery(given.seeds, given.steps)
    print("\n".join(lines))
    if given.write is not None:
        report.put(given.write, "tune_recovery" + ("_step" if given.step else ""), "\n".join(lines))


def recovery(seeds: int, steps: int) -> list[str]:
    """The table of all seeds."""
    shipped = with_parameters(load_config(), BASE)
    rows = []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as place:
            learned, other = (filmed(Path(place), 2 * seed + k) for k in (0, 1))
            start = perturbed(shipped, seed)
            tuned = descended(learned, start, seed, steps)
            row = [f(clip, s) for clip in (learned, other) for s in (shipped, start, tuned)]
        rows.append(row)
        print(f"seed {seed}: " + " ".join(f"{value:.3f}" for value in row), file=sys.stderr, flush=True)
    table = np.array(rows)
    recovered = table[:, 2] >= WITHIN * table[:, 0]
    lines = ["| scene | shipped | perturbed | tuned | least, tuned / shipped |", "| --- | --- | --- | --- | --- |"]
    for name, part in (("learned from", table[:, :3]), ("not learned from", table[:, 3:])):
        least = (part[:, 2] / part[:, 0]).min()
        lines.append(f"| {name} | " + " | ".join(f"{value:.3f}" for value in part.mean(axis=0)) + f" | {least:.2f} |")
    return [*lines, "", f"Recovered: {recovered.sum()} of {seeds} seeds."]


def filmed(place: Path, seed: int) -> Clip:
    """A scene on disk, as a clip of a data set."""
    film_into(place / f"scene-{seed}", seed, FRAMES, SIZE)
    (clip,) = folder.read(place, {}, lambda name: name == f"scene-{seed}").clips
    return clip


def perturbed(settings: Settings, seed: int) -> Settings:
    """Each parameter times a factor of its own, within its range."""
    factors = FACTOR ** np.random.default_rng([seed, 7]).uniform(-1, 1, len(KNOBS))
    starts = {}
    for name, factor in zip(KNOBS, factors, strict=True):
        group, key = name.split(".")
        starts[name] = float(TUNABLE[name].rounded(getattr(getattr(settings, group), key) * factor))
    return with_parameters(settings, starts)


def descended(clip: Clip, start: Settings, seed: int, steps: int) -> Settings:
    """Two descents: far from what is right without, and near it with what the hard steps after the hulls do."""
    settings = start
    for after in (False, True):
        family = Masks(after=after)
        parameters = Parameters(settings, KNOBS)
        plan = Plan(steps=steps, batch=4, rate=0.15, seed=seed, most_watched=4)
        settings = descend(family, parameters, family.examples([clip], settings), plan).settings
    return settings


def f(clip: Clip, settings: Settings) -> float:
    """Pixels' F of the hard pipeline."""
    assert clip.truth is not None
    total = Pixels()
    for scene in detect_motion(open_clip(clip), settings, "onboard"):
        total = total.plus(segmentation.count(scene.mask, labels_of(clip.truth, scene.frame.number)))
    return float(np.nan_to_num(segmentation.measures(total)["f"]))


def one_step(frames: int = 8, rounds: int = 10) -> list[str]:
    """Time of a step on a batch of windows, by the clock and of all processors, and the most memory taken."""
    settings = load_config()
    with tempfile.TemporaryDirectory() as place:
        clip = filmed(Path(place), 0)
        family = Masks()
        examples = family.examples([clip], settings)[4 : 4 + frames]
    names = [name for name, parameter in TUNABLE.items() if parameter.family == "motion"]
    parameters = Parameters(settings, names)
    adam = torch.optim.Adam(parameters.parameters(), lr=0.05)
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    clock, spent = [], []
    for _ in range(rounds):
        start = time.perf_counter(), time.process_time()
        loss = family.loss(parameters.values(), examples, 0.1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        clock.append(time.perf_counter() - start[0])
        spent.append(time.process_time() - start[1])
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    what = f"{len(names)} parameters, {frames} windows of {SIZE[0]}×{SIZE[1]} | {torch.get_num_threads()}"
    took = f"{np.median(clock):.2f} ({min(clock):.2f}) | {np.median(spent):.2f} | {before_mb:.0f}, {peak_mb:.0f}"
    return [
        "| step of | threads | clock, s: median (least) | processors, s | memory, MB: before, most |",
        "| --- | --- | --- | --- | --- |",
        f"| {what} | {took} |",
    ]


if __name__ == "__main__":
    main()
