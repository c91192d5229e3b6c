"""Measure the person detector: recall, parity with OpenCV, and search regions.

python eval/people.py miss-rate DATA    recall against false boxes per image, beside OpenCV at its best setting
python eval/people.py parity PICTURES   scores and boxes beside cv2.HOGDescriptor's, for every engine
python eval/people.py regions DATA      time saved and people missed by the search in regions

DATA holds PETS09-S2L1 and TUD-Stadtmitte: gt/gt.txt (MOTChallenge text, pixels from 1) and folders img1* of single
pictures, or a video. A box is right at an IoU of 0.5, and each true box counts once. Mostly hidden people stay in the
truth. Boxes of people who are missing in the truth count as false.
"""

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice, product, tee
from pathlib import Path
from typing import Any, NamedTuple

import bench
import cv2
import numpy as np
from clips import film_of, frames_of, has_pictures, read_frames, truth_of

from torchvision_dddas.config import PeopleParameters, Settings, load_config, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.evaluation.metrics.boxes import iou
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.detector import detect_in_clip, detect_people, load_scorer
from torchvision_dddas.people.suppression import group_rectangles
from torchvision_dddas.types import DetectionTable

CLIPS = ("PETS09-S2L1", "TUD-Stadtmitte")
SAME_IOU = 0.5
Found = tuple[np.ndarray, np.ndarray]
"""Boxes box_px (N, 4) and scores (N,) of a frame."""


# -- clips and curves ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clip:
    """A clip. frames: numbers and pictures. truth: boxes (N, 4) of each frame, from pixel 0."""

    name: str
    frames: dict[int, np.ndarray]
    truth: dict[int, np.ndarray]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures."""
        height, width = next(iter(self.frames.values())).shape[:2]
        return width, height

    def thin(self, step: int) -> "Clip":
        """Return a clip with every step-th frame."""
        return Clip(self.name, dict(list(self.frames.items())[::step]), self.truth)


def read_clips(data: Path, every: int, only: str = "") -> Iterator[Clip]:
    """Yield the available clips with every N-th frame. End the program with one line if there are none."""
    places = [data / name for name in CLIPS if (data / name / "gt/gt.txt").is_file() and only in name]
    if not places:
        sys.exit(f"{data} holds neither {' nor '.join(CLIPS)}; nothing was measured")
    for place in places:
        tracks = truth_of(place).tracks
        pictures = "images" if has_pictures(place, "images") else "video"
        frames = dict(islice(frames_of(place, pictures), 0, None, every))
        yield Clip(place.name, frames, {n: tracks.box_px[tracks.frame == n] - (1, 1, 0, 0) for n in frames})


def match(found: Found, truth: np.ndarray) -> np.ndarray:
    """Return the true box (N,) of each found box, or -1. In order of score, each takes the best remaining true box."""
    box_px, score = found
    which = np.full(len(box_px), -1)
    if len(box_px) and len(truth):
        overlap = iou(box_px, truth)
        for i in np.argsort(-score, kind="stable"):
            j = int(np.argmax(overlap[i]))
            if overlap[i, j] >= SAME_IOU:
                which[i] = j
                overlap[:, j] = -1
    return which


@dataclass(frozen=True)
class Curve:
    """A recall curve. false: (K,) rising false positives per image. recall: (K,). score: (K,) thresholds."""

    false: np.ndarray
    recall: np.ndarray
    score: np.ndarray

    def recall_at(self, false: float) -> float:
        """Return the best recall with at most `false` false positives per image."""
        return float(self.recall[self.false <= false].max(initial=0.0))

    @property
    def log_average_miss_rate(self) -> float:
        """Return the geometric mean miss rate at nine rates of false positives, log-spaced from 0.01 to 1."""
        miss = [1 - self.recall_at(rate) for rate in np.logspace(-2, 0, 9)]
        return float(np.exp(np.mean(np.log(np.maximum(miss, 1e-10)))))


def curve(found: dict[int, Found], clip: Clip) -> Curve:
    """Return the curve over all score thresholds. found: found boxes by frame, for every searched frame."""
    score = np.concatenate([scores for _, scores in found.values()])
    hit = np.concatenate([match(here, clip.truth[n]) >= 0 for n, here in found.items()])
    people = sum(len(clip.truth[n]) for n in found)
    order = np.argsort(-score, kind="stable")
    score, hit = score[order], hit[order]
    last = np.append(score[1:] != score[:-1], True)[: len(score)]  # boxes with equal scores count together
    return Curve((np.cumsum(~hit) / len(found))[last], (np.cumsum(hit) / people)[last], score[last])


# -- recall beside OpenCV --------------------------------------------------------------------------------------------


class Setting(NamedTuple):
    """A setting of OpenCV's detector. enlarge: factor of the picture. hit: hitThreshold. groups: groupThreshold."""

    enlarge: float
    scale: float
    stride: int
    padding: int
    groups: int
    hit: float


