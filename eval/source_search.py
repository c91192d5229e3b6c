"""Measure the source's detection chain (`--config source`) step by step, on clips with names that begin with `bms_`.

python eval/source_search.py search DATA     the constants that the source's text leaves open
python eval/source_search.py kernels DATA    the six measures by smoothing, erosion, dilation, and by the last two at
                                             once (appendix B, Fig. 8)
python eval/source_search.py steps DATA      Gmean after each step, at t and at t + Δt, by interval

The mask of reference t is scored against the truth of frame t + Δt (moved to frame t by the registration), because
equation 9 draws a mover at its place in the middle of three frames. It is also scored against the truth of frame t.
Pixel counts are pooled over a clip. Figures are means over the clips.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
from clips import clips_in

from torchvision_dddas.chain import DetectionChain, OpenCVOperations, Window
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import load_engine
from torchvision_dddas.detection.blobs import find_blobs
from torchvision_dddas.geometry import chain
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.evaluation.metrics import pixels as pixel_metrics
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels, add_counts

GRID: dict[str, tuple[int, ...]] = {
    "interval.frames": (1, 2, 3),
    "difference.threshold": (10, 14, 20),
    "difference.blur_px": (3, 5),
    "morphology.erode_px": (2, 3),
    "morphology.dilate_px": (9, 13, 17, 21, 25),
    "gates.min_area_px": (1, 200),
}
LEAST_GMEAN = 0.90
MEASURES = ("accuracy", "specificity", "precision", "recall", "f", "gmean")
NAMES = ("accuracy", "specificity", "precision", "recall", "F", "Gmean")
KERNELS: dict[str, tuple[int, ...]] = {
    "difference.blur_px": (1, 3, 5, 7, 9),
    "morphology.erode_px": (1, 2, 3, 4, 5),
    "morphology.dilate_px": (1, 5, 9, 13, 17, 25),
}
INTERVALS = (1, 2, 3, 4)
Point = tuple[int, ...]
Scores = dict[tuple[Point, str, str], dict[str, float]]
"""Measures by point, clip, and the truth's frame: middle or reference."""


@dataclass(frozen=True)
class Labelled:
    """A difference of eq. 9, (H, W) uint8, and the truth of frame `number`, mapped to the reference frame."""

    difference: np.ndarray
    truth: np.ndarray
    where: str
    number: int


def search(options: bench.Options) -> tuple[str, dict[str, dict[str, float]]]:
    """Search the constants that the source's text leaves open on a grid.

    The rule chooses the point with the best mean F among the points with a mean Gmean at t + Δt of at least .90, or the
    point with the best mean Gmean. The rule was made after an earlier search on the same clips, so figures of clips
    left out are slightly too good. Each clip is also scored with the point that the other clips choose.
    """
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
    """Return the settings of a point of the grid."""
    return {name: float(v) if name == "difference.threshold" else v for name, v in zip(GRID, point, strict=True)}


def labelled_frames(place: Path, settings: Settings) -> Iterator[Labelled]:
    """Yield the differences of a clip that have a label at the reference or at the middle frame."""
    engine, interval = load_engine("onboard", settings), settings.interval.frames
    views = [engine.prepare(frame.image) for frame in open_source(place / "frames")]
    steps = [step.later_from_earlier for step in engine.register(list(pairwise(views)))]

    def ahead_of(at: int, gap: int) -> np.ndarray:
        """Return the map from frame `at` to the frame `gap` later, by direct registration, or chained if that fails."""
        (step,) = engine.register([(views[at], views[at + gap])])
        return step.later_from_earlier if step.reliable else chain(steps[at : at + gap])

    truth = truths.load_truth(place)
    for number, path in sorted(truth.masks.items()):
        for where, at in (("reference", number - 1), ("middle", number - 1 - interval)):
            if at < 0 or at + 2 * interval >= len(views):
                continue
            ahead = [ahead_of(at, gap) for gap in (interval, 2 * interval)]
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
            yield Labelled(found.evidence, labels, where, number)


