"""Association scores: how well a detection continues a track, as log-odds, 0 where the evidence is balanced.

Scores add up, and a target without a link scores 0. So no dummy has to be tuned, and dummies do not win by their number
(appendix C gives dummies an affinity of their own, and its optimum is then to link nothing). Motion and size are scored
first; colours of strips of the boxes only where they may decide.
"""

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace, shared_px
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import HEIGHT, PP, SEEN, SS, USUAL_SPEED, VX, VY, WIDTH, X, Y

_LARGEST_SIZE_PENALTY = 8.0
_MISSED_FRAMES = 5.0  # scale on which the penalty of a gap grows
_LEAST_DETECTIONS = 30  # before the birth rate is estimated
_NO_BIRTHS = 10  # detections without a birth, times the interval, that the rate starts from
_USUAL_BIRTH_RATE = 0.002  # per detection and frame
_LARGEST_BIRTH_PENALTY = 6.0  # a target that reappears at once on the spot is not new, however many targets appear
_LEAVING_FRAMES = 15  # for which a target is predicted to go on; later it may have stopped or turned
_STEPS, _PRIOR_STEPS, _LEAST_STEPS = 60, 10, 5  # steps remembered, what the prior is worth, before steps count
_LEAST_SPEED = 0.01  # heights a frame

# Lower ends of the first two of three strips of a box: head, trunk, legs of a person; roof, body, wheels of a car.
_STRIP_ENDS = (0.2, 0.55)
_BINS = np.array([16, 32, 32])  # of L, a and b
_FIRST_BIN = np.array([0, 16, 48])
_STRIP_BINS = 80
SIGNATURE = 3 * _STRIP_BINS
"""Bins of a histogram of three strips."""
_COLUMNS, _ROWS = 24, 48  # samples of a box
_MIDDLE = 0.3  # widths from the middle at which a column weighs 1/e: the rest of a box is mostly background

# Association scores below the first are not worth a histogram; differences above the second exceed what appearance
# can change.
_LEAST_SCORE, _CLEAR_LEAD = -8.0, 7.0
_WORST = -1.0  # light, shadow and turning change the appearance at once: it counts only so much against a link


@dataclass(frozen=True)
class SceneState:
    """What the scores depend on, beside tracks and detections.

    frame: its number. interval: frames from one sampled frame to the next. speed: of the speed prior, heights a frame.
    birth_rate: targets that begin inside the picture, per detection and frame. doubt: share of detections that are not
    certain. size: (width, height) of the picture, None if unknown.
    """

    frame: int
    interval: int
    speed: float
    birth_rate: float = 0.0
    doubt: float = 0.0
    size: tuple[float, float] | None = None

    def agility(self, parameters: TrackParameters) -> float:
        """Standard deviation of the velocity change per frame, box heights per frame; grows with the scene's speed."""
        return parameters.agility * self.speed / USUAL_SPEED


def birth_rate(births: int, seen: int, doubt: float, interval: int) -> float:
    """Targets that begin inside the picture per detection and frame, from counts of both.

    A doubtful detector loses tracks and begins new ones for them: such births are no sign of new targets.
    """
    return births / ((seen + _NO_BIRTHS * interval) * interval * (1 + 2 * doubt)) if seen > _LEAST_DETECTIONS else 0.0


def is_near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """(N,) whether boxes (N, 4) are so close to the picture's border that a target may come or go there."""
    x, y, width, height = (box_px[..., side] for side in range(4))
    if size is None:
        return namespace(box_px).zeros_like(x, dtype=bool)
    margin = 0.15 * height
    return (x < margin) | (y < margin) | (x + width > size[0] - margin) | (y + height > size[1] - margin)


