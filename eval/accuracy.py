"""Measure the accuracy of moving targets beside the plain OpenCV chain: `python eval/accuracy.py DATA`.

DATA holds clips: folders with frames/ and masks/ (PNG, 0 is background, every other value is one mover, for any subset
of the frames), or with boxes_xywh.txt (one target per frame, other movers unlabelled), or with neither (nothing moves,
so every blob is false). Pixel counts are pooled over a clip. Boxes match at an IoU of 0.5. For one labelled target, a
hit is a frame in which more than a tenth of its box is foreground. An other blob has an IoU below 0.05 with the
target's box. The figures are the same in every run on one machine.

The source's difference shows a mover at its place in the middle of three frames. The columns "at t + Δt" score the
masks there: the registration moves them from frame t to frame t + Δt.

--six adds the source's six measures of each clip (appendix B, Table 1 and Fig. 7a).
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import bench
import cv2
import numpy as np
from clips import clips_in

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.geometry import chain
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.benchmark import plain_chain
from torchvision_dddas.lab.evaluation.metrics import boxes as box_metrics
from torchvision_dddas.lab.evaluation.metrics import pixels as pixel_metrics
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.boxes import BoxCounts, OneTarget
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels, add_counts
from torchvision_dddas.types import Scene

Found = tuple[np.ndarray, np.ndarray]
"""Mask (H, W) and boxes (N, 4) of a frame."""
Chain = Callable[[Path], Iterator[Found | None]]
Figures = dict[str, float]
MEASURES = {"precision": "precision", "recall": "recall", "f": "F", "gmean": "Gmean", "box_f1": "box F1"}
SIX = {
    "accuracy": "accuracy",
    "specificity": "specificity",
    "precision": "precision",
    "recall": "recall",
    "f": "F",
    "gmean": "Gmean",
}


def measure_accuracy(options: bench.Options) -> tuple[str, dict[str, dict[str, Figures]]]:
    """Score every clip with the plain chain and with every configuration."""
    cv2.setNumThreads(2)
    chains: dict[str, Chain] = {"plain": run_plain}
    chains |= {name: partial(run_ours, config=name, backend=options.backend) for name in options.configs}
    later = [name for name in options.configs if name != "default" and is_drawn_later(load_config(name))]
    chains |= {f"{name} at t + Δt": partial(run_moved, config=name, backend=options.backend) for name in later}
    scores: dict[str, dict[str, Figures]] = {}
    for place in clips_in(options.data, options.only):
        if (place / "truth.json").exists():  # all boxes are labelled, so `tracklets.py` scores the clip
            continue
        scores[place.name] = {}
        for name, run in chains.items():
            scores[place.name][name] = score(place, run)
            bench.log(place.name, name, format_figures(scores[place.name][name]))
    text = format_tables(scores, list(chains))
    return f"{text}\n\n{format_six(scores, list(chains))}" if options.six else text, scores


def run_ours(place: Path, config: str, backend: str) -> Iterator[Found]:
    """Yield the mask and boxes of every frame by this package with a configuration."""
    settings = load_config(None if config == "default" else config)
    for scene in detect_motion(open_source(place / "frames"), settings, backend):
        yield scene.mask, scene.detections.box_px


def is_drawn_later(settings: Settings) -> bool:
    """Return whether masks show the movers at their places in a later frame."""
    return settings.difference.kind == "between_later"


def run_moved(place: Path, config: str, backend: str) -> Iterator[Found | None]:
    """Yield the mask and boxes of every frame at the places where the source draws them, or None."""
    scenes = list(detect_motion(open_source(place / "frames"), load_config(config), backend))
    moved = move_later(scenes)
    yield from (moved.get(at) for at in range(len(scenes)))


def move_later(scenes: Sequence[Scene]) -> dict[int, Found]:
    """Return {frame index: mask and boxes of the reference one interval earlier, moved to the frame}."""
    moved: dict[int, Found] = {}
    for at, scene in enumerate(scenes):
        middle, last = at + scene.interval_frames, at + 2 * scene.interval_frames
        steps = [later.step for later in scenes[at + 1 : middle + 1]]
        if last >= len(scenes) or not scene.reliable or any(step is None for step in steps):
            continue
        later_from_earlier = chain([step.later_from_earlier for step in steps if step is not None])
        size = scene.mask.shape[1], scene.mask.shape[0]
        mask = cv2.warpPerspective(scene.mask.astype(np.uint8), later_from_earlier, size, flags=cv2.INTER_NEAREST)
        moved[middle] = mask > 0, cv2.connectedComponentsWithStats(mask)[2][1:, :4].astype(float)
    return moved


def run_plain(place: Path) -> Iterator[Found]:
    """Yield the plain chain's mask and boxes of each frame and its next two. The last two frames look back."""
    images = [cv2.imread(str(file)) for file in sorted((place / "frames").iterdir())]
    for i in range(len(images)):
        step = 1 if i + 2 < len(images) else -1
        yield plain_chain.plain_window(images[i], images[i + step], images[i + 2 * step])


