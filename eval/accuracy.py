"""Accuracy beside the plain OpenCV chain: `python eval/accuracy.py DATA_FOLDER [--configs default,fast,source]`.

DATA_FOLDER holds clips: folders with frames/ and masks/ (PNG, 0 background, each other value one mover, any subset of
the frames), or boxes_xywh.txt (one target a frame, other movers unlabelled), or neither (nothing moves: every blob is
false). Detection runs in this process on every clip; pixel figures are pooled over a clip's frames. Prints tables in
Markdown; `--write README.md` puts them between that file's accuracy marks. The same every time it is run.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import plain_chain
import report

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.evaluation.metrics import boxes as detection
from torchvision_dddas.evaluation.metrics import pixels as segmentation
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.boxes import Boxes, OneTarget
from torchvision_dddas.evaluation.metrics.pixels import Pixels
from torchvision_dddas.io.sources import open_source

Found = tuple[np.ndarray, np.ndarray]
Figures = dict[str, float]


def main() -> None:
    """Score every clip with every chain and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--configs", default="default,fast,source", help="default, shipped names or TOML files")
    parser.add_argument("--backend", default="onboard")
    parser.add_argument("--only", default="", help="clips whose name contains this")
    parser.add_argument("--json", type=Path, help="write all figures here")
    parser.add_argument("--write", type=Path, help="a text file with the accuracy marks, such as README.md")
    options = parser.parse_args()
    places = [p for p in _clips(options.folder) if options.only in p.name]
    if not places:
        sys.exit(f"{options.folder} holds no clips: wanted folders with frames/; nothing was measured")
    chains = {"plain": by_plain}
    chains |= {name: by_us(name, options.backend) for name in options.configs.split(",")}
    scores: dict[str, dict[str, Figures]] = {}
    for place in places:
        scores[place.name] = {}
        for name, chain in chains.items():
            scores[place.name][name] = score(place, chain)
            print(place.name, name, _words(scores[place.name][name]), file=sys.stderr, flush=True)
    text = tables(scores, list(chains))
    print(text)
    if options.json:
        options.json.write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")
    if options.write:
        report.put(options.write, "accuracy", text)


def _clips(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if (p / "frames").is_dir()) if folder.is_dir() else []


# -- chains: a clip's folder -> (mask, boxes (N, 4)) of every frame --------------------------------------------------


def by_us(config: str, backend: str) -> Callable[[Path], Iterator[Found]]:
    """This package under a configuration."""
    settings = load_config(None if config == "default" else config)

    def chain(place: Path) -> Iterator[Found]:
        for scene in detect_motion(open_source(place / "frames"), settings, backend):
            yield scene.mask, scene.detections.box_px

    return chain


def by_plain(place: Path) -> Iterator[Found]:
    """The plain chain on each frame and its next two; the last two frames look back."""
    files = sorted((place / "frames").iterdir())
    images = [cv2.imread(str(file)) for file in files]
    for i in range(len(images)):
        step = 1 if i + 2 < len(images) else -1
        yield plain_chain.plain_window(images[i], images[i + step], images[i + 2 * step])


# -- figures ---------------------------------------------------------------------------------------------------------


def score(place: Path, chain: Callable[[Path], Iterator[Found]]) -> Figures:
    """The figures of one clip: of masks, of one labelled target, or of a clip where nothing moves."""
    truth = truths.load(place) if truths.find(place) else None
    pixels, boxes, target, blobs, frames = Pixels(), Boxes(), OneTarget(), 0, 0
    for number, (mask, found) in enumerate(chain(place), 1):
        frames, blobs = number, blobs + len(found)
        if truth is None:
            continue
        if number in truth.masks:
            labels = truths.read_mask(truth.masks[number])
            pixels = pixels.plus(segmentation.count(mask, labels))
            boxes = boxes.plus(detection.match(found, detection.boxes_of(labels)))
        elif number in truth.boxes:
            target = target.plus(detection.one_target(mask, found, truth.boxes[number][0]))
    if truth is None:
        return {"frames": frames, "still": blobs / frames}
    if truth.masks:
        figures = segmentation.measures(pixels)
        return {"frames": len(truth.masks), **figures, "box_f1": detection.measures(boxes)["f1"]}
    return {"frames": target.frames, **detection.one_target_measures(target)}


def tables(scores: dict[str, dict[str, Figures]], chains: Sequence[str]) -> str:
    """Markdown: F and box F1 of each clip with masks, the means over clips of a set, and the other clips."""
    rows, masked = [], {clip: by for clip, by in scores.items() if "f" in by[chains[0]]}
    others = {clip: by for clip, by in scores.items() if clip not in masked}
    if masked:
        rows += ["F of pixels / F1 of boxes at IoU 0.5:", "", *_head("clip", chains)]
        for clip, by in masked.items():
            rows.append(_row(clip, [f"{_two(by[c]['f'])} / {_two(by[c]['box_f1'])}" for c in chains]))
        rows += ["", "Means over the clips of a set:", "", *_head("set, measure", chains)]
        for name, clips in _sets(masked).items():
            for measure, word in (
                ("precision", "precision"),
                ("recall", "recall"),
                ("f", "F"),
                ("gmean", "Gmean"),
                ("box_f1", "box F1"),
            ):
                means = [float(np.mean([masked[clip][c][measure] for clip in clips])) for c in chains]
                rows.append(_row(f"{name}, {word}", [_two(m) for m in means]))
            rows.append(_row(f"{name}, worst F", [_two(min(masked[clip][c]["f"] for clip in clips)) for c in chains]))
        rows.append("")
    if others:
        rows += ["One labelled target: hit / box IoU ≥ 0.3 / other blobs a frame:", "", *_head("clip", chains)]
        for clip, by in others.items():
            still = "still" in by[chains[0]]
            rows.append(_row(f"{clip}{' (nothing moves)' if still else ''}", [_words(by[c]) for c in chains]))
        rows.append("")
    return "\n".join(rows)


def _sets(clips: Sequence[str] | dict) -> dict[str, list[str]]:
    """Clips by what stands before the underscore in their names."""
    sets: dict[str, list[str]] = {}
    for clip in clips:
        sets.setdefault(clip.split("_")[0], []).append(clip)
    return sets


def _words(figures: Figures) -> str:
    if "still" in figures:
        return f"– / – / {figures['still']:.1f}"
    if "hit" in figures:
        hit, near, other = figures["hit"], figures["iou_0.3"], figures["other_blobs_per_frame"]
        return f"{_two(hit)} / {_two(near)} / {other:.1f}"
    return f"F {figures['f']:.3f}, box F1 {figures['box_f1']:.3f}"


def _two(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def _head(first: str, chains: Sequence[str]) -> list[str]:
    return [_row(first, chains), "| --- " + "| ---: " * len(chains) + "|"]


def _row(first: str, cells: Sequence[str]) -> str:
    return f"| {first} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    cv2.setNumThreads(2)
    main()
