"""One simulated frame beside what was found in it: which targets hold which bodies, and which cover which crowds.

Boxes are x, y of the top left pixel, width, height; a pixel is in a box that holds its centre. Metres are the truth's.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from torchvision_dddas.types import Truth

LEAST_VISIBLE = 0.5
"""A crowd counts in frames that show at least this share of its people."""

COVERING = 0.3
"""A box over a crowd shares at least so much of the smaller of the two boxes."""

NEAR_M = 2.0
"""A target this near to a small crowd's middle is it, wherever its box lies."""

LARGEST = 10.0
"""A box of more than so many times the area of what it holds says nothing of where that is ..."""

MARGIN_PX = 10.0
"""... what it holds being grown by this on every side first: blobs of small bodies are larger than they."""

TOUCHING_PX = 5.0
"""A blob this near to a pixel of something that can move is no false one: it may be its shadow or its edge."""

STILL_M_S = 0.2
"""People slower than this on average stand."""


@dataclass(frozen=True)
class Shown:
    """What a frame truly shows, without its picture.

    u, v: (P,) the pixels of all that can move; body: (P,) whose they are, a row of the bodies, -1 for none.
    number, target: (N,) int64; kind: (N,); place_m, velocity_m_s: (N, 2), as in Bodies. pixels: (N,) that show each;
    low_px, high_px: (N, 2) the first and the last column and row of them.
    """

    frame: int
    time_s: float
    u: np.ndarray
    v: np.ndarray
    body: np.ndarray
    number: np.ndarray
    target: np.ndarray
    kind: np.ndarray
    place_m: np.ndarray
    velocity_m_s: np.ndarray
    pixels: np.ndarray
    low_px: np.ndarray
    high_px: np.ndarray


@dataclass(frozen=True)
class Told:
    """What a run says of the targets of a frame, one row a target.

    box_px: (T, 4). identity: (T,) int64. place_m: (T, 2), NaN where it is not located. covariance_m2: (T, 2, 2).
    velocity_m_s: (T, 2), NaN where unknown. kind: (T,) human, not_human or unseen.
    blob_px: (B, 4) boxes of all that was detected, whether followed or not.
    """

    box_px: np.ndarray
    identity: np.ndarray
    place_m: np.ndarray
    covariance_m2: np.ndarray
    velocity_m_s: np.ndarray
    kind: tuple[str, ...]
    blob_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    def __len__(self) -> int:
        return len(self.box_px)


@dataclass(frozen=True)
class Crowd:
    """A crowd in a frame. people, visible: rows of the bodies, all of it and those that the picture shows.

    place_m: (2,) mean of all its people. middle_m: (2,) mean of those that show, radius_m that of a disc that is evenly
    filled with them. box_px: (4,) about their pixels. counts: whether enough of them show.
    """

    number: int
    people: np.ndarray
    visible: np.ndarray
    place_m: np.ndarray
    middle_m: np.ndarray
    radius_m: float
    box_px: np.ndarray
    counts: bool
    still: bool


def shown(truth: Truth) -> Shown:
    """What of a frame's truth is needed here: some kilobytes."""
    bodies = truth.bodies
    there = cv2.findNonZero(truth.mask | truth.people)  # a third of np.nonzero's time
    u, v = np.zeros((2, 0), np.int32) if there is None else there[:, 0].T
    order = np.argsort(bodies.number)
    wanted = truth.people[v, u].astype(np.int64)
    at = np.searchsorted(bodies.number[order], wanted).clip(max=max(len(bodies) - 1, 0))
    body = order[at] if len(bodies) else np.zeros(len(u), np.int64)
    body = np.where(bodies.number[body] == wanted, body, -1) if len(bodies) else np.full(len(u), -1)
    pixels = np.bincount(body[body >= 0], minlength=len(bodies))
    low, high = np.full((len(bodies), 2), np.inf), np.full((len(bodies), 2), -np.inf)
    known, at_px = body[body >= 0], np.stack([u, v], axis=1)[body >= 0].astype(float)
    np.minimum.at(low, known, at_px)
    np.maximum.at(high, known, at_px)
    return Shown(
        truth.frame,
        truth.time_s,
        u.astype(np.int32),
        v.astype(np.int32),
        body,
        np.asarray(bodies.number, np.int64),
        np.asarray(bodies.target, np.int64),
        np.asarray(bodies.kind),
        np.asarray(bodies.place_m, float)[:, :2],
        np.asarray(bodies.velocity_m_s, float)[:, :2],
        pixels,
        low,
        high,
    )


