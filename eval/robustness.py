"""Measure detection with jumps of the exposure, and the accuracy of the registration alone.

python eval/robustness.py exposure DATA [--config fast]
python eval/robustness.py registration DATA
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
from clips import clips_in, read_frames

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection import detect_motion, load_engine
from torchvision_dddas.geometry import transfer
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.benchmark import plain_chain
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels, add_counts, count, measures
from torchvision_dddas.types import Frame

KINDS = ("as it is", "steps", "flashes", "flicker")
LEVELS = (0.85, 1.0, 1.15)
JUMPS = {"steps": 0.2, "flashes": 0.2, "flicker": 1.0}
"""Probability of a jump of the gain at a frame."""


def measure_exposure(options: bench.Options) -> tuple[str, Any]:
    """Measure F of clips with masks when the exposure jumps.

    The clips are used unchanged; with a lasting jump of the gain to 1.15, 1 or 0.85 at about every fifth frame (steps);
    with single lighter or darker frames (flashes); and with a jump at every frame (flicker). Frames are multiplied,
    rounded and clipped at 255. The jumps are drawn from a fixed seed.
    """
    cv2.setNumThreads(2)
    settings, found = load_config(options.config), {}
    for clip in clips_in(options.data, options.only):
        if not (clip / "masks").is_dir():
            continue
        truth, frames = truths.load_truth(clip), list(open_source(clip / "frames"))
        found[clip.name] = {
            kind: score(change_exposure(frames, draw_gains(len(frames), kind, options.seed)), truth, settings)
            for kind in KINDS
        }
        bench.log(clip.name, found[clip.name])
    head = ["clip", "F as it is", *(f"{kind}: F (loss)" for kind in KINDS[1:]), "unreliable frames"]
    rows = []
    for name, by in found.items():
        first = by["as it is"][0]
        cells = [f"{by[kind][0]:.3f} ({first - by[kind][0]:+.3f})" for kind in KINDS[1:]]
        rows.append([name, f"{first:.3f}", *cells, ", ".join(str(by[kind][1]) for kind in KINDS)])
    means = [np.mean([by[kind][0] for by in found.values()]) for kind in KINDS]
    rows.append(["mean", f"{means[0]:.3f}", *(f"{mean:.3f} ({means[0] - mean:+.3f})" for mean in means[1:]), ""])
    return bench.format_table(head, rows), found


def draw_gains(frames: int, kind: str, seed: int) -> np.ndarray:
    """Draw the gain (frames,) of each frame."""
    random = np.random.default_rng(seed)
    gain = np.ones(frames)
    if kind == "as it is":
        return gain
    for i in range(1, frames):
        jumps = random.random() < JUMPS[kind]
        if kind != "flashes":
            gain[i] = random.choice([g for g in LEVELS if g != gain[i - 1]]) if jumps else gain[i - 1]
        elif jumps and gain[i - 1] == 1.0:
            gain[i] = random.choice([LEVELS[0], LEVELS[-1]])
    return gain


def change_exposure(frames: Sequence[Frame], gain: np.ndarray) -> list[Frame]:
    """Return the frames multiplied by their gains."""
    pairs = zip(frames, gain, strict=True)
    return [replace(f, image=np.clip(np.round(f.image * g), 0, 255).astype(np.uint8)) for f, g in pairs]


def score(frames: Sequence[Frame], truth: truths.ClipTruth, settings: Settings) -> tuple[float, int]:
    """Return F over the labelled frames, and the number of unreliable frames."""
    pixels, unreliable = Pixels(), 0
    for scene in detect_motion(frames, settings, "onboard"):
        unreliable += not scene.reliable
        if path := truth.masks.get(scene.frame.number):
            pixels = add_counts(pixels, count(scene.mask, truths.read_mask(path)))
    return measures(pixels)["f"], unreliable


def measure_registration(options: bench.Options) -> tuple[str, Any]:
    """Measure the distance of registrations from a careful registration: mean over the picture's corners, px.

    The careful registration tracks up to 3000 corners to the other frame and back in a wide window to 0.001 px. It
    finds the background by MAGSAC and fits the inliers three times with decreasing tolerance. Pairs are one and two
    frames apart. Our registrations over two frames are composed of two steps, as in the detector.
    """
    found = {
        clip.name: registration_errors(read_frames(clip / "frames")) for clip in clips_in(options.data, options.only)
    }
    rows = [[clip, *(f"{e['median']:.3f} ({e['p90']:.3f})" for e in by.values())] for clip, by in found.items()]
    head = ["median (90th percentile), px", "plain", "fast", "default"]
    return bench.format_table(head, rows), found


def registration_errors(
    frames: list[np.ndarray], configs: tuple[str, ...] = ("fast", "default")
) -> dict[str, dict[str, float]]:
    """Return {"plain": {"median", "p90", "pairs"}, "fast": ..., "default": ...} over all pairs of a clip."""
    greys = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames]
    apart = [(i, i + gap) for gap in (1, 2) for i in range(len(greys) - gap)]
    tried = {(a, b): register_carefully(greys[a], greys[b]) for a, b in apart}
    careful = {pair: found for pair, found in tried.items() if found is not None}
    known = list(careful)
    found = {"plain": {pair: np.linalg.inv(register_plainly(greys[pair[0]], greys[pair[1]])) for pair in known}}
    for config in configs:
        steps = register_onboard(frames, config)
        found[config] = {(a, b): np.linalg.multi_dot([np.eye(3), *steps[a:b][::-1]]) for a, b in known}
    height, width = greys[0].shape
    table = {}
    for name, ours in found.items():
        off = [corner_distance(ours[pair], careful[pair], width, height) for pair in known]
        table[name] = {"median": float(np.median(off)), "p90": float(np.percentile(off, 90)), "pairs": len(off)}
    return table


def register_plainly(grey: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Return grey_from_later of the plain chain."""
    return plain_chain.register(grey, later, plain_chain.keypoints(grey))


