"""OpenCV's own people detector over all its settings, for people_miss_rate.py.

`cv2.HOGDescriptor.detect` scores the windows of every level once, at a stride of 4 and a padding of 32 px; the windows
of other strides and paddings are among them, and grouping is `targets.suppress.group`. That this is what
`detectMultiScale` returns is checked on the first frame of each clip.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from people_curves import Clip, Curve, Found, curve, matched

from torchvision_dddas.people.suppression import group_rectangles

STRIDE, PADDING, LEAST = 4, 32, -0.5


class Setting(NamedTuple):
    """enlarge: of the picture beforehand. hit: hitThreshold. groups: groupThreshold."""

    enlarge: float
    scale: float
    stride: int
    padding: int
    groups: int
    hit: float


ENLARGE, SCALES = (1.0, 1.5, 2.0), (1.1, 1.05, 1.03)
STRIDES, PADDINGS, GROUPS, HITS = (8, 4), (0, 8, 16, 32), (0, 1, 2, 3), (-0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def detector() -> "cv2.HOGDescriptor":
    """With its default classifier."""
    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(cv2.HOGDescriptor.getDefaultPeopleDetector())
    return hog


def windows(image: np.ndarray, enlarge: float, scale: float, stride: int = STRIDE) -> np.ndarray:
    """(N, 6) levelScale, width and height of the level, x, y and score of each window that scores -0.5 or more."""
    hog, rows, level_scale = detector(), [], 1.0
    picture = _enlarged(image, enlarge)
    height, width = picture.shape[:2]
    for _ in range(hog.nlevels):
        size = round(width / level_scale), round(height / level_scale)
        if size[0] < 64 or size[1] < 128:
            break
        level = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR_EXACT)
        place, score = hog.detect(level, LEAST, (stride, stride), (PADDING, PADDING))
        if len(place):
            rows.append(np.column_stack([np.tile((level_scale, *size), (len(place), 1)), place, np.ravel(score)]))
        level_scale *= scale
    return np.concatenate(rows) if rows else np.zeros((0, 6))


def _enlarged(image: np.ndarray, enlarge: float) -> np.ndarray:
    return image if enlarge == 1 else cv2.resize(image, None, fx=enlarge, fy=enlarge)


def rectangles(scored: np.ndarray, size: tuple[int, int], setting: Setting) -> Found:
    """What detectMultiScale returns, brought back to the size of the picture before it was enlarged."""
    level_scale, width, height, x, y, score = scored.T
    stride, padding = setting.stride, setting.padding
    there = (x >= -padding) & (y >= -padding) & (x + 64 <= width + padding) & (y + 128 <= height + padding)
    there &= ((x + padding) % stride == 0) & ((y + padding) % stride == 0) & (score >= setting.hit)
    corner = np.stack([x, y, np.full_like(x, 64), np.full_like(x, 128)], axis=1)
    box, best = group_rectangles(np.rint(corner * level_scale[:, None])[there], score[there], setting.groups)
    low = np.maximum(box[:, :2], 0)
    high = np.minimum(box[:, :2] + box[:, 2:], np.rint(np.array(size) * setting.enlarge))
    return np.concatenate([low, high - low], axis=1) / setting.enlarge, best


def check(image: np.ndarray, setting: Setting) -> bool:
    """Whether `rectangles` are those of detectMultiScale."""
    size = image.shape[1], image.shape[0]
    box, _ = rectangles(windows(image, setting.enlarge, setting.scale), size, setting)
    _, scale, stride, padding, groups, hit = setting
    picture = _enlarged(image, setting.enlarge)
    theirs, _ = detector().detectMultiScale(picture, hit, (stride, stride), (padding, padding), scale, groups)
    ours = sorted(tuple(row) for row in np.rint(box * setting.enlarge).astype(int).tolist())
    return ours == sorted(tuple(row) for row in np.reshape(theirs, (-1, 4)).tolist())


def scored(clip: Clip, enlarge: float, scale: float, stride: int = STRIDE) -> dict[int, np.ndarray]:
    """The windows of every frame."""
    with ThreadPoolExecutor(2) as pool:
        each = pool.map(lambda image: windows(image, enlarge, scale, stride), clip.frames.values())
        return dict(zip(clip.frames, each, strict=True))


def shrunk(found: Found, shares: np.ndarray) -> Found:
    """Bodies in rectangles. shares: (4,) of x, y, width, height in the rectangle's own size."""
    box, score = found
    return np.concatenate([box[:, :2] + box[:, 2:] * shares[:2], box[:, 2:] * shares[2:]], axis=1), score


def fitted(found: dict[int, Found], clip: Clip, shares: np.ndarray) -> np.ndarray:
    """(4,) the shares that suit this clip's true boxes best: medians over the rectangles that match, in two rounds."""
    for _ in range(2):
        rows = []
        for number, here in found.items():
            which = matched(shrunk(here, shares), clip.truth[number])
            box, true = here[0][which >= 0], clip.truth[number][which[which >= 0]]
            rows.append(np.concatenate([(true[:, :2] - box[:, :2]) / box[:, 2:], true[:, 2:] / box[:, 2:]], axis=1))
        shares = np.median(np.concatenate(rows), axis=0)
    return shares


def grid(clip: Clip, shares: np.ndarray) -> Iterator[tuple[Setting, Curve]]:
    """Every setting with its curve, bodies by the shares that fit the clip at that pyramid."""
    for enlarge, scale in product(ENLARGE, SCALES):
        found = scored(clip, enlarge, scale)
        for stride, padding in product(STRIDES, PADDINGS):
            one = Setting(enlarge, scale, stride, padding, 1, 0.4)
            suited = fitted({n: rectangles(rows, clip.size, one) for n, rows in found.items()}, clip, shares)
            for groups, hit in product(GROUPS, HITS):
                setting = one._replace(groups=groups, hit=hit)
                bodies = {n: shrunk(rectangles(rows, clip.size, setting), suited) for n, rows in found.items()}
                yield setting, curve(bodies, clip)
