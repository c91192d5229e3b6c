"""Learn the weights of tracklet scores, and measure them on data sets that were left out.

The clips of a data set (HIT-UAV, UAV123, UAVDT, DTB70, BMS, DAVIS) are scored with weights learned on all other data
sets. `learn` prints the weights for `detection/tracklet_scores.py`.
"""

import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import bench
import clips
import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.config import Settings
from torchvision_dddas.detection import MotionDetector
from torchvision_dddas.detection.candidates import LOOK_WEIGHTS, SILHOUETTES, Candidates, describe_look, weigh
from torchvision_dddas.detection.fragments import join_fragments
from torchvision_dddas.detection.observation import Target, draw_chosen
from torchvision_dddas.detection.tracklet_scores import (
    BLOB,
    TRACKLET_WEIGHTS,
    Worth,
    choose,
    describe_tracklets,
    score_tracklets,
)
from torchvision_dddas.detection.tracklets import Tracklets, follow
from torchvision_dddas.lab.benchmark import plain_chain
from torchvision_dddas.lab.evaluation.metrics.boxes import iou

KINDS = {
    "hit": "hit", "car14": "uav123", "wakeboard": "uav123", "group": "uav123", "uav123": "uav123", "S0310": "uavdt",
    "Mountain": "dtb70", "bms": "bms", "davis": "davis",
}  # fmt: skip
"""The data set of a clip, by a part of its name. All clips of a data set are left out together."""

SETTINGS = Settings()
PARTLY = 0.2
"""Weight of a candidate on a target that is much larger than the candidate."""

PEOPLE = "people from 60 m"

Weights = tuple[dict[str, float], dict[str, float]]


@dataclass
class Look:
    """Inputs of the detector's decision on a look.

    drawn: (N, 4) boxes of the blobs' refined outlines.
    """

    candidates: Candidates
    tracklets: Tracklets
    drawn: list[np.ndarray]
    described: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass
class Film:
    """A clip at a sampling. looks: by frame. truth: boxes to find by frame, or None for an unlabelled frame.

    unsure: boxes by frame that do not count. how: extent of the labels: all, one, masks or none. moves: frames in which
    the single target moves. plain: boxes of the plain chain by frame.
    """

    name: str
    how: str
    frames: int
    looks: dict[int, Look]
    repeats: dict[int, int]
    truth: list[np.ndarray | None]
    unsure: list[np.ndarray]
    moves: list[bool]
    plain: list[np.ndarray]

    @property
    def kind(self) -> str:
        """The data set of the clip."""
        return next((kind for part, kind in KINDS.items() if part in self.name), "other")


class _Recorder(MotionDetector):
    """The default detector. It stores the inputs of tracklet scores and accepts all blobs."""

    def __init__(self, rate_hz: float) -> None:
        super().__init__(backend="onboard", rate_hz=rate_hz)
        self.looks: dict[int, Look] = {}

    def _judge(self, index: int) -> list[Target]:
        slot = self._buffer[index]
        observation, candidates, settings = slot.observation, slot.observation.candidates, slot.distance.settings
        if candidates is None:
            return []
        tracklets = follow(candidates, self._looks_about(index), slot.view.size)
        given = tracklets.velocity_px, np.zeros(len(candidates)), settings
        drawn = [join_fragments(draw_chosen(observation, [i], *given)) for i in range(len(observation.blobs))]
        boxes = [_boxes([target.box for target in parts]) for parts in drawn]
        self.looks[slot.frame.number - 1] = Look(candidates, tracklets, boxes)
        return [target for parts in drawn for target in parts]