def score(frames: Sequence[Labelled], settings: Settings) -> dict[str, dict[str, float]]:
    """Return the measures of a clip by the truth's frame, with pooled pixel counts."""
    counts = {"reference": Pixels(), "middle": Pixels()}
    difference = settings.difference
    for frame in frames:
        core = DetectionChain(settings, OpenCVOperations()).find_core(frame.difference)
        mask = np.zeros(core.shape, bool)
        for blob in find_blobs(core, frame.difference, difference.threshold, settings.gates.min_area_px, 0, False):
            x, y, width, height = blob.box
            mask[y : y + height, x : x + width] |= blob.mask
        counts[frame.where] = add_counts(counts[frame.where], pixel_metrics.count(mask, frame.truth))
    return {where: pixel_metrics.measures(pixels) for where, pixels in counts.items()}


def mean(scores: Scores, point: Point, clips: Sequence[str], where: str, measure: str) -> float:
    """Return the mean of a measure over some clips."""
    return float(np.mean([scores[point, clip, where][measure] for clip in clips]))


def choose(scores: Scores, clips: Sequence[str]) -> Point:
    """Return the point that the rule chooses on some clips."""

    def value(point: Point) -> tuple[bool, float]:
        gmean = mean(scores, point, clips, "middle", "gmean")
        good = gmean >= LEAST_GMEAN
        return good, mean(scores, point, clips, "middle", "f") if good else gmean

    return max(dict.fromkeys(point for point, _, _ in scores), key=value)


def report(scores: Scores, clips: Sequence[str]) -> tuple[str, dict[str, dict[str, float]]]:
    """Format tables of the choice, of the best points by Gmean, and of each clip left out. Also return the figures."""
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


# -- kernels and steps -----------------------------------------------------------------------------------------------


def measure_kernels(options: bench.Options) -> tuple[str, Any]:
    """Measure the six measures at t + Δt by kernel of smoothing, erosion, dilation, and by the last two at once.

    Each kernel varies about the constants of `--config source`; a kernel of 1 does nothing. The table of the last two
    shows F and Gmean. The result and the plot have all six measures.
    """
    base, clips = load_config("source"), _read_clips(options.data, load_config("source"))
    rows, figures, panels = [], {}, []
    for name, sizes in KERNELS.items():
        by_size = []
        for size in sizes:
            found = _score_clips(clips, with_parameters(base, {name: size}))
            by_size.append(found["middle"])
            shipped = size == getattr(base, name.split(".")[0]).model_dump()[name.split(".")[1]]
            rows.append([f"`{name}`", f"{size}{' (shipped)' * shipped}", *_cells(found)])
            figures[f"{name}={size}"] = found
        lines = {word: {"x": sizes, "y": [of[m] for of in by_size]} for m, word in zip(MEASURES, NAMES, strict=True)}
        panels.append({"title": name, "xlabel": "kernel, px", "ylim": (0, 1.02), "lines": lines})
    erosions, dilations = KERNELS["morphology.erode_px"], KERNELS["morphology.dilate_px"]
    grid = {
        (erode, dilate): _score_clips(
            clips, with_parameters(base, {"morphology.erode_px": erode, "morphology.dilate_px": dilate})
        )
        for erode, dilate in product(erosions, dilations)
    }
    figures |= {f"morphology.erode_px={e}, morphology.dilate_px={d}": found for (e, d), found in grid.items()}
    both = []
    for measure, word in zip(MEASURES, NAMES, strict=True):
        lines = {
            f"erosion {e}": {"x": dilations, "y": [grid[e, d]["middle"][measure] for d in dilations]} for e in erosions
        }
        panels.append({"title": f"{word} by both", "xlabel": "dilation, px", "lines": lines})
        if measure in ("f", "gmean"):  # the parameters of the highest F and Gmean are the source's choice
            both += [
                [f"{word}, erosion {e}", *(f"{grid[e, d]['middle'][measure]:.3f}" for d in dilations)] for e in erosions
            ]
    bench.draw(options.plot, panels, columns=3)
    head = ["kernel", "px", *NAMES, "F at t", "Gmean at t"]
    parts = [
        f"{_clip_words(clips)}, at t + Δt unless the column says t:",
        bench.format_table(head, rows),
        "Erosion and dilation at once, at t + Δt:",
        bench.format_table(["measure", *(f"dilation {d}" for d in dilations)], both),
    ]
    return "\n\n".join(parts), figures


