"""The constants that the source's text leaves open: `python eval/source_search.py DATA`.

Every point of a grid is scored on the clips with masks whose name begins with `bms_`: the mask of reference t against
the truth of frame t + Δt, the middle one of the three, where equation 9 draws a mover (moved to frame t by the
registration), and against the truth of frame t. The rule of choice: of the points whose mean Gmean at t + Δt is at
least .90 the one of the best mean F there; where none is, the best mean Gmean. It was made after an earlier search on
the same clips, so figures of clips left out are a little too good. Each clip is also scored
with the point that the other clips choose.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import bench
import cv2
import numpy as np
from clips import clips_in

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import load_engine
from torchvision_dddas.detection.blobs import clean_silhouette, find_blobs
from torchvision_dddas.detection.engine import Window
from torchvision_dddas.evaluation.metrics import pixels as pixel_metrics
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.pixels import Pixels, add_counts
from torchvision_dddas.geometry import chain
from torchvision_dddas.io.sources import open_source

GRID: dict[str, tuple[int, ...]] = {
    "interval.frames": (1, 2, 3),
    "difference.threshold": (10, 14, 20),
    "difference.blur_px": (3, 5),
    "morphology.erode_px": (2, 3),
    "morphology.dilate_px": (9, 13, 17, 21, 25),
    "gates.min_area_px": (1, 200),
}
LEAST_GMEAN = 0.90
Point = tuple[int, ...]
Scores = dict[tuple[Point, str, str], dict[str, float]]
"""Measures by point, clip, and frame of the truth: middle or reference."""


@dataclass(frozen=True)
class Labelled:
    """A difference of eq. 9, (H, W) uint8, and the truth in the frame of its reference."""

    difference: np.ndarray
    truth: np.ndarray
    where: str


def search(options: bench.Options) -> tuple[str, dict[str, dict[str, float]]]:
    """Score the grid, choose, and leave each clip out in turn."""
    cv2.setNumThreads(1)
    base = load_config("source")
    places = clips_in(options.data, "bms_")
    scores: Scores = {}
    for place in places:
        for interval in GRID["interval.frames"]:
            frames = list(labelled_frames(place, with_parameters(base, {"interval.frames": interval})))
            for rest in product(*(values for name, values in GRID.items() if name != "interval.frames")):
                point = (interval, *rest)
                for where, measured in score(frames, with_parameters(base, parameters_of(point))).items():
                    scores[point, place.name, where] = measured
            bench.log(place.name, "interval", interval)
    clips = [place.name for place in places]
    return report(scores, clips)


def parameters_of(point: Point) -> dict[str, float]:
    """The settings of a point of the grid."""
    return {name: float(v) if name == "difference.threshold" else v for name, v in zip(GRID, point, strict=True)}


def labelled_frames(place: Path, settings: Settings) -> Iterator[Labelled]:
    """The differences of a clip that a label stands for, at the reference or in the middle."""
    engine, interval = load_engine("onboard", settings), settings.interval.frames
    views = [engine.prepare(frame.image) for frame in open_source(place / "frames")]
    steps = [step.later_from_earlier for step in engine.register(list(pairwise(views)))]
    truth = truths.load_truth(place)
    for number, path in sorted(truth.masks.items()):
        for where, at in (("reference", number - 1), ("middle", number - 1 - interval)):
            if at < 0 or at + 2 * interval >= len(views):
                continue
            ahead = [chain(steps[at : at + gap]) for gap in (interval, 2 * interval)]
            later = (views[at + interval], views[at + 2 * interval])
            offsets = (interval, 2 * interval)
            found = engine.foreground([Window(views[at], later, np.array(ahead), offsets, ((0, 1),))])[0]
            labels = truths.read_mask(path)
            if where == "middle":
                flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
                known = (labels >= 0).astype(np.uint8)
                moved = [
                    cv2.warpPerspective(m, ahead[0], labels.shape[::-1], flags=flags)
                    for m in (labels.astype(np.int16), known)
                ]
                labels = np.where(moved[1] > 0, moved[0], -1)
            yield Labelled(found.evidence, labels, where)


def score(frames: Sequence[Labelled], settings: Settings) -> dict[str, dict[str, float]]:
    """Measures of a clip by frame of the truth, pixel counts pooled."""
    counts = {"reference": Pixels(), "middle": Pixels()}
    difference, morphology = settings.difference, settings.morphology
    for frame in frames:
        above = cv2.threshold(frame.difference, int(difference.threshold), 255, cv2.THRESH_BINARY)[1]
        core = clean_silhouette(above, morphology, difference.blur_px)
        mask = np.zeros(core.shape, bool)
        for blob in find_blobs(core, frame.difference, difference.threshold, settings.gates.min_area_px, 0, False):
            x, y, width, height = blob.box
            mask[y : y + height, x : x + width] |= blob.mask
        counts[frame.where] = add_counts(counts[frame.where], pixel_metrics.count(mask, frame.truth))
    return {where: pixel_metrics.measures(pixels) for where, pixels in counts.items()}


def mean(scores: Scores, point: Point, clips: Sequence[str], where: str, measure: str) -> float:
    """The mean of a measure over clips."""
    return float(np.mean([scores[point, clip, where][measure] for clip in clips]))


def choose(scores: Scores, clips: Sequence[str]) -> Point:
    """The point that the rule chooses from some clips."""

    def value(point: Point) -> tuple[bool, float]:
        gmean = mean(scores, point, clips, "middle", "gmean")
        good = gmean >= LEAST_GMEAN
        return good, mean(scores, point, clips, "middle", "f") if good else gmean

    return max(dict.fromkeys(point for point, _, _ in scores), key=value)


def report(scores: Scores, clips: Sequence[str]) -> tuple[str, dict[str, dict[str, float]]]:
    """Tables of the choice, of the best points by Gmean, and of each clip left out; the figures that they show."""
    points = list(dict.fromkeys(point for point, _, _ in scores))
    at_reference = max(points, key=lambda p: mean(scores, p, clips, "reference", "gmean"))
    at_middle = max(points, key=lambda p: mean(scores, p, clips, "middle", "gmean"))
    rows, figures = [], {}
    shown = [("chosen", choose(scores, clips)), ("best Gmean at t + Δt", at_middle), ("best Gmean at t", at_reference)]
    for name, point in shown:
        by = {f"{m}_{w}": mean(scores, point, clips, w, m) for w in ("middle", "reference") for m in ("gmean", "f")}
        figures[name] = parameters_of(point) | by
        rows.append([name, ", ".join(f"{v:g}" for v in point), *(f"{v:.3f}" for v in by.values())])
    head = ["Gmean at t + Δt", "F at t + Δt", "Gmean at t", "F at t"]
    order = ", ".join(f"`{name}`" for name in GRID)
    parts = [f"Means over the clips; the constants are {order}:", bench.format_table(["", "constants", *head], rows)]
    rows, left = [], {}
    for clip in clips:
        point = choose(scores, [other for other in clips if other != clip])
        by = {f"{m}_{w}": scores[point, clip, w][m] for w in ("middle", "reference") for m in ("gmean", "f")}
        left[clip] = figures[f"left out: {clip}"] = parameters_of(point) | by
        rows.append([clip, ", ".join(f"{v:g}" for v in point), *(f"{v:.3f}" for v in by.values())])
    names = list(by)
    rows.append(["mean", "", *(f"{np.mean([one[name] for one in left.values()]):.3f}" for name in names)])
    parts += [
        "Each clip with the constants that the others choose:",
        bench.format_table(["clip", "constants", *head], rows),
    ]
    return "\n\n".join(parts), figures


if __name__ == "__main__":
    bench.main(__doc__, {"": (search, {"data": Path})})