def record(case: tuple[Path, int]) -> Film:
    """Run the detector on every N-th picture of a clip."""
    place, every = case
    cv2.setNumThreads(1)
    pictures = sorted((place / "frames").iterdir())[::every]
    note = place / "clip.json"
    rate_hz = json.loads(note.read_text()).get("rate", 10) if note.exists() else 10
    detector = _Recorder(rate_hz / every)
    images = [cv2.imread(str(path)) for path in pictures]
    scenes = [scene for image in images for scene in detector.update(image)] + detector.flush()
    repeats = {scene.frame.number - 1: scene.repeats - 1 for scene in scenes if scene.repeats}
    name = place.name if every == 1 else f"{place.name}@{every}"
    how, truth, unsure, moves = read_truth(place, every, pictures)
    plain = []
    for i in range(len(images)):  # each frame and its next two; the last two frames look back
        step = 1 if i + 2 < len(images) else -1
        plain.append(plain_chain.plain_window(images[i], images[i + step], images[i + 2 * step])[1])
    return Film(name, how, len(pictures), detector.looks, repeats, truth, unsure, moves, plain)


def read_truth(
    place: Path, every: int, pictures: Sequence[Path]
) -> tuple[str, list[np.ndarray | None], list[np.ndarray], list[bool]]:
    """Read the labels into the fields how, truth, unsure and moves of `Film`."""
    count, none = len(pictures), np.zeros((0, 4))
    unsure, moves = [none] * count, [True] * count
    if (place / "truth.json").exists():
        rows = json.loads((place / "truth.json").read_text())[::every]
        by = {s: [_boxes([r["box"] for r in row if r["state"] == s]) for row in rows] for s in ("moving", "unsure")}
        return "all", list(by["moving"]), by["unsure"], moves
    if (place / "masks").exists():
        labels = {path.stem: path for path in (place / "masks").iterdir()}
        read = [cv2.imread(str(labels[p.stem]), 0) if p.stem in labels else None for p in pictures]
        return "masks", [None if mask is None else _boxes_of_mask(mask) for mask in read], unsure, moves
    if (place / "boxes_xywh.txt").exists():
        boxes = np.loadtxt(place / "boxes_xywh.txt", delimiter=",", ndmin=2)[::every]
        truth: list[np.ndarray | None] = [none if np.isnan(b).any() or b[2] <= 0 else b[None] for b in boxes[:count]]
        truth += [none] * (count - len(truth))
        if (place / "moves.json").exists() and every == 1:
            rows = json.loads((place / "moves.json").read_text())
            moves = [r["speed"] is not None and r["snr"] > 6 and r["speed"] > 0.35 for r in rows][:count]
        return "one", truth, unsure, moves
    return "none", [none] * count, unsure, moves


def _boxes(rows: Sequence[Sequence[float]]) -> np.ndarray:
    return np.array(rows, float).reshape(-1, 4)


def _boxes_of_mask(mask: np.ndarray) -> np.ndarray:
    found = [cv2.boundingRect((mask == value).astype(np.uint8)) for value in np.unique(mask) if value]
    areas = [int((mask == value).sum()) for value in np.unique(mask) if value]
    return _boxes([box for box, area in zip(found, areas, strict=True) if area >= 40])


# -- learning ----------------------------------------------------------------------------------------------------------


def fit_logistic(x: np.ndarray, y: np.ndarray, weight: np.ndarray, ridge: float = 3e-3) -> np.ndarray:
    """Fit weights (F + 1,) of the columns of x (N, F) and a constant by Newton's method on standardized columns."""
    mean, spread = x.mean(axis=0), x.std(axis=0) + 1e-6
    z, weight = np.c_[np.clip((x - mean) / spread, -5, 5), np.ones(len(x))], weight / weight.sum()
    b, penalty = np.zeros(z.shape[1]), ridge * np.eye(z.shape[1])
    penalty[-1, -1] = 0
    for _ in range(10):
        p = 1 / (1 + np.exp(-np.clip(z @ b, -30, 30)))
        slope = z.T @ (weight * (p - y)) + penalty @ b
        b -= np.linalg.solve((z * (weight * p * (1 - p) + 1e-9)[:, None]).T @ z + penalty, slope)
    return np.append(b[:-1] / spread, b[-1] - (b[:-1] * mean / spread).sum())


