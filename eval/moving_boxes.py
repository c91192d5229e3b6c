"""Measure the motion of a detector's boxes (`dddas run --detector MODEL --movers`), on rendered video with truth.

python eval/moving_boxes.py      correct decisions on moving and standing boxes, and the error of their speeds

The detector is perfect. It returns the true boxes of people and cars with at least FEWEST_PX visible pixels, and as
many boxes of the same sizes at random places without bodies (parked cars, for example). A body moves if its speed over
the ground is at least MOVING_PX per frame, and stands at STILL_PX or less. Other bodies do not count.
"""

from collections import defaultdict
from typing import Any

import bench
import cv2
import numpy as np
from scipy.ndimage import find_objects

from torchvision_dddas.geometry import project
from torchvision_dddas.lab.simulation import SimulatorSource, load_scenario
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.types import Detections, Frame, Truth

FEWEST_PX, MOVING_PX, STILL_PX = 12, 0.3, 0.05


def measure(options: bench.Options) -> tuple[str, Any]:
    """Measure, by scenario, the shares of correct boxes, movers without a box, and the error of speeds."""
    figures = {}
    for name in options.scenarios:
        told: dict[str, list[float]] = defaultdict(list)
        for seed in range(options.first, options.first + options.seeds):
            for key, values in watch(name, seed, options.seconds).items():
                told[key] += values
        figures[name] = told
    rows = []
    for name, told in figures.items():
        shares = [f"{100 * np.mean(told[k]):.1f} % ({len(told[k])})" if told[k] else "none" for k in KINDS]
        off = np.abs(told["speed"])
        rows.append(
            [name, *shares, f"{np.median(off):.2f}, {np.percentile(off, 90):.2f}", f"{np.mean(told['apart']):.2f}"]
        )
    head = ["scenario", *(f"{kind}: told right" for kind in KINDS), "error of speed, px a frame: median, 90 %"]
    text = bench.format_table([*head, "movers without a box, a frame"], rows)
    seeds = f"{options.first} to {options.first + options.seeds - 1}"
    return f"{text}\n\n{options.seconds:g} s each, seeds {seeds}; numbers of boxes in brackets.", figures


KINDS = ("moving", "standing", "of nobody")


def watch(name: str, seed: int, seconds: float) -> dict[str, list[float]]:
    """Return whether each box is correct, by kind; errors of speeds, px per frame; movers without a box, by frame."""
    cv2.setNumThreads(1)
    source = SimulatorSource(load_scenario(name, (f"clip.seconds={seconds}",), seed), name)
    rng, truths, speeds = np.random.default_rng(seed), dict[int, Truth](), dict[int, np.ndarray]()

    def detect(frame: Frame) -> Detections:
        truths.update((truth.frame, truth) for truth in source.truths())
        truth = truths[frame.number]
        box, speed = find_bodies(truth, source)
        free = box.copy()
        free[:, :2] = rng.uniform(0, np.maximum(1, np.array(source.size) - box[:, 2:]))
        shows = [truth.people[int(y) : int(y + h) + 1, int(x) : int(x + w) + 1].any() for x, y, w, h in free]
        free = free[~np.array(shows, bool)]
        speeds[frame.number] = np.r_[speed, np.full(len(free), np.nan)]
        boxes = np.concatenate([box, free])
        return Detections(boxes, np.ones(len(boxes)))

    told: dict[str, list[float]] = defaultdict(list)
    for result in Pipeline(detector=detect, movers=True)(source):
        true, found = speeds[result.number], result.tracked.detections.speed_px
        told["apart"].append(len(found) - len(true))
        for speed, said in zip(true, found, strict=False):
            if speed >= MOVING_PX:
                told["moving"].append(said > 0)
                told["speed"] += [said - speed] if said > 0 else []
            elif not speed > STILL_PX:
                told["of nobody" if np.isnan(speed) else "standing"].append(said == 0)
    return told


def find_bodies(truth: Truth, source: SimulatorSource) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes (N, 4) of the bodies in a picture, and speeds (N,) over the ground in pixels per frame."""
    bodies = truth.bodies
    ahead = bodies.place_m + np.c_[bodies.velocity_m_s / source.rate_hz, np.zeros(len(bodies))]
    step = project(ahead, truth.pose, source.camera) - project(bodies.place_m, truth.pose, source.camera)
    boxes, speed = [], []
    shown, places = np.bincount(truth.people.ravel()), find_objects(truth.people)
    for row, number in enumerate(bodies.number.tolist()):
        if number < len(shown) and shown[number] >= FEWEST_PX:
            rows, columns = places[number - 1]
            boxes.append([columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start])
            speed.append(float(np.hypot(*step[row])))
    return np.reshape(boxes, (-1, 4)).astype(float), np.array(speed)


if __name__ == "__main__":
    scenarios = ["joining", "movers", "village"]
    options = {"--scenarios": scenarios, "--first": 0, "--seeds": 2, "--seconds": 12.0}
    bench.main(__doc__, {"": (measure, options)})
