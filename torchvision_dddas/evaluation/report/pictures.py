"""Truth and result of a frame side by side, in colours and line styles that colour-blind people can tell apart."""

from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.io.overlay import Colour, colour_picture, drawable, label

HIT: Colour = (233, 180, 86)
FALSE: Colour = (0, 94, 213)
TRUE: Colour = (66, 228, 240)
"""Sky blue, vermilion and yellow of Okabe and Ito, in blue, green, red. True is also what was missed."""
UNSCORED: Colour = (150, 150, 150)
MOST_WIDE, MOST_HIGH = 560, 420
"""Pixels of a picture on the page; a smaller one is enlarged up to three times."""
_QUALITY = 80
_SMALL, _RING = 4, 6  # px of a picture on the page

KEY = (
    ("found and true", '<rect x="1" y="2" width="24" height="12" fill="#56b4e9" stroke="#2a6f96"/>'),
    ("found, but false", '<rect x="2" y="3" width="22" height="10" fill="#d55e00" stroke="#d55e00" stroke-width="3"/>'),
    (
        "true, but missed",
        '<rect x="2" y="3" width="22" height="10" fill="#f0e442" stroke="#6b6400" stroke-dasharray="4 3"/>',
    ),
    ("not judged", '<rect x="2" y="3" width="22" height="10" fill="#969696" stroke="#5f5f5f"/>'),
)
"""What the colours mean, each with its sign as SVG of 26 by 16."""


class Pair(NamedTuple):
    """Two pictures as JPEG."""

    truth: bytes
    result: bytes


class Boxes(NamedTuple):
    """The boxes of a frame: (N, 4) true and (M, 4) found in px, what stands beside each, and which are right.

    of_found: (M,) the true box that each found one is, -1 for none. marked: (M,) those with a change of identity.
    judged: (M,) those that count: where targets may be unlabelled, nobody knows what a box is.
    """

    true_px: np.ndarray
    found_px: np.ndarray
    of_found: np.ndarray
    true_names: list[str]
    found_names: list[str]
    marked: np.ndarray
    judged: np.ndarray


def mask_pair(picture: np.ndarray, labels: np.ndarray, found: np.ndarray) -> Pair:
    """A frame whose truth is a mask.

    picture: (h, w[, 3]) uint8 of any size. labels: (H, W), -1 where nothing counts. found: (H, W), nonzero is
    foreground.
    """
    scale = _scale(labels.shape[1], labels.shape[0])
    size = max(1, round(labels.shape[1] * scale)), max(1, round(labels.shape[0] * scale))
    base = _resized(picture, size)
    true, unscored = labels > 0, labels < 0
    found = (found > 0) & ~unscored
    left, right = base.copy(), _faint(base)
    for side in (left, right):
        _tint(side, unscored, size, UNSCORED, 0.75)
    _tint(left, true, size, TRUE, 0.3)
    _outline(left, true, size, TRUE, 2)
    for area, colour in ((true & found, HIT), (true & ~found, TRUE), (found & ~true, FALSE)):
        _tint(right, area, size, colour, 0.7)
        _outline(right, area, size, colour)
    _rings(right, true, found, size)
    return Pair(_jpeg(left), _jpeg(right))


def box_pair(picture: np.ndarray | None, size_px: tuple[int, int], boxes: Boxes) -> Pair:
    """A frame whose truth are boxes; without a picture they stand on grey. size_px: width and height of the frame."""
    scale = _scale(*size_px)
    size = max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale))
    base = np.full((size[1], size[0], 3), 70, np.uint8) if picture is None else _resized(picture, size)
    left, right = base.copy(), _faint(base)
    for box, name in zip(boxes.true_px * scale, boxes.true_names, strict=True):
        _box(left, box, TRUE, name)
    missed = np.ones(len(boxes.true_px), bool)
    missed[boxes.of_found[boxes.of_found >= 0]] = False
    for box in boxes.true_px[missed] * scale:
        _dashed(right, box, TRUE)
    for k, box in enumerate(boxes.found_px * scale):
        hit, changed = boxes.of_found[k] >= 0, bool(boxes.marked[k])
        colour = HIT if hit else FALSE if boxes.judged[k] else UNSCORED
        _box(right, box, colour, boxes.found_names[k], 3 if changed or colour == FALSE else 2)
    return Pair(_jpeg(left), _jpeg(right))