def association_scores(
    state: np.ndarray, left_at_border: np.ndarray, box_px: np.ndarray, scene: SceneState, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) scores of tracks and the detections of a frame, without appearance.

    state: (N, kalman.COLUMNS) as last seen. left_at_border: (N,) whether last seen at the border. box_px: (M, 4).
    Arrays, or tensors with a gradient in the parameters.
    """
    functions = namespace(state)
    later = kalman.predict(state, scene.frame, scene.agility(parameters))
    centre, height = box_px[..., :2] + box_px[..., 2:] / 2, functions.log(box_px[..., 3])
    score = _position_score(later, later[..., PP] + parameters.scatter**2, centre, parameters)
    score = score - _size_penalty(later, height, scene.doubt, parameters.size_scatter)
    gap = scene.frame - state[..., SEEN]
    missed = gap > scene.interval
    if not missed.any():
        return score
    # A lost target may have stood still behind an obstacle: then its last place is a better prediction.
    rest = _position_score(state, parameters.scatter**2 + parameters.rest_drift**2 * gap, centre, parameters)
    rest = rest - _size_penalty(state, height, scene.doubt, parameters.size_scatter)
    lost = functions.maximum(score, rest - parameters.rest_price)
    late = functions.clip(gap - scene.interval, 0, None)
    lost = lost - (parameters.missed + 0.5 * functions.log1p(late / _MISSED_FRAMES))[..., None]
    # A target seen at the border after a gap is more likely another one.
    lost = lost - (
        parameters.border * is_near_border(box_px, scene.size)[..., None, :]
        + parameters.left * left_at_border[..., None]
    )
    # Where targets keep appearing inside the picture, this is rather a new one than a lost one.
    excess = functions.log(functions.clip(scene.birth_rate / _USUAL_BIRTH_RATE, 1.0, None))
    lost = lost - functions.clip(parameters.births * excess, None, _LARGEST_BIRTH_PENALTY)
    return functions.where(missed[..., None], lost, score)


def _position_score(
    place: np.ndarray, variance: np.ndarray, centre_px: np.ndarray, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) log density of centres around predicted places, and the prior. variance: (N,) in squared heights."""
    functions = namespace(place)
    # Standing people move less up and down in the picture than across it.
    level = functions.ones_like(variance)
    upright = functions.where(place[..., HEIGHT] > place[..., WIDTH], parameters.upright * level, level)
    unit = (place[..., HEIGHT] ** 2 * variance)[..., None]
    across = centre_px[..., None, :, 0] - place[..., X : X + 1]
    along = (centre_px[..., None, :, 1] - place[..., Y : Y + 1]) / upright[..., None]
    away = (across * across + along * along) / unit
    peak = parameters.prior - functions.log(2 * math.pi * variance * upright)
    return peak[..., None] - (1 + parameters.tail / 2) * functions.log1p(away / parameters.tail)


def _size_penalty(state: np.ndarray, height: np.ndarray, doubt: float, scatter: float) -> np.ndarray:
    """(N, M) penalty for a height other than predicted. height: (M,) its logarithm."""
    functions = namespace(state)
    usual = scatter * (1 + 0.5 * doubt)
    variance = usual**2 + state[..., SS]
    change = height[..., None, :] - functions.log(state[..., HEIGHT : HEIGHT + 1])
    wrong = functions.clip(0.5 * change**2 / variance[..., None], None, _LARGEST_SIZE_PENALTY)
    return wrong + 0.5 * functions.log(variance / usual**2)[..., None]


def is_remembered(
    state: np.ndarray, frame: int, interval: int, size: tuple[float, float] | None, parameters: TrackParameters
) -> np.ndarray:
    """(N,) which tracks (N, kalman.COLUMNS) are kept after a frame; those that have left the picture go earlier.

    interval: frames from one sampled frame to the next. size: (width, height) of the picture, None if unknown. Arrays
    or tensors.
    """
    functions = namespace(state)
    age = frame - state[..., SEEN]
    keep = age <= parameters.memory_frames
    if size is None:
        return keep
    going = functions.clip(age, None, _LEAVING_FRAMES)
    x, y = state[..., X] + going * state[..., VX], state[..., Y] + going * state[..., VY]
    outside = (x < 0) | (x > size[0]) | (y < 0) | (y > size[1])
    return keep & (~outside | (age <= parameters.memory_outside_frames) | (age <= interval))


