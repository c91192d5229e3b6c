"""What a jumping exposure costs: `python eval/gain.py DATA_FOLDER [CONFIG]`, for clips with `frames/` and `masks/`.

F over the pixels of a clip's labelled frames: as it is; with the gain of about every fifth frame jumping to 1.15, 1
or 0.85 and staying there (steps); with single frames so much lighter or darker (flashes); with a jump between any two
frames (flicker). Frames are multiplied, rounded and cut off at 255; the jumps are drawn from a fixed seed. Prints F and
the F that is lost, per clip and on average, and how many of the frames were not to be trusted.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas import config as parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.pixels import Pixels, count, measures
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.types import Frame

KINDS = ("as it is", "steps", "flashes", "flicker")
LEVELS = (0.85, 1.0, 1.15)
SHARES = {"steps": 0.2, "flashes": 0.2, "flicker": 1.0}


def main() -> None:
    """Print a line a clip, and the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("config", nargs="?", help="a configuration, such as fast; the defaults otherwise")
    parser.add_argument("--backend", default="onboard")
    parser.add_argument("--only", help="clips whose name contains this")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    settings = parameters.load_config(chosen.config)
    print("clip | F as it is | " + " | ".join(f"{kind}: F, lost" for kind in KINDS[1:]) + " | frames not trusted")
    rows = []
    for clip in sorted(chosen.folder.iterdir()):
        if not (clip / "frames").is_dir() or not (clip / "masks").is_dir() or (chosen.only or "") not in clip.name:
            continue
        truth = truths.load(clip)
        frames = list(open_source(clip / "frames"))
        found = [
            score(lit(frames, gains(len(frames), kind, chosen.seed)), truth, chosen.backend, settings) for kind in KINDS
        ]
        rows.append([f for f, _ in found])
        print(f"{clip.name} |", *_words(rows[-1]), *(lost for _, lost in found), flush=True)
    if rows:
        print("mean |", *_words(np.mean(rows, axis=0)))


def gains(frames: int, kind: str, seed: int) -> np.ndarray:
    """(frames,) the gain of each frame."""
    random = np.random.default_rng(seed)
    gain = np.ones(frames)
    if kind == "as it is":
        return gain
    for i in range(1, frames):
        jumps = random.random() < SHARES[kind]
        if kind != "flashes":
            gain[i] = random.choice([g for g in LEVELS if g != gain[i - 1]]) if jumps else gain[i - 1]
        elif jumps and gain[i - 1] == 1.0:
            gain[i] = random.choice([LEVELS[0], LEVELS[-1]])
    return gain


def lit(frames: Sequence[Frame], gain: np.ndarray) -> list[Frame]:
    """The frames multiplied by their gains, cut off at 255."""
    pairs = zip(frames, gain, strict=True)
    return [replace(f, image=np.clip(np.round(f.image * g), 0, 255).astype(np.uint8)) for f, g in pairs]


def score(
    frames: Sequence[Frame], truth: truths.Truth, backend: str, settings: parameters.Settings
) -> tuple[float, int]:
    """F over the labelled frames, and how many frames were not to be trusted."""
    pixels, untrusted = Pixels(), 0
    for scene in detect_motion(frames, settings, backend):
        untrusted += not scene.reliable
        if path := truth.masks.get(scene.frame.number):
            pixels = pixels.plus(count(scene.mask, truths.read_mask(path)))
    return measures(pixels)["f"], untrusted


def _words(f: Sequence[float]) -> list[str]:
    first, *others = f
    return [f"{first:.3f} |", *(f"{other:.3f} {first - other:+.3f} |" for other in others)]


if __name__ == "__main__":
    cv2.setNumThreads(2)
    main()