def register_onboard(frames: list[np.ndarray], config: str) -> list[np.ndarray]:
    """Return later_from_earlier of successive frames."""
    engine = load_engine("onboard", load_config(None if config == "default" else config))
    views = [engine.prepare(frame) for frame in frames]
    return [engine.register([pair])[0].later_from_earlier for pair in pairwise(views)]


def register_carefully(grey: np.ndarray, later: np.ndarray) -> np.ndarray | None:
    """Return later_from_grey, or None if fewer than 50 points agree."""
    start: Any = cv2.goodFeaturesToTrack(grey, 3000, 0.001, 5, blockSize=5)
    if start is None:
        return None
    search: dict[str, Any] = {"winSize": (31, 31), "maxLevel": 5, "criteria": (3, 100, 1e-3)}
    end, there, _ = cv2.calcOpticalFlowPyrLK(grey, later, start, start.copy(), **search)
    back, again, _ = cv2.calcOpticalFlowPyrLK(later, grey, end, start.copy(), **search)
    good = (there[:, 0] == 1) & (again[:, 0] == 1) & (np.linalg.norm(back - start, axis=2)[:, 0] < 0.3)
    start, end = start[good, 0].astype(np.float64), end[good, 0].astype(np.float64)
    if len(start) < 50:
        return None
    found: Any = cv2.findHomography(start, end, cv2.USAC_MAGSAC, 2.0, maxIters=10_000, confidence=0.9999)[0]
    for tolerance in (2.0, 1.0, 0.5):
        if found is None:
            return None
        near = np.linalg.norm(transfer(found, start) - end, axis=1) < tolerance
        if near.sum() < 50:
            return None
        found = cv2.findHomography(start[near], end[near], 0)[0]
    return found


def corner_distance(a: np.ndarray, b: np.ndarray, width: int, height: int) -> float:
    """Return the mean distance of two homographies over the corners of a picture, px."""
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)
    return float(np.linalg.norm(transfer(a, corners) - transfer(b, corners), axis=1).mean())


if __name__ == "__main__":
    studies = {
        "exposure": (measure_exposure, {"data": Path, "--config": None, "--only": "", "--seed": 0}),
        "registration": (measure_registration, {"data": Path, "--only": ""}),
    }
    bench.main(__doc__, studies)
