"""Do ellipses of people seen from the ground hold 95 %, once noise levels were tuned on another clip?

    python eval/tune_ranging.py DATA [--steps 80] [--every 5]

DATA is a folder of MOTChallenge 2015 sequences whose gt.txt has world metres: PETS09-S2L1 and TUD-Stadtmitte, with the
cameras of ranging_error.py. The boxes are those of the benchmark's detector (det/det.txt) that overlap a true one. The
parameters ground.feet_sigma, height_sigma and body_height_sigma_m are tuned on one clip and judged on the other by the
hard ranging; also on the first half of a clip and judged on the second. Prints Markdown.
"""

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from ranging_error import SIZES, People, detected, fitted, read_truth, seen, tsai

from torchvision_dddas.config import GroundParameters, Settings
from torchvision_dddas.evaluation.metrics.metres import inside
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.ground_examples import KNOBS, sighted
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.tuning.places import family
from torchvision_dddas.types import Camera


def examples(name: str, people: People, camera: Camera) -> list[Example]:
    """A picture each."""
    found = []
    for frame in np.unique(people.frame).tolist():
        rows = people.frame == frame
        one = sighted(camera, people.box_px[rows], people.cut[rows], people.east_north_m[rows])
        found.append(Example(name, frame, (one, Settings())))
    return found


def coverage(people: People, camera: Camera, parameters: GroundParameters) -> tuple[float, float, int]:
    """Share of people within their ellipses, median error in metres, and how many were placed."""
    found = seen(people, camera, parameters)
    off = found.east_north_m - people.east_north_m
    held = inside(off, found.covariance_m2)
    told = np.isfinite(held)
    return float(held[told].mean()), float(np.median(np.linalg.norm(off[told], axis=1))), int(told.sum())


def part(people: People, rows: np.ndarray) -> People:
    """Some of them."""
    return People(*(getattr(people, name)[rows] for name in ("frame", "box_px", "cut", "east_north_m")))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--every", type=int, default=5, help="frames from one that counts to the next")
    options = parser.parse_args()
    clips: dict[str, tuple[People, Camera]] = {}
    for name, size in SIZES.items():
        place = options.data / name
        if not (place / "det" / "det.txt").is_file():
            continue
        truth = read_truth(place, size)
        camera = tsai(place / "View_001.xml") if name.startswith("PETS") else fitted(truth, size)
        people = detected(place / "det" / "det.txt", 1, truth, size)
        clips[name] = part(people, people.frame % options.every == 0), camera
    if len(clips) < 2:
        sys.exit(f"{options.data} lacks one of {', '.join(SIZES)}; nothing was measured")
    heads = (
        "held out",
        "tuned on",
        "people",
        "inside before",
        "after",
        "median error before, after",
        "feet, height, body",
    )
    lines = [f"| {' | '.join(heads)} |", "| --- | --- |" + " ---: |" * 5]
    for name, (people, camera) in clips.items():
        other = next(key for key in clips if key != name)
        late = people.frame > np.median(people.frame)
        for label, on, held in (
            (other, examples(other, *clips[other]), people),
            ("its first half", examples(name, part(people, ~late), camera), part(people, late)),
        ):
            plan = Plan(steps=options.steps, batch=16, rate=0.1, look_every=10, patience=1000)
            tuned = descend(family(), Parameters(Settings(), KNOBS), on, plan).settings.ground
            before, after = coverage(held, camera, GroundParameters()), coverage(held, camera, tuned)
            values = f"{tuned.feet_sigma:g}, {tuned.height_sigma:g}, {tuned.body_height_sigma_m:g} m"
            shares = f"{100 * before[0]:.1f} % | {100 * after[0]:.1f} %"
            lines.append(f"| {name} | {label} | {after[2]} | {shares} | {before[1]:.2f}, {after[1]:.2f} m | {values} |")
            print(lines[-1], file=sys.stderr, flush=True)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