def measure_steps(options: bench.Options) -> tuple[str, Any]:
    """Measure specificity, recall and Gmean after each step of `--config source`, at t and at t + Δt, by interval.

    Only labelled frames that can be reference and middle frame count.
    """
    base = load_config("source")
    bare = {"difference.blur_px": 1, "morphology.erode_px": 1, "morphology.dilate_px": 1, "gates.min_area_px": 1}
    shipped = base.model_dump()
    steps, kept = {"threshold": dict(bare)}, dict(bare)
    words = ("smoothing", "erosion", "dilation", "smallest area: the mask")
    for name, word in zip(bare, words, strict=True):
        group, key = name.split(".")
        kept[name] = shipped[group][key]
        steps[word] = dict(kept)
    rows, figures, whole, counted = [], {}, [], ""
    for interval in INTERVALS:
        settings = with_parameters(base, {"interval.frames": interval})
        clips = {name: _keep_both(frames) for name, frames in _read_clips(options.data, settings).items()}
        for word, parameters in steps.items():
            found = figures[f"interval {interval}, {word}"] = _score_clips(clips, with_parameters(settings, parameters))
            if interval == base.interval.frames:
                rows.append([word, *_pairs(found)])
                counted = _clip_words(clips)
        whole.append([f"{interval}{' (shipped)' * (interval == base.interval.frames)}", *_pairs(found)])
    head = [f"{word} at {at}" for word in ("specificity", "recall", "Gmean") for at in ("t", "t + Δt")]
    parts = [
        f"{counted}; after each step at the shipped Δt:",
        bench.format_table(["after", *head], rows),
        "The mask by Δt:",
        bench.format_table(["Δt, frames", *head], whole),
    ]
    return "\n\n".join(parts), figures


def _read_clips(data: Path, settings: Settings) -> dict[str, list[Labelled]]:
    """Read the differences of each clip at the settings' interval."""
    cv2.setNumThreads(1)
    return {place.name: list(labelled_frames(place, settings)) for place in clips_in(data, "bms_")}


def _keep_both(frames: list[Labelled]) -> list[Labelled]:
    """Keep the frames that are labelled both as reference and as middle frame."""
    at, middle = ({frame.number for frame in frames if frame.where == where} for where in ("reference", "middle"))
    return [frame for frame in frames if frame.number in at & middle]


def _score_clips(clips: dict[str, list[Labelled]], settings: Settings) -> dict[str, dict[str, float]]:
    """Return the means of the measures over the clips, by the truth's frame."""
    found = [score(frames, settings) for frames in clips.values()]
    return {w: {m: float(np.mean([one[w][m] for one in found])) for m in MEASURES} for w in ("middle", "reference")}


def _cells(found: dict[str, dict[str, float]]) -> list[str]:
    values = [found["middle"][m] for m in MEASURES] + [found["reference"][m] for m in ("f", "gmean")]
    return [f"{value:.3f}" for value in values]


def _pairs(found: dict[str, dict[str, float]]) -> list[str]:
    return [f"{found[w][m]:.3f}" for m in ("specificity", "recall", "gmean") for w in ("reference", "middle")]


def _clip_words(clips: dict[str, list[Labelled]]) -> str:
    there = [frame.where for of_clip in clips.values() for frame in of_clip]
    counts = f"{there.count('middle')} labelled frames at t + Δt, {there.count('reference')} at t"
    return f"Means over {len(clips)} BMS clips ({counts})"


if __name__ == "__main__":
    kernels = {"data": Path, "--plot": None}
    studies = {
        "search": (search, {"data": Path}),
        "kernels": (measure_kernels, kernels),
        "steps": (measure_steps, {"data": Path}),
    }
    bench.main(__doc__, studies)