def score(place: Path, run: Chain) -> Figures:
    """Score a clip with masks, with one labelled target, or without movers."""
    truth = truths.load_truth(place) if truths.find_truth(place) else None
    pixels, boxes, target, blobs, frames = Pixels(), BoxCounts(), OneTarget(), 0, 0
    of_frames = []
    for number, both in enumerate(run(place), 1):
        if both is None:
            continue
        mask, found = both
        frames, blobs = number, blobs + len(found)
        if truth is None:
            continue
        if number in truth.masks:
            labels = truths.read_mask(truth.masks[number])
            of_frames.append(pixel_metrics.count(mask, labels))
            boxes = add_counts(boxes, box_metrics.match(found, box_metrics.boxes_of(labels)))
        elif number in truth.boxes:
            target = add_counts(target, box_metrics.one_target(mask, found, truth.boxes[number][0]))
    if truth is None:
        return {"frames": frames, "still": blobs / frames}
    if truth.masks:
        for counts in of_frames:
            pixels = add_counts(pixels, counts)
        each = [pixel_metrics.measures(counts) for counts in of_frames]
        spread = {f"{m}_sd": float(np.nanstd([one[m] for one in each], ddof=1)) for m in SIX} if len(each) > 1 else {}
        box_f1 = box_metrics.measures(boxes)["f1"]
        return {"frames": len(each), **pixel_metrics.measures(pixels), "box_f1": box_f1, **spread}
    return {"frames": target.frames, **box_metrics.one_target_measures(target)}


def format_tables(scores: dict[str, dict[str, Figures]], chains: Sequence[str]) -> str:
    """Format F and box F1 of each clip with masks, their means over the clips of a set, and the other clips."""
    masked = {clip: by for clip, by in scores.items() if "f" in by[chains[0]]}
    others = {clip: by for clip, by in scores.items() if clip not in masked}
    parts = []
    if masked:
        rows = [[clip, *(f"{two(by[c]['f'])} / {two(by[c]['box_f1'])}" for c in chains)] for clip, by in masked.items()]
        parts += ["F of pixels / F1 of boxes at IoU 0.5:", bench.format_table(["clip", *chains], rows)]
        rows = []
        for name in dict.fromkeys(clip.split("_")[0] for clip in masked):
            of_set = [by for clip, by in masked.items() if clip.split("_")[0] == name]
            for measure, word in MEASURES.items():
                rows.append(
                    [f"{name}, {word}", *(two(float(np.mean([by[c][measure] for by in of_set]))) for c in chains)]
                )
            rows.append([f"{name}, worst F", *(two(min(by[c]["f"] for by in of_set)) for c in chains)])
        parts += ["Means over the clips of a set:", bench.format_table(["set, measure", *chains], rows)]
    if others:
        still = {clip: " (nothing moves)" * ("still" in by[chains[0]]) for clip, by in others.items()}
        rows = [[clip + still[clip], *(format_figures(by[c]) for c in chains)] for clip, by in others.items()]
        parts += ["One labelled target: hit / box IoU ≥ 0.3 / other blobs a frame:"]
        parts += [bench.format_table(["clip", *chains], rows)]
    return "\n\n".join(parts)


def format_six(scores: dict[str, dict[str, Figures]], chains: Sequence[str]) -> str:
    """Format the six measures of each clip with masks, pooled over labelled frames, and their spread over frames."""
    rows = []
    for clip, by in scores.items():
        for name in chains:
            if "f" not in (found := by[name]):
                continue
            cells = [
                f"{found[m]:.3f} ({found[f'{m}_sd']:.3f})" if found["frames"] > 1 else f"{found[m]:.3f}" for m in SIX
            ]
            rows.append([clip, name, str(found["frames"]), *cells])
    head = ["clip", "chain", "frames", *SIX.values()]
    table = bench.format_table(head, rows, words=2)
    return f"The six measures, in brackets their standard deviation over the labelled frames:\n\n{table}"


def format_figures(figures: Figures) -> str:
    """Format a clip's figures for a table cell."""
    if "still" in figures:
        return f"– / – / {figures['still']:.1f}"
    if "hit" in figures:
        return f"{two(figures['hit'])} / {two(figures['iou_0.3'])} / {figures['other_blobs_per_frame']:.1f}"
    return f"F {figures['f']:.3f}, box F1 {figures['box_f1']:.3f}"


def two(value: float) -> str:
    """Format a value with two digits, or a dash for a missing value."""
    return "–" if np.isnan(value) else f"{value:.2f}"


if __name__ == "__main__":
    options = {"data": Path, "--configs": ["default", "fast", "source"], "--backend": "onboard", "--only": ""}
    options |= {"--six": False}
    bench.main(__doc__, {"": (measure_accuracy, options)})
