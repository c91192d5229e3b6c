"""Recall against false positives, for people_miss_rate.py: clips with truth, matching, curves, their measures, plots.

A clip is a folder with gt/gt.txt (MOTChallenge text, pixels from 1; rows whose seventh column is 0 do not count) and
pictures: folders img1* of files named by their frame, or else a video. People who are mostly hidden are in the truth
and stay there; so do people whom the truth leaves out, whose boxes are false positives.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from footage import frames_of, has_pictures, truth_of

from torchvision_dddas.evaluation.metrics.boxes import iou

CLIPS = ("PETS09-S2L1", "TUD-Stadtmitte")
SAME = 0.5
Found = tuple[np.ndarray, np.ndarray]
"""box_px (N, 4) and score (N,) of a frame."""


@dataclass(frozen=True)
class Clip:
    """frames: number and picture. truth: (N, 4) boxes of each frame, from pixel 0. size: (width, height)."""

    name: str
    frames: dict[int, np.ndarray]
    truth: dict[int, np.ndarray]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        height, width = next(iter(self.frames.values())).shape[:2]
        return width, height

    def every(self, step: int) -> "Clip":
        """Every so many of its frames."""
        return Clip(self.name, dict(list(self.frames.items())[::step]), self.truth)


def read(place: Path, every: int) -> Clip:
    """A clip's frames, every so many of those that there are."""
    tracks = truth_of(place).tracks
    assert tracks is not None
    pictures = "images" if has_pictures(place, "images") else "video"
    frames = {number: image for i, (number, image) in enumerate(frames_of(place, pictures)) if i % every == 0}
    return Clip(place.name, frames, {n: tracks.box_px[tracks.frame == n] - (1, 1, 0, 0) for n in frames})


def matched(found: Found, truth: np.ndarray) -> np.ndarray:
    """(N,) the true box of each found one, -1 for none: the best score first takes the best true box that is left."""
    box_px, score = found
    which = np.full(len(box_px), -1)
    if len(box_px) and len(truth):
        overlap = iou(box_px, truth)
        for i in np.argsort(-score, kind="stable"):
            j = int(np.argmax(overlap[i]))
            if overlap[i, j] >= SAME:
                which[i] = j
                overlap[:, j] = -1
    return which


@dataclass(frozen=True)
class Curve:
    """false: (K,) false positives an image, rising. recall: (K,). score: (K,) the threshold that gives them."""

    false: np.ndarray
    recall: np.ndarray
    score: np.ndarray

    def recall_at(self, false: float) -> float:
        """The best recall with no more false positives an image."""
        return float(self.recall[self.false <= false].max(initial=0.0))

    @property
    def log_average_miss_rate(self) -> float:
        """Geometric mean of the miss rate at nine rates of false positives, evenly in the logarithm from 0.01 to 1."""
        miss = [1 - self.recall_at(rate) for rate in np.logspace(-2, 0, 9)]
        return float(np.exp(np.mean(np.log(np.maximum(miss, 1e-10)))))


def curve(found: dict[int, Found], clip: Clip) -> Curve:
    """Over all thresholds of the score. found: by frame, for every frame that was searched."""
    score = np.concatenate([scores for _, scores in found.values()])
    hit = np.concatenate([matched(here, clip.truth[n]) >= 0 for n, here in found.items()])
    people = sum(len(clip.truth[n]) for n in found)
    order = np.argsort(-score, kind="stable")
    score, hit = score[order], hit[order]
    last = np.append(score[1:] != score[:-1], True)[: len(score)]  # boxes of one score come together
    return Curve((np.cumsum(~hit) / len(found))[last], (np.cumsum(hit) / people)[last], score[last])


def plot(curves: dict[str, dict[str, Curve]], path: Path) -> None:
    """Miss rate against false positives an image, both logarithmic: a panel a clip, a line a detector."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(6 * len(curves), 6), squeeze=False)
    ticks = [0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1]
    for axis, (name, lines) in zip(axes[0], curves.items(), strict=True):
        for label, line in lines.items():
            who, _, how = label.partition(": ")
            text = f"{who}: recall {line.recall_at(1):.3f} at 1" + (f"\n({how})" if how else "")
            axis.plot(np.maximum(line.false, 5e-3), 1 - line.recall, label=text, drawstyle="steps-post")
        axis.axvline(1, color="k", ls=":", lw=1)
        axis.set(title=name, xlabel="false positives an image", ylabel="miss rate", xscale="log", yscale="log")
        axis.set(xlim=(5e-3, 5), ylim=(0.05, 1))
        axis.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