class SpeedPrior:
    """Estimates the usual speed of a scene's targets, in box heights a frame.

    A step is the distance between mutual nearest neighbours of successive frames. It needs no identities, so that a
    wrong estimate cannot confirm itself.
    """

    def __init__(self, speed: float) -> None:
        """speed: the prior."""
        self.start = self.speed = speed
        self.usual = speed  # of the steps that are remembered
        self.steps: deque[float] = deque(maxlen=_STEPS)

    def add(self, before_px: np.ndarray, now_px: np.ndarray, frames: int) -> None:
        """Learn from the boxes (N, 4), (M, 4) of two successive sampled frames, in the same coordinates."""
        if not len(before_px) or not len(now_px):
            return
        centre, other = before_px[:, :2] + before_px[:, 2:] / 2, now_px[:, :2] + now_px[:, 2:] / 2
        distance = np.hypot(centre[:, None, 0] - other[None, :, 0], centre[:, None, 1] - other[None, :, 1])
        nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
        mutual = np.flatnonzero(back[nearest] == np.arange(len(before_px)))
        self.steps.extend(distance[mutual, nearest[mutual]] / (before_px[mutual, 3] * frames))
        if (known := self.known) >= _LEAST_STEPS:
            self.usual = max(1.25 * sorted(self.steps)[(3 * known) // 4], _LEAST_SPEED)
            self.speed = blend_speed(self.start, self.usual, known)

    @property
    def known(self) -> int:
        """Steps remembered."""
        return len(self.steps)


def blend_speed(start: float, usual: float, known: int) -> float:
    """The speed by the prior `start` and by `known` steps of speed `usual`. Numbers or tensors."""
    share = known / (_PRIOR_STEPS + known) * (known >= _LEAST_STEPS)
    return start ** (1 - share) * usual**share


def strip_histograms(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N, SIGNATURE) float32 histograms of Lab colour over three strips, weighted to the middle columns of each box.

    image: (H, W, 3) uint8 BGR or (H, W) grey. box_px: (N, 4) x, y, width, height; the part outside the image does not
    count. Each row sums to 1, so that sum(sqrt(a b)) is the mean Bhattacharyya coefficient; a box wholly outside has
    zeros.
    """
    count = len(box_px)
    samples = np.zeros((count, _ROWS, _COLUMNS, 3), np.uint8)
    visible = np.zeros((count, 4))  # the part of each box inside the image, in pixels
    height, width = image.shape[:2]
    for n, (x, y, w, h) in enumerate(box_px.tolist()):
        left, right = max(int(np.floor(x)), 0), min(int(np.ceil(x + w)), width)
        top, bottom = max(int(np.floor(y)), 0), min(int(np.ceil(y + h)), height)
        if right > left and bottom > top:
            crop = image[top:bottom, left:right]
            is_larger = crop.shape[0] >= _ROWS and crop.shape[1] >= _COLUMNS
            how = cv2.INTER_AREA if is_larger else cv2.INTER_LINEAR
            sampled = cv2.resize(crop, (_COLUMNS, _ROWS), interpolation=how)
            samples[n] = sampled if image.ndim == 3 else sampled[..., None]
            visible[n] = left, top, right - left, bottom - top
    inside = visible[:, 2] > 0
    if not inside.any():
        return np.zeros((count, SIGNATURE), np.float32)
    lab = cv2.cvtColor(samples.reshape(-1, _COLUMNS, 3), cv2.COLOR_BGR2LAB).reshape(samples.shape)
    # Where each sample lies in the whole box, of which the image's border may have cut off a part.
    across, down = (
        (visible[:, [axis]] - box_px[:, [axis]] + (np.arange(most) + 0.5) / most * visible[:, [axis + 2]])
        / box_px[:, [axis + 2]]
        for axis, most in enumerate((_COLUMNS, _ROWS))
    )
    weight = np.exp(-(((across - 0.5) / _MIDDLE) ** 2)) * inside[:, None]
    strip = np.searchsorted(_STRIP_ENDS, down.ravel()).reshape(down.shape)
    start = np.arange(count)[:, None] * SIGNATURE + strip * _STRIP_BINS
    place = start[:, :, None, None] + _FIRST_BIN + (lab * _BINS >> 8)
    weights = np.broadcast_to(weight[:, None, :, None], place.shape)
    counts = np.bincount(place.ravel(), weights.ravel(), count * SIGNATURE).reshape(count, 3, _STRIP_BINS)
    # A strip counts the same however much of it is visible.
    return _normalize(_normalize(counts).reshape(count, SIGNATURE)).astype(np.float32)


def _normalize(counts: np.ndarray) -> np.ndarray:
    """Shares of the sum over the last axis; zeros stay zeros."""
    total = counts.sum(axis=-1, keepdims=True)
    return np.divide(counts, total, out=np.zeros_like(counts), where=total > 0)


def similarity(signature: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N, M) Bhattacharyya coefficients of histograms (N, D) and (M, D); NaN where either is unknown (zeros)."""
    is_known = np.any(signature, axis=1)[:, None] & np.any(other, axis=1)
    return np.where(is_known, np.sqrt(signature) @ np.sqrt(other).T, np.nan)


def appearance_scores(similarity: np.ndarray, visible: np.ndarray, parameters: TrackParameters) -> np.ndarray:
    """(N, M) association scores of similarities, 0 for NaN. visible: (M,) shares of the boxes. Arrays or tensors."""
    functions = namespace(similarity)
    is_known = similarity == similarity
    score = parameters.appearance_weight * (functions.where(is_known, similarity, 1.0) - parameters.appearance_offset)
    return functions.where(is_known, functions.clip(score, _WORST, None) * functions.sqrt(visible)[..., None, :], 0.0)


def is_ambiguous(score: np.ndarray, signature: np.ndarray) -> bool:
    """Whether appearance may decide, from scores (N, M) without it and histograms (N, D) of the tracks.

    It may where a track or a detection has two likely links, and where a likely link is of a track without histogram.
    """
    if not score.size:
        return False
    likely = score > _LEAST_SCORE
    for axis in (1, 0):
        rivals = likely & (score > score.max(axis=axis, keepdims=True) - _CLEAR_LEAD)
        if (rivals.sum(axis=axis) > 1).any():
            return True
    unknown = ~np.any(signature, axis=1) if signature.shape[1] else np.ones(len(score), bool)
    return bool(likely[unknown].any())


def blend_histograms(signature: np.ndarray, seen: np.ndarray, visible: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """(N, D) histograms of tracks after a detection each, weighted by the share of it that was visible.

    hits: (N,) detections so far, this one included: the first few are averaged, then older ones fade.
    """
    gain = np.maximum(0.2, 1 / hits) * visible**2
    gain = np.where(np.any(signature, axis=1), np.where(np.any(seen, axis=1), gain, 0.0), 1.0)[:, None]
    return (1 - gain) * signature + gain * seen


def visible_shares(box_px: np.ndarray) -> np.ndarray:
    """(N,) share of each box (N, 4) that no nearer box covers; a box is nearer if its bottom is lower in the image."""
    bottom = box_px[:, 1] + box_px[:, 3]
    nearer = bottom > bottom[:, None]
    covered = (shared_px(box_px[:, None], box_px) * nearer).sum(axis=1) / (box_px[:, 2] * box_px[:, 3])
    return np.clip(1 - covered, 0.0, 1.0)