OPENCV_DEFAULTS = Setting(1.0, 1.05, 8, 0, 2, 0.0)
ENLARGE, SCALES = (1.0, 1.5, 2.0), (1.1, 1.05, 1.03)
STRIDES, PADDINGS, GROUPS, HITS = (8, 4), (0, 8, 16, 32), (0, 1, 2, 3), (-0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
STRIDE, PADDING, LEAST = 4, 32, -0.5
"""Windows are scored once at this stride and padding, which cover the windows of all settings."""


def measure_miss_rate(options: bench.Options) -> tuple[str, Any]:
    """Measure recall at one and at 0.1 false boxes per image, beside OpenCV.

    OpenCV runs at its defaults and at the best of 2016 settings. This setting is chosen for each clip by recall at one
    false box on some of its own frames (--grid-frames; 0 leaves OpenCV out), with the body's box fitted to the clip.
    """
    parameters = load_config(overrides=options.set).people
    rows, found, panels = [], {}, []
    for clip in read_clips(options.data, options.every, options.only):
        ours = detect_clip(clip, parameters)
        curves = {"ours": curve({n: (p.box_px, p.margin) for n, p in ours.items()}, clip)}
        if options.grid_frames:
            curves |= measure_opencv(clip, parameters, max(1, len(clip.frames) // options.grid_frames))
        for name, line in curves.items():
            figures = [line.recall_at(1), line.recall_at(0.1), line.log_average_miss_rate]
            found[f"{clip.name}, {name}"] = figures
            rows.append([f"{clip.name}, {len(clip.frames)} frames", name, *(f"{value:.3f}" for value in figures)])
        drawn = {
            name: {"x": np.maximum(line.false, 5e-3).tolist(), "y": (1 - line.recall).tolist(), "style": "-"}
            for name, line in curves.items()
        }
        panels.append({"title": clip.name, "xlabel": "false boxes an image", "ylabel": "miss rate", "lines": drawn})
        panels[-1] |= {"xscale": "log", "yscale": "log", "xlim": (5e-3, 5), "ylim": (0.05, 1)}
    bench.draw(options.plot, panels)
    return bench.format_table(["clip", "detector", "recall at 1", "at 0.1", "log-average miss rate"], rows, 2), found


def detect_clip(clip: Clip, parameters: PeopleParameters) -> dict[int, Any]:
    """Return the people of every frame found by the onboard engine."""
    scorer = load_scorer(parameters, "onboard")
    return {number: detect_people([image], scorer, parameters)[0] for number, image in clip.frames.items()}


def measure_opencv(clip: Clip, parameters: PeopleParameters, every: int) -> dict[str, Curve]:
    """Return OpenCV's curves on all frames at its defaults and at its best setting."""
    if not is_opencv(next(iter(clip.frames.values())), OPENCV_DEFAULTS._replace(enlarge=1.5, groups=1)):
        sys.exit(f"{clip.name}: the rectangles are not those of detectMultiScale; nothing of OpenCV was measured")
    side = (1 - parameters.width_share) / 2
    top = parameters.feet_share - parameters.height_share
    body = np.array([side, top, parameters.width_share, parameters.height_share])
    tried = list(try_settings(clip.thin(every), body))
    best = max(tried, key=lambda pair: (pair[1].recall_at(1), -pair[1].log_average_miss_rate))[0]
    curves = {}
    for name, setting in (("OpenCV's defaults", OPENCV_DEFAULTS), (f"OpenCV's best: {tuple(best)}", best)):
        scored = score_windows(clip, setting.enlarge, setting.scale)
        raw = {n: rectangles(rows, clip.size, setting) for n, rows in scored.items()}
        fitted = fit_body(raw, clip, body)
        curves[name] = curve({n: shrink(here, fitted) for n, here in raw.items()}, clip)
    return curves


def opencv_detector() -> "cv2.HOGDescriptor":
    """Return OpenCV's detector with its default classifier."""
    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(cv2.HOGDescriptor.getDefaultPeopleDetector())
    return hog


def all_windows(image: np.ndarray, enlarge: float, scale: float) -> np.ndarray:
    """Return (N, 6) scale, level width, level height, x, y and score of each window with a score of at least -0.5."""
    hog, rows, level_scale = opencv_detector(), [], 1.0
    picture = cv2.resize(image, None, fx=enlarge, fy=enlarge) if enlarge != 1 else image
    height, width = picture.shape[:2]
    for _ in range(hog.nlevels):
        size = round(width / level_scale), round(height / level_scale)
        if size[0] < 64 or size[1] < 128:
            break
        level = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR_EXACT)
        place, score = hog.detect(level, LEAST, (STRIDE, STRIDE), (PADDING, PADDING))
        if len(place):
            rows.append(np.column_stack([np.tile((level_scale, *size), (len(place), 1)), place, np.ravel(score)]))
        level_scale *= scale
    return np.concatenate(rows) if rows else np.zeros((0, 6))


def rectangles(scored: np.ndarray, size: tuple[int, int], setting: Setting) -> Found:
    """Return the result of detectMultiScale in pixels of the picture before its enlargement."""
    level_scale, width, height, x, y, score = scored.T
    stride, padding = setting.stride, setting.padding
    there = (x >= -padding) & (y >= -padding) & (x + 64 <= width + padding) & (y + 128 <= height + padding)
    there &= ((x + padding) % stride == 0) & ((y + padding) % stride == 0) & (score >= setting.hit)
    corner = np.stack([x, y, np.full_like(x, 64), np.full_like(x, 128)], axis=1)
    box, best = group_rectangles(np.rint(corner * level_scale[:, None])[there], score[there], setting.groups)
    low = np.maximum(box[:, :2], 0)
    high = np.minimum(box[:, :2] + box[:, 2:], np.rint(np.array(size) * setting.enlarge))
    return np.concatenate([low, high - low], axis=1) / setting.enlarge, best


def is_opencv(image: np.ndarray, setting: Setting) -> bool:
    """Return whether `rectangles` gives the same result as detectMultiScale."""
    box, _ = rectangles(all_windows(image, setting.enlarge, setting.scale), image.shape[1::-1], setting)
    enlarge, scale, stride, padding, groups, hit = setting
    picture = cv2.resize(image, None, fx=enlarge, fy=enlarge)
    theirs, _ = opencv_detector().detectMultiScale(picture, hit, (stride,) * 2, (padding,) * 2, scale, groups)
    ours = sorted(tuple(row) for row in np.rint(box * enlarge).astype(int).tolist())
    return ours == sorted(tuple(row) for row in np.reshape(theirs, (-1, 4)).tolist())


def score_windows(clip: Clip, enlarge: float, scale: float) -> dict[int, np.ndarray]:
    """Return the scored windows of every frame."""
    with ThreadPoolExecutor(2) as pool:
        each = pool.map(lambda image: all_windows(image, enlarge, scale), clip.frames.values())
        return dict(zip(clip.frames, each, strict=True))


def shrink(found: Found, shares: np.ndarray) -> Found:
    """Return bodies inside rectangles. shares: (4,) x, y, width, height relative to the rectangle's size."""
    box, score = found
    return np.concatenate([box[:, :2] + box[:, 2:] * shares[:2], box[:, 2:] * shares[2:]], axis=1), score


def fit_body(found: dict[int, Found], clip: Clip, shares: np.ndarray) -> np.ndarray:
    """Fit the shares (4,) to a clip's true boxes: medians over the matching rectangles, in two rounds."""
    for _ in range(2):
        rows = []
        for number, here in found.items():
            which = match(shrink(here, shares), clip.truth[number])
            box, true = here[0][which >= 0], clip.truth[number][which[which >= 0]]
            rows.append(np.concatenate([(true[:, :2] - box[:, :2]) / box[:, 2:], true[:, 2:] / box[:, 2:]], axis=1))
        shares = np.median(np.concatenate(rows), axis=0)
    return shares


def try_settings(clip: Clip, shares: np.ndarray) -> Iterator[tuple[Setting, Curve]]:
    """Yield every setting with its curve. Bodies use the shares that fit the clip at the setting's pyramid."""
    for enlarge, scale in product(ENLARGE, SCALES):
        found = score_windows(clip, enlarge, scale)
        for stride, padding in product(STRIDES, PADDINGS):
            one = Setting(enlarge, scale, stride, padding, 1, 0.4)
            fitted = fit_body({n: rectangles(rows, clip.size, one) for n, rows in found.items()}, clip, shares)
            for groups, hit in product(GROUPS, HITS):
                setting = one._replace(groups=groups, hit=hit)
                bodies = {n: shrink(rectangles(rows, clip.size, setting), fitted) for n, rows in found.items()}
                yield setting, curve(bodies, clip)


# -- parity ----------------------------------------------------------------------------------------------------------


def measure_parity(options: bench.Options) -> tuple[str, Any]:
    """Compare scores of all windows, and boxes, with cv2.HOGDescriptor on the same pyramid (scale step 1.05).

    worst difference: of a window's score. signs: windows with a positive score in one detector only. boxes: OpenCV's.
    other: boxes of one detector only. The padding is a multiple of the common divisor of window and block stride.
    """
    images, rows = read_frames(options.data, options.most), []
    svm, size = read_classifier("opencv", 3780), images[0].shape[1::-1]
    for padding, stride in product((0, 32), (8, 4)):
        parameters = PeopleParameters(
            enlarge=1, padding_px=padding, window_stride_px=stride, scale_step=1.05, threshold=0,
            suppression="opencv", group=2,
        )  # fmt: skip
        parts = pyramid.everywhere(size, parameters)
        for engine in options.engines:
            scorer, windows, worst, signs, boxes, other = load_scorer(parameters, engine, svm), 0, 0.0, 0, 0, 0
            for image in images:
                (maps,) = scorer.scores([image], [parts])
                for part, scores in zip(parts, maps, strict=True):
                    wanted = opencv_scores(image, part.level, parameters)
                    windows, worst = windows + wanted.size, max(worst, float(np.abs(scores - wanted).max(initial=0)))
                    signs += int(((scores > 0) != (wanted > 0)).sum())
                found = detect_people([image], scorer, parameters)[0].window_px
                theirs, _ = opencv_detector().detectMultiScale(
                    image, 0, (stride,) * 2, (padding,) * 2, parameters.scale_step, parameters.group
                )
                low, high = np.maximum(found[:, :2], 0), np.minimum(found[:, :2] + found[:, 2:], size)
                ours = {(*a, *(b - a)) for a, b in zip(low.astype(int), high.astype(int), strict=True)}
                boxes, other = boxes + len(theirs), other + len({tuple(b) for b in np.reshape(theirs, (-1, 4))} ^ ours)
            rows.append([engine, padding, stride, windows, f"{worst:.1e}", signs, boxes, other])
            bench.log(*rows[-1])
    head = ["engine", "padding", "stride", "windows", "worst difference", "signs", "boxes", "other"]
    return bench.format_table(head, rows), rows


def opencv_scores(image: np.ndarray, size: tuple[int, int], parameters: PeopleParameters) -> np.ndarray:
    """Return OpenCV's score map of a level; NaN where OpenCV has no window."""
    level = image if size == image.shape[1::-1] else cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT)
    stride, pad = parameters.window_stride_px, parameters.padding_px
    places, scores = map(np.asarray, opencv_detector().detect(level, -1e9, (stride, stride), (pad, pad)))
    columns, rows = ((places + pad) // stride).T
    found = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    found[rows, columns] = scores.ravel()
    return found


# -- regions ---------------------------------------------------------------------------------------------------------

MODES = {
    "everywhere": ("everywhere", False),
    "regions": ("regions", False),
    "around what moves": ("everywhere", True),
    "regions, and around what moves": ("regions", True),
}
"""`people.search`, and whether the search covers only the surroundings of moving targets."""


def measure_regions(options: bench.Options) -> tuple[str, Any]:
    """Measure recall, windows and time of the search in regions, beside the search in the whole picture.

    Recall counts detections with a probability of at least 0.5, in percent of the true boxes. Time is the median over
    frames of the ratio to the whole search. All searches take turns on each frame.
    """
    settings, rows = load_config(overrides=options.set), []
    scorer = load_scorer(settings.people, options.engine)
    for name in CLIPS:
        place = options.data / name
        if not (place / "gt/gt.txt").is_file() or film_of(place) is None:
            continue
        tracks, video = truth_of(place).tracks, str(film_of(place))
        moving = find_movers(video, settings, options.frames)
        frames = tee(islice(open_source(video), options.frames), len(MODES))
        runs = [
            detect_in_clip(
                one, scorer, with_parameters(settings, {"people.search": search}), moving if around else None, batch=1
            )
            for one, (search, around) in zip(frames, MODES.values(), strict=True)
        ]  # fmt: skip
        hits, false, share, people, times = np.zeros(len(MODES)), np.zeros(len(MODES)), np.zeros(len(MODES)), 0, []
        for made in zip(*runs, strict=True):
            true_px = tracks.box_px[tracks.frame == made[0].frame.number] - (1, 1, 0, 0)
            people += len(true_px)
            for i, one in enumerate(made):
                likely = one.people.score >= 0.5
                right = match((one.people.box_px[likely], one.people.score[likely]), true_px) >= 0
                hits[i], false[i], share[i] = hits[i] + right.sum(), false[i] + (~right).sum(), share[i] + one.share
            spent = [sum(one.seconds.get(stage, 0.0) for stage in ("plan", "score", "people")) for one in made]
            times.append([seconds / spent[0] for seconds in spent])
        count, ratio = len(times), np.median(times, axis=0)
        for i, mode in enumerate(MODES):
            recall = f"{100 * hits[i] / people:.1f}", f"{100 * hits[i] / hits[0]:.1f}"
            more = f"{false[i] / count:.2f}", f"{100 * share[i] / count:.1f}", f"{ratio[i]:.2f}"
            rows.append([f"{name}, {count} frames", mode, *recall, *more])
    head = ["clip", "searched", "recall %", "of everywhere %", "false boxes a frame", "windows %", "time"]
    return bench.format_table(head, rows, words=2), rows


def find_movers(video: str, settings: Settings, frames: int) -> DetectionTable:
    """Return the detections of `dddas detect` in the first frames, as a table."""
    found = [
        (scene.frame.number, *box)
        for scene in islice(detect_motion(open_source(video), settings, "onboard"), frames)
        for box in scene.detections.box_px
    ]
    rows = np.array(found, float).reshape(-1, 5)
    every = np.arange(1, len(rows) + 1)
    return DetectionTable("movers", rows[:, 0].astype(np.int64), rows[:, 1:], np.ones(len(rows)), every, own=True)


if __name__ == "__main__":
    miss_rate = {"data": Path, "--every": 2, "--grid-frames": 10, "--only": "", "--set": [], "--plot": None}
    studies: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
        "miss-rate": (measure_miss_rate, miss_rate),
        "parity": (measure_parity, {"data": Path, "--engines": ["torch", "onboard"], "--most": 20}),
        "regions": (measure_regions, {"data": Path, "--frames": 200, "--engine": "auto", "--set": []}),
    }
    bench.main(__doc__, studies)
