"""Are the registration's tolerances found back?

    python eval/tune_registration.py [--seeds N] [--steps N] [--write FILE]

For each seed two scenes over flat ground are filmed, whose homographies from frame to frame are known. The parameters
registration.ransac_px and registration.forward_backward_px begin at three times and at a third of what is shipped, and
learn from the masks of one scene; the true homographies have no say. Told are, on that scene and on the other one, the
mean distance of found and true homographies over the picture's corners, and the pixels' F of the whole hard pipeline.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import report
from registration_error import distance
from synthetic import RATE_HZ, flight
from tune_recovery import BASE, FRAMES, SIZE, f, filmed

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import load_engine
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.tuning.registration import CHECK, RANSAC, family

FACTORS = {"three times": 3.0, "a third": 1 / 3}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--write", type=Path, help="a text with marks for the table")
    given = parser.parse_args()
    found: dict[str, list[list[float]]] = {name: [] for name in FACTORS}
    shipped = with_parameters(load_config(), BASE)
    for seed in range(given.seeds):
        with tempfile.TemporaryDirectory() as place:
            numbers = 2 * seed, 2 * seed + 1
            clips = [filmed(Path(place), number) for number in numbers]
            usual = [judged(clip, number, shipped) for clip, number in zip(clips, numbers, strict=True)]
            for name, factor in FACTORS.items():
                start = off_by(shipped, factor)
                tuned = descended(clips[0], start, seed, given.steps)
                row = [tuned.registration.ransac_px, tuned.registration.forward_backward_px]
                for clip, number, known in zip(clips, numbers, usual, strict=True):
                    row += [*known, *judged(clip, number, start), *judged(clip, number, tuned)]
                found[name].append(row)
                told = " ".join(f"{value:.3f}" for value in row)
                print(f"seed {seed}, {name}: {told}", file=sys.stderr, flush=True)
    lines = table(found)
    print("\n".join(lines))
    if given.write is not None:
        report.put(given.write, "tune_registration", "\n".join(lines))


def off_by(settings: Settings, factor: float) -> Settings:
    """Both parameters times a factor."""
    values = {RANSAC: settings.registration.ransac_px, CHECK: settings.registration.forward_backward_px}
    return with_parameters(settings, {name: TUNABLE[name].rounded(value * factor) for name, value in values.items()})


def descended(clip: Clip, start: Settings, seed: int, steps: int) -> Settings:
    """What the masks of a clip make of both parameters."""
    plan = Plan(steps=steps, batch=4, rate=0.15, seed=seed, most_watched=4)
    learned = family()
    return descend(learned, Parameters(start, [RANSAC, CHECK]), learned.examples([clip], start), plan).settings


def judged(clip: Clip, seed: int, settings: Settings) -> tuple[float, float]:
    """Mean error of the registrations over the corners, px, and pixels' F of the hard pipeline."""
    maps = [view.image_from_ground for view in flight(seed, FRAMES, SIZE, RATE_HZ)]
    true = [later @ np.linalg.inv(earlier) for earlier, later in pairwise(maps)]
    engine = load_engine("onboard", settings)
    views = [engine.prepare(frame.image) for frame in open_clip(clip)]
    ours = [engine.register([pair])[0].later_from_earlier for pair in pairwise(views)]
    error_px = float(np.mean([distance(a, b, *SIZE) for a, b in zip(ours, true, strict=True)]))
    return error_px, f(clip, settings)


def table(found: dict[str, list[list[float]]]) -> list[str]:
    """Markdown: means over the seeds."""
    heads = "begins at | scene | corners, px: shipped | at the start | tuned | F: shipped | at the start | tuned"
    lines = [f"| {heads} | nearer than shipped |", "| --- | --- |" + " ---: |" * 7]
    for name, rows in found.items():
        rows_ = np.array(rows)
        for scene, first in (("learned from", 2), ("not learned from", 8)):
            px, share = rows_[:, first : first + 6 : 2], rows_[:, first + 1 : first + 6 : 2]
            cells = [*(f"{value:.3f}" for value in (*px.mean(axis=0), *share.mean(axis=0)))]
            nearer = f"{int((px[:, 2] < px[:, 0]).sum())} of {len(px)}"
            lines.append(f"| {name} | {scene} | {' | '.join(cells)} | {nearer} |")
    return [*lines, "", *(_values(name, np.array(rows)) for name, rows in found.items())]


def _values(name: str, rows: Sequence[float] | np.ndarray) -> str:
    spans = [np.quantile(np.asarray(rows)[:, k], (0.0, 0.5, 1.0)) for k in (0, 1)]
    told = (f"{parameter} {low:.2f} to {high:.2f}, median {middle:.2f}" for parameter, (low, middle, high) in
            zip(("ransac_px", "forward_backward_px"), spans, strict=True))  # fmt: skip
    return f"From {name}: {'; '.join(told)}."


if __name__ == "__main__":
    main()