def crowds(frame: Shown, least_visible: float = LEAST_VISIBLE) -> list[Crowd]:
    """The crowds of the world at a frame, in the picture or not."""
    found = []
    for number in np.unique(frame.target[frame.kind == "person"]).tolist():
        people = np.flatnonzero((frame.target == number) & (frame.kind == "person"))
        visible = people[frame.pixels[people] > 0]
        place = frame.place_m[people].mean(axis=0)
        middle = frame.place_m[visible].mean(axis=0) if len(visible) else np.full(2, np.nan)
        away = frame.place_m[visible] - middle
        radius = float(np.sqrt(2 * (away**2).sum(axis=1).mean())) if len(visible) else 0.0
        counts = len(visible) > 0 and len(visible) >= least_visible * len(people)
        still = float(np.linalg.norm(frame.velocity_m_s[people], axis=1).mean()) < STILL_M_S
        found.append(Crowd(number, people, visible, place, middle, radius, box_about(frame, visible), counts, still))
    return found


def box_about(frame: Shown, bodies: np.ndarray) -> np.ndarray:
    """(4,) the box about the pixels of some bodies, rows of them; NaN where none shows."""
    visible = bodies[frame.pixels[bodies] > 0]
    if not len(visible):
        return np.full(4, np.nan)
    low, high = frame.low_px[visible].min(axis=0), frame.high_px[visible].max(axis=0)
    return np.concatenate([low, high - low + 1])


def within(frame: Shown, box_px: np.ndarray, margin_px: float = 0.0) -> np.ndarray:
    """(P,) bool, which of the pixels of what can move lie in a box (4,), grown by a margin."""
    x, y, width, height = box_px.tolist()
    low_u, low_v = x - 0.5 - margin_px, y - 0.5 - margin_px
    inside: np.ndarray = (frame.u >= low_u) & (frame.u <= low_u + width + 2 * margin_px)
    return inside & (frame.v >= low_v) & (frame.v <= low_v + height + 2 * margin_px)


def pixels_held(frame: Shown, box_px: np.ndarray) -> np.ndarray:
    """(T, N) int64, how many pixels of each body lie in each of the boxes (T, 4)."""
    held = np.zeros((len(box_px), len(frame.number)), np.int64)
    for row, box in enumerate(box_px):
        inside = frame.body[within(frame, box)]
        held[row] = np.bincount(inside[inside >= 0], minlength=held.shape[1])
    return held


def bodies_held(frame: Shown, held: np.ndarray) -> np.ndarray:
    """(T, N) bool, which bodies lie in each box: at least half of what the picture shows of them. held: (T, N)."""
    lies: np.ndarray = (frame.pixels > 0) & (2 * held >= frame.pixels)
    return lies


def touched(frame: Shown, box_px: np.ndarray, near_px: float = TOUCHING_PX) -> np.ndarray:
    """(B,) bool, which boxes have a pixel of something that can move in them or within near_px of them."""
    return np.array([bool(within(frame, box, near_px).any()) for box in box_px], bool)


def covering(frame: Shown, found: list[Crowd], told: Told, held: np.ndarray) -> np.ndarray:
    """(C, T) bool, which targets stand for which crowds. held: (T, N) bool, `bodies_held` of the targets' boxes.

    A target covers a crowd if its box holds someone of it and shares COVERING of the smaller of the two boxes; or if it
    is located within the crowd's radius, at least NEAR_M, of the middle of its visible people. So a blob over two
    crowds that cross covers both, and each of the parts in which a crowd was found covers it. A box more than LARGEST
    times as large as what it holds covers nothing by its pixels.
    """
    covers = np.zeros((len(found), len(told)), bool)
    fits = _fitting(frame, told.box_px, held)
    for row, crowd in enumerate(found):
        if not len(crowd.visible):
            continue
        holds = held[:, crowd.visible].any(axis=1)
        over = holds & fits & (_share_of_smaller(told.box_px, crowd.box_px) >= COVERING)
        away = np.linalg.norm(told.place_m - crowd.middle_m, axis=1)
        covers[row] = over | (away <= max(crowd.radius_m, NEAR_M))  # False where a place is NaN
    return covers


def _fitting(frame: Shown, box_px: np.ndarray, held: np.ndarray) -> np.ndarray:
    fits = np.zeros(len(box_px), bool)
    for row, box in enumerate(box_px):
        about = box_about(frame, np.flatnonzero(held[row]))
        if np.isfinite(about).all():
            fits[row] = box[2] * box[3] <= LARGEST * np.prod(about[2:] + 2 * MARGIN_PX)
    return fits


def _share_of_smaller(boxes: np.ndarray, one: np.ndarray) -> np.ndarray:
    side = np.minimum(boxes[:, :2] + boxes[:, 2:], one[:2] + one[2:]) - np.maximum(boxes[:, :2], one[:2])
    smaller = np.minimum(boxes[:, 2] * boxes[:, 3], one[2] * one[3])
    overlap = np.prod(np.maximum(side, 0), axis=1)
    share: np.ndarray = np.divide(overlap, smaller, out=np.zeros_like(overlap), where=smaller > 0)
    return share
