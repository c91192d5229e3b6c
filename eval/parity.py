"""Do both back ends see the same? `python eval/parity.py DATA_FOLDER [CONFIG]`, a folder of clips (videos or images).

Per clip: corner error of the registrations of successive frames (median, worst, and how often only one engine trusts
its own), IoU of the core masks (mean, least), each engine with its own registrations, IoU of the final masks (pooled
over the clip, least frame), and the time a frame for registration and foreground relative to onboard, batch 1 and 8.
"""

import argparse
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas import config as parameters
from torchvision_dddas.detection import Engine, View, Window, detect_motion, load_engine, windows
from torchvision_dddas.geometry import chain, corner_error
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.types import Frame, Registration

VIDEOS = {".mp4", ".avi", ".mkv", ".mov"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a folder whose folders are clips: a video, images, or `frames/`")
    parser.add_argument("config", nargs="?", help="a configuration, such as fast; the defaults otherwise")
    parser.add_argument("--frames", type=int, default=60, help="at most so many frames a clip")
    parser.add_argument("--only", help="clips whose name contains this")
    parser.add_argument("--no-masks", action="store_true", help="leave the final masks out")
    chosen = parser.parse_args()
    settings = parameters.load_config(chosen.config)
    print(
        "clip | corner error px: median worst, one-sided | core IoU: mean least | mask IoU: pooled least | time: b1 b8"
    )
    for path in sorted(chosen.folder.iterdir()):
        clip = _clip(path)
        if clip is None or (chosen.only and chosen.only not in path.name):
            continue
        frames = [frame for frame, _ in zip(open_source(clip), range(chosen.frames), strict=False)]
        print(path.name, "|", *compare(frames, settings, not chosen.no_masks), flush=True)


def compare(frames: Sequence[Frame], settings: parameters.Settings, masks: bool) -> list[str]:
    """The figures of one clip, as words."""
    engines = [load_engine("onboard", settings), load_engine("torch", settings)]
    images = [frame.image for frame in frames]
    onboard, single, batched = Look(engines[0], images, 1), Look(engines[1], images, 1), Look(engines[1], images, 8)
    size = images[0].shape[1], images[0].shape[0]
    both = [(a, b) for a, b in zip(onboard.steps, batched.steps, strict=True) if a.reliable and b.reliable]
    one_sided = sum(a.reliable != b.reliable for a, b in zip(onboard.steps, batched.steps, strict=True))
    errors = [corner_error(a.later_from_earlier, b.later_from_earlier, size) for a, b in both] or [np.nan]
    cores = [iou(onboard.cores[t], batched.cores[t]) for t in onboard.cores if t in batched.cores] or [np.nan]
    words = [f"{np.median(errors):.3f} {max(errors):.3f} {one_sided}/{len(onboard.steps)} |"]
    words += [f"{np.mean(cores):.3f} {min(cores):.3f} |"]
    if masks:
        found = [[scene.mask > 0 for scene in detect_motion(frames, settings, engine)] for engine in engines]
        least = min(iou(a, b) for a, b in zip(*found, strict=True))
        words += [f"{iou(np.array(found[0]), np.array(found[1])):.3f} {least:.3f} |"]
    for name in ("register", "foreground"):
        base = onboard.seconds[name]
        words += [f"{name} {1000 * base:.1f} ms"]
        words += [f"x{other.seconds[name] / base:.2f}" for other in (single, batched)]
    return words


class Look:
    """What one engine makes of a clip.

    steps: registrations of successive frames. cores: by frame index. seconds: median a frame, for each stage.
    """

    def __init__(self, engine: Engine, images: Sequence[np.ndarray], batch: int) -> None:
        settings: parameters.Settings = engine.parameters  # type: ignore[attr-defined]
        views = [engine.prepare(image) for image in images]
        pairs = list(pairwise(views))
        self.steps: list[Registration] = []
        self.cores: dict[int, np.ndarray] = {}
        spent: dict[str, list[float]] = {"register": [], "foreground": []}
        for first in range(0, len(pairs), batch):
            some = pairs[first : first + batch]
            start = time.perf_counter()
            self.steps += engine.register(some)
            spent["register"].append((time.perf_counter() - start) / len(some))
        made = [(t, window) for t in range(len(views)) if (window := _window(views, self.steps, t, settings))]
        for first in range(0, len(made), batch):
            part = made[first : first + batch]
            start = time.perf_counter()
            found = engine.foreground([window for _, window in part])
            spent["foreground"].append((time.perf_counter() - start) / len(part))
            self.cores |= {t: foreground.core > 0 for (t, _), foreground in zip(part, found, strict=True)}
        self.seconds = {name: float(np.median(times)) if times else np.nan for name, times in spent.items()}


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of Boolean masks; 1 where both are empty."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def _window(
    views: Sequence[View], steps: Sequence[Registration], at: int, settings: parameters.Settings, interval: int = 3
) -> Window | None:
    first = last = at
    while first and steps[first - 1].reliable:
        first -= 1
    while last < len(steps) and steps[last].reliable:
        last += 1
    near, wide, small = windows.pairs(at, interval, first, last, settings)
    if not near:
        return None
    used = sorted({i for pair in (*near, wide, small) if pair for i in pair})

    def matrix(other: int) -> np.ndarray:
        forward = chain([step.later_from_earlier for step in steps[min(at, other) : max(at, other)]])
        return forward if other > at else np.linalg.inv(forward)

    def place(pair: tuple[int, int]) -> tuple[int, int]:
        return used.index(pair[0]), used.index(pair[1])

    return Window(
        views[at],
        tuple(views[i] for i in used),
        np.array([matrix(i) for i in used]),
        tuple(i - at for i in used),
        tuple(place(pair) for pair in near),
        place(wide) if wide else None,
        place(small) if small else None,
    )


def _clip(path: Path) -> Path | None:
    """The clip of one entry of the folder, if it is one."""
    if not path.is_dir():
        return path if path.suffix in VIDEOS else None
    if (path / "frames").is_dir():
        return path / "frames"
    return next((file for file in sorted(path.iterdir()) if file.suffix in VIDEOS), path)


if __name__ == "__main__":
    cv2.setNumThreads(2)
    main()