def matched(found_px: np.ndarray, true_px: np.ndarray, overlap: np.ndarray, least: float = 0.5) -> np.ndarray:
    """(M,) the true box of each found one, -1 for none: each true box in turn takes the best left, as is counted.

    overlap: (N, M), the IoU of true and found boxes.
    """
    of_found, left = np.full(len(found_px), -1), overlap.copy()
    for i in range(len(true_px)):
        j = int(np.argmax(left[i])) if len(found_px) else -1
        if j >= 0 and left[i, j] >= least:
            of_found[j] = i
            left[:, j] = -1
    return of_found


def _scale(width: int, height: int) -> float:
    return min(MOST_WIDE / width, MOST_HIGH / height, 3.0)


def _resized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    smaller = size[0] < picture.shape[1]
    return cv2.resize(colour_picture(picture), size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def _faint(picture: np.ndarray) -> np.ndarray:
    """Grey and darker, so that what is drawn on it stands out."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    return cv2.cvtColor((grey * 0.65 + 20).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def _tint(picture: np.ndarray, area: np.ndarray, size: tuple[int, int], colour: Colour, share: float) -> None:
    part = cv2.resize(area.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None] * share
    picture[:] = (picture * (1 - part) + np.array(colour) * part).astype(np.uint8)


def _outline(picture: np.ndarray, area: np.ndarray, size: tuple[int, int], colour: Colour, thick: int = 1) -> None:
    """Lines around what is there."""
    drawn = [drawable(contour) for contour in _contours(area, size)]
    cv2.polylines(picture, drawn, True, colour, thick, cv2.LINE_AA)


def _rings(picture: np.ndarray, true: np.ndarray, found: np.ndarray, size: tuple[int, int]) -> None:
    """A ring around what stands alone and is so small in a reduced picture that nobody would see it."""
    share = np.array([size[0] / true.shape[1], size[1] / true.shape[0]])
    for contour in _contours(true | found, size):
        low, high = contour.min(axis=(0, 1)), contour.max(axis=(0, 1))
        if (high - low).max() < _SMALL:
            x, y = (contour[0, 0] / share).astype(int).tolist()
            colour = HIT if true[y, x] and found[y, x] else TRUE if true[y, x] else FALSE
            centre = drawable((low + high) / 2).tolist()
            cv2.circle(picture, centre, _RING, (0, 0, 0), 4, cv2.LINE_AA)
            cv2.circle(picture, centre, _RING, colour, 2, cv2.LINE_AA)


def _contours(area: np.ndarray, size: tuple[int, int]) -> list[np.ndarray]:
    """(N, 1, 2) each, in pixels of the picture on the page."""
    height, width = area.shape
    contours, _ = cv2.findContours(area.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return [(contour + 0.5) * (size[0] / width, size[1] / height) for contour in contours]


def _box(picture: np.ndarray, box: np.ndarray, colour: Colour, name: str, thick: int = 2) -> None:
    x, y, right, bottom = drawable(np.array([*box[:2], *(box[:2] + box[2:])])).tolist()
    cv2.rectangle(picture, (x - 1, y - 1), (right + 1, bottom + 1), (0, 0, 0), thick)
    cv2.rectangle(picture, (x, y), (right, bottom), colour, thick)
    if name:
        label(picture, box, name, colour)


def _dashed(picture: np.ndarray, box: np.ndarray, colour: Colour) -> None:
    low, high = box[:2], box[:2] + box[2:]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    for start, end in pairwise(corners):
        steps = min(max(int(np.abs(end - start).sum() / 6) | 1, 1), 401)
        for shade, thick in (((0, 0, 0), 4), (colour, 2)):
            for k in range(0, steps, 2):
                a, b = (drawable(start + (end - start) * t / steps) for t in (k, k + 1))
                cv2.line(picture, tuple(a.tolist()), tuple(b.tolist()), shade, thick)


def _jpeg(picture: np.ndarray) -> bytes:
    # Thin lines need their colour at each pixel.
    finest = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    how = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, finest]
    return cv2.imencode(".jpg", picture, how)[1].tobytes()