def label(film: Film, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the best IoU (N,) of the look's candidates with a target, and weights (N,), 0 for unlabelled ones."""
    box, truth, drawn = film.looks[frame].candidates.box_px, film.truth[frame], film.looks[frame].drawn
    if truth is None or not len(box):
        return np.zeros(len(box)), np.zeros(len(box))
    best, around = np.zeros(len(box)), np.zeros(len(box), bool)
    if len(truth):
        best = iou(box, truth).max(axis=1)
        best[: len(drawn)] = [iou(part, truth).max(initial=0) for part in drawn]
        around = _holds(box, truth[:, :2] + truth[:, 2:] / 2).any(axis=1)
    weight = np.where((best > 0.2) & (best < 0.45), 0.4, 1.0)
    weight[around & (best < 0.45)] = PARTLY
    if len(film.unsure[frame]):
        unsure = film.unsure[frame]
        middle = unsure[:, :2] + unsure[:, 2:] / 2
        inside = ((middle[None] >= box[:, None, :2]) & (middle[None] <= box[:, None, :2] + box[:, None, 2:])).all(
            axis=2
        )
        weight[(best < 0.1) & (inside | (iou(box, unsure) > 0.05)).any(axis=1)] = 0
    if film.how == "one" or film.kind == "davis":  # other targets may move too
        weight[best < 0.05] *= 0.3
    return best, weight


def learn_weights(films: Sequence[Film]) -> Weights:
    """Learn the weights of both scores. Films have equal weights. False candidates weigh twice as much as true ones."""

    def fit(names: Sequence[str], rows: Callable[[Film, int], dict[str, np.ndarray]]) -> dict[str, float]:
        xs, ys, ws = [], [], []
        for film in films:
            x, y, w = [np.zeros((0, len(names)))], [np.zeros(0)], [np.zeros(0)]
            for frame, look in film.looks.items():
                if len(look.candidates):
                    described = rows(film, frame)
                    best, weight = label(film, frame)
                    x.append(np.stack([described[name] for name in names], axis=1))
                    y.append((best >= 0.45).astype(float))
                    w.append(weight)
            y_all, w_all = np.concatenate(y), np.concatenate(w)
            for is_target in (0, 1):
                rows_of = y_all == is_target
                if (total := w_all[rows_of].sum()) > 0:
                    w_all[rows_of] *= (1.0 if is_target else 2.0) * min(1, total / 60) / total
            xs.append(np.concatenate(x)), ys.append(y_all), ws.append(w_all)
        x_all, y_all, w_all = (np.concatenate(part) for part in (xs, ys, ws))
        kept = w_all > 0
        b = fit_logistic(x_all[kept], y_all[kept], w_all[kept])
        return dict(zip([*names, "constant"], b.tolist(), strict=True))

    looks = fit([n for n in LOOK_WEIGHTS if n != "constant"], lambda film, frame: film.looks[frame].described)
    names = [name for name in TRACKLET_WEIGHTS if name != "constant"]
    return looks, fit(names, lambda film, frame: describe(film, frame, looks))


def seen_by(film: Film, frame: int, look_weights: Mapping[str, float]) -> dict[int, Candidates]:
    """Return {offset: candidates} of the looks that a frame's tracklets cross (0 is its own), scored with weights."""
    order = sorted(film.looks)
    at, members = order.index(frame), film.looks[frame].tracklets.members
    near = {offset: film.looks[order[at + offset]] for offset in (0, *members)}
    return {o: replace(one.candidates, score=weigh(one.described, look_weights)) for o, one in near.items()}


def describe(film: Film, frame: int, look_weights: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the result of `describe_tracklets` with some weights of looks."""
    seen = seen_by(film, frame, look_weights)
    return describe_tracklets(seen.pop(0), film.looks[frame].tracklets, seen)


# -- scoring -----------------------------------------------------------------------------------------------------------


def detect(film: Film, weights: Weights | None, accept: float = 0.0, worth: Worth = BLOB) -> list[np.ndarray]:
    """Return the boxes of every frame by the detector's rule, or of all blobs without weights."""
    found = []
    for frame in range(film.frames):
        source = film.repeats.get(frame, frame)
        if (look := film.looks.get(source)) is None:
            found.append(np.zeros((0, 4)))
            continue
        if weights is None:
            chosen = list(range(len(look.drawn)))
        else:
            seen = seen_by(film, source, weights[0])
            candidates = seen.pop(0)
            scores = score_tracklets(candidates, look.tracklets, seen, weights[1])
            chosen = choose(candidates, scores, accept, SETTINGS.morphology.close_px, worth)
        boxes = [look.drawn[i] if i < len(look.drawn) else _widened(look.candidates, i) for i in chosen]
        found.append(np.concatenate([np.zeros((0, 4)), *boxes]))
    return found


def _widened(candidates: Candidates, index: int) -> np.ndarray:
    """Return the (1, 4) box of a candidate with the pixels that erosion took from its sides, as the detector does."""
    margin = SILHOUETTES[candidates.silhouette[index]].erode_px // 2
    return candidates.box_px[index : index + 1] + np.array([-margin, -margin, 2 * margin, 2 * margin])


def score(film: Film, found: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Return a film's counts as in the shared tools: hits, false, missed at IoU .25 and .5, or of one target."""
    if film.how in ("all", "masks"):
        counts = {f"counts{100 * least:.0f}": np.zeros(3) for least in (0.25, 0.5)}
        for boxes, truth, unsure in zip(found, film.truth, film.unsure, strict=True):
            if truth is None:
                continue
            cost = iou(boxes, truth)
            rows, columns = linear_sum_assignment(-cost)
            middle = unsure[:, :2] + unsure[:, 2:] / 2
            own = truth[:, :2] + truth[:, 2:] / 2
            on_unsure = (iou(boxes, unsure) >= 0.2).any(axis=1) | _holds(boxes, middle).any(axis=1)
            on_unsure &= ~_holds(boxes, own).any(axis=1)
            for least in (0.25, 0.5):
                taken = rows[cost[rows, columns] >= least]
                is_false = ~on_unsure
                is_false[taken] = False
                counts[f"counts{100 * least:.0f}"] += len(taken), is_false.sum(), len(truth) - len(taken)
        return counts | {"frames": np.array(sum(t is not None for t in film.truth))}
    n = hit = near = other = labelled = 0
    for boxes, truth, moves in zip(found, film.truth, film.moves, strict=True):
        if film.how == "none":
            labelled, other = labelled + 1, other + len(boxes)
            continue
        if truth is None or not len(truth):
            continue
        cost = iou(boxes, truth)[:, 0]
        labelled, other = labelled + 1, other + int((cost < 0.05).sum())
        if moves:
            n, near = n + 1, near + bool((cost >= 0.3).any())
            hit += bool(_holds(boxes, truth[:, :2] + truth[:, 2:] / 2).any())
    return {
        "hit": np.array(hit / max(n, 1)),
        "iou3": np.array(near / max(n, 1)),
        "other": np.array(other / max(labelled, 1)),
    }


def _holds(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (N, M) whether boxes contain points."""
    return ((points[None] >= boxes[:, None, :2]) & (points[None] <= boxes[:, None, :2] + boxes[:, None, 2:])).all(
        axis=2
    )


def f1(counts: np.ndarray) -> float:
    """Return F1 from hits, false and missed."""
    return float(2 * counts[0] / max(2 * counts[0] + counts[1] + counts[2], 1e-9))


def summarize(films: Sequence[Film], found: Mapping[str, Sequence[np.ndarray]]) -> dict[str, float]:
    """Return figures over all films, with the usual measure of each data set."""
    of = {film.name: score(film, found[film.name]) for film in films}
    low = [film for film in films if "hit_60" in film.name and "@" not in film.name]
    pooled = {n: sum((of[film.name][n] for film in low), np.zeros(3)) for n in ("counts25", "counts50")}
    frames = max(sum(of[film.name]["frames"] for film in low), 1)
    row = {f"{PEOPLE}: F1 at IoU .{at}": f1(pooled[f"counts{at}"]) for at in (25, 50)}
    row[f"{PEOPLE}: false a picture"] = float(pooled["counts25"][1] / frames)
    for title, wanted in (("one target", lambda n: "@" not in n), ("every 4th picture", lambda n: n.endswith("@4"))):
        names = [film.name for film in films if film.how == "one" and wanted(film.name)]
        for measure, words in (("hit", "centre hit"), ("iou3", "IoU .3"), ("other", "other boxes")):
            row[f"{title}: {words}"] = mean([of[name][measure] for name in names])
    for kind in ("bms", "davis"):
        names = [film.name for film in films if film.kind == kind and "@" not in film.name]
        row[f"{kind.upper()}: F1 of boxes at IoU .5"] = mean([f1(of[name]["counts50"]) for name in names])
    row["nothing moves: boxes"] = mean([of[film.name]["other"] for film in films if film.how == "none"])
    return row


def mean(values: Sequence[Any]) -> float:
    """Return the mean, or NaN without values."""
    return float(np.mean(values)) if values else float("nan")


# -- studies -----------------------------------------------------------------------------------------------------------


def load_films(options: bench.Options) -> list[Film]:
    """Record every clip of the folder at all samplings, and store the films if a file is given."""
    if options.keep and Path(options.keep).exists():
        films: list[Film] = pickle.loads(Path(options.keep).read_bytes())
    else:
        cases = []
        for place in clips.clips_in(options.data):
            count, is_masked = len(list((place / "frames").iterdir())), (place / "masks").exists()
            cases += [(place, n) for n in options.every if n == 1 or (not is_masked and count >= 14 * n)]
        with ProcessPoolExecutor(options.jobs) as pool:
            films = list(pool.map(record, cases))
        if options.keep:
            Path(options.keep).write_bytes(pickle.dumps(films))
    for film in films:
        for look in film.looks.values():
            c = look.candidates
            look.described = describe_look(c.box_px, c.fill, c.peak, c.inside, c.around)
    return films


def learn(options: bench.Options) -> tuple[str, Any]:
    """Learn weights on all clips, and measure figures with each data set left out."""
    films = load_films(options)
    left_out = {kind: learn_weights([f for f in films if f.kind != kind]) for kind in sorted({f.kind for f in films})}
    rows: dict[str, dict[str, float]] = {}
    rows["plain OpenCV chain"] = summarize(films, {film.name: film.plain for film in films})
    rows["blobs alone"] = summarize(films, {film.name: detect(film, None) for film in films})
    for accept, worth in product(options.accept, options.blob):
        worths = Worth(worth, BLOB.narrow)
        found = {film.name: detect(film, left_out[film.kind], accept, worths) for film in films}
        rows[f"tracklets above {accept:g}, blobs {worth:g}"] = summarize(films, found)
    measures = next(iter(rows.values()))
    text = bench.format_table(["measure", *rows], [[m, *(f"{row[m]:.2f}" for row in rows.values())] for m in measures])
    weights = [{name: round(value, 3) for name, value in part.items()} for part in learn_weights(films)]
    bench.log(json.dumps(weights, indent=1))
    return text, {"figures": rows, "weights": weights}


if __name__ == "__main__":
    options = {
        "data": Path,
        "--every": [1, 2, 4, 8],
        "--accept": [SETTINGS.tracklets.accept],
        "--blob": [BLOB.wide],
        "--keep": "",
        "--jobs": 2,
    }
    bench.main(__doc__, {"learn": (learn, options)})
