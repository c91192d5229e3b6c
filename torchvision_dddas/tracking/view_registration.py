"""Find the homography between the ground in two pictures from tracks: hypotheses by vote, then a fit."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from torchvision_dddas.geometry import best_pairs, transfer

_FOUND, _MISSED = 0.8, float(np.log(1 - 0.8))
"""Probability that a target in both views is found in both; and the logarithm of the opposite."""
_SINGULAR = 1e-12
SCATTER = 0.3
"""Standard deviation between a target's places in the two views, in box sizes."""
_FOCAL, _TILTS_DEG, _USUAL_DEG = 0.75, np.arange(25.0, 95.0, 5.0), (48.0, 13.0)
"""Typical drone cameras: focal length in picture widths, tilts, and the mean and spread of tilts."""
_SCALES, _TURNS = np.exp(np.linspace(-0.8, 0.8, 9)), 60
_CELL, _CELLS, _MOST, _UNLIKE = 1.5, 64, 50, 0.05
"""The vote: side of a cell in target sizes, cells a side, most targets of a, and the vote for unlike motions."""


@dataclass(frozen=True)
class ViewTargets:
    """The targets of one frame of a view.

    identity: (N,) numbers of the view's tracks. place: (N, 2) ground places, in pixels or metres. covariance:
    (N, 2, 2) of the places. size: (N,) of the boxes in pixels; ones for metres. motion: (N, 2) since ten frames before,
    NaN if unknown. extent: (4,) left, top, right and bottom edge of the area where targets have been seen.
    """

    identity: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
    size: np.ndarray
    motion: np.ndarray
    extent: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> "ViewTargets":
        own = {name: getattr(self, name)[rows] for name in ("identity", "place", "covariance", "size", "motion")}
        return replace(self, **own)


def score_pairs(b_from_a: np.ndarray, a: ViewTargets, b: ViewTargets, wider: float = 1.0) -> np.ndarray:
    """Return (N, M) log likelihood ratios that two targets are one, against another target of b by chance.

    The ratio uses places, sizes and motions; the cameras' motion is removed from motions, as a median over pairs.
    wider: factor on the standard deviations.
    """
    if not len(a.place) or not len(b.place):
        return np.zeros((len(a.place), len(b.place)))
    there = transfer(b_from_a, a.place)
    off = b.place[None] - there[:, None]
    spread = wider**2 * (b.covariance[None] + a.covariance[:, None] if _is_metric(a) else b.covariance[None])
    determinant = spread[..., 0, 0] * spread[..., 1, 1] - spread[..., 0, 1] ** 2
    square = spread[..., 1, 1] * off[..., 0] ** 2 + spread[..., 0, 0] * off[..., 1] ** 2
    square = (square - 2 * spread[..., 0, 1] * off[..., 0] * off[..., 1]) / determinant
    apart = np.square(b.place[:, None] - b.place[None]).sum(-1)
    # Chance matches are as dense as the targets of b within 4.2 box sizes, or in metres within their mean spacing.
    share = np.prod(np.ptp(b.place, axis=0)) / len(b.place) + 1e-9
    reach = np.full(len(b.place), share) if _is_metric(a) else 18 * b.size**2
    density = (apart < reach[:, None]).sum(1) / (np.pi * reach)
    score = np.log(_FOUND / (2 * np.pi * np.sqrt(determinant) * density[None])) - 3 * np.log1p(square / 4)
    depth = a.place @ b_from_a[2, :2] + b_from_a[2, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.abs(np.linalg.det(b_from_a) / depth**3))
        larger = np.log(b.size[None] / (scale * a.size)[:, None])
    moved = b.motion[None] - (there - transfer(b_from_a, a.place - a.motion))[:, None]
    close = score > 0
    if close.sum() > 2:
        larger = larger - np.median(larger[close])
        is_known = close & np.isfinite(moved).all(-1)
        moved = moved - (np.median(moved[is_known], axis=0) if is_known.sum() > 2 else 0)
    score += 0.3 - 0.5 * np.minimum(np.square(larger / 0.4), 6)
    tolerance = np.square(0.4 * b.size) + 0.09 * np.square(b.motion).sum(1)
    score += np.nan_to_num(0.5 - 0.5 * np.minimum(np.square(moved).sum(-1) / tolerance[None], 6))
    return np.nan_to_num(np.maximum(score, -9.0), nan=-9.0)


def _is_metric(targets: ViewTargets) -> bool:
    return bool((targets.size == 1).all())


def are_within(places: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return (N,) whether places lie in a picture."""
    inside: np.ndarray = np.all((places > extent[:2]) & (places < extent[2:]), axis=1)
    return inside


def pair_up(
    b_from_a: np.ndarray, a: ViewTargets, b: ViewTargets, wider: float = 1.0
) -> tuple[np.ndarray, float, float]:
    """Return pairs (K, 2) of rows, the score of the map, and the share of common targets that have a partner.

    The score is the log likelihood ratio of the pairs, minus a cost for common targets without a partner.
    """
    if abs(np.linalg.det(b_from_a)) < _SINGULAR:
        return np.zeros((0, 2), np.int64), -np.inf, 0.0
    score = score_pairs(b_from_a, a, b, wider)
    pairs = best_pairs(score)
    inside_a = are_within(transfer(b_from_a, a.place), b.extent)
    inside_b = are_within(transfer(np.linalg.inv(b_from_a), b.place), a.extent)
    inside_a[pairs[:, 0]] = inside_b[pairs[:, 1]] = True
    fewer = min(inside_a.sum(), inside_b.sum())
    unpaired = inside_a.sum() + inside_b.sum() - 2 * len(pairs)
    total = score[pairs[:, 0], pairs[:, 1]].sum() + _MISSED / 2 * unpaired
    return pairs, float(total), len(pairs) / max(fewer, 1)


def fit_map(
    start: np.ndarray, a: ViewTargets, b: ViewTargets, pairs: np.ndarray, stiffness_sizes: float, wider: float = 1.0
) -> np.ndarray:
    """Fit the (3, 3) map to b from a by robust least squares over pairs, near a start.

    stiffness_sizes: how far, in box sizes, the map may move from the start; this models smooth motion.
    For metres only a shift is fitted.
    """
    if not len(pairs):
        return start
    p, q = a.place[pairs[:, 0]], b.place[pairs[:, 1]]
    sigma = wider * np.sqrt(np.sqrt(np.linalg.det(b.covariance[pairs[:, 1]])))
    if _is_metric(a):
        weight, firm = np.ones(len(p)), stiffness_sizes**-2
        for _ in range(4):
            shift = ((weight[:, None] * (q - p)).sum(0) + firm * start[:2, 2]) / (weight.sum() + firm)
            weight = 1 / (1 + np.square((q - p - shift) / sigma[:, None]).sum(1) / 4)
        return np.array([[1.0, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])
    grid = _grid_of(a.place, start, b.extent)
    points, wanted = np.concatenate([p, grid]), np.concatenate([q, transfer(start, grid)])
    if not np.isfinite(wanted).all():  # a point on the horizon
        return start
    unit = np.median(b.size)
    sigmas = np.concatenate([sigma, np.full(len(grid), stiffness_sizes * unit)])
    to_unit_a, to_unit_b = _normalizer(points), _normalizer(wanted)
    points, wanted = transfer(to_unit_a, points), transfer(to_unit_b, wanted)
    sigmas = sigmas * to_unit_b[0, 0]
    map_ = to_unit_b @ start @ np.linalg.inv(to_unit_a)
    map_ = map_ / map_[2, 2]
    ones = np.ones(len(points))
    for _ in range(4):
        x, y, w = map_ @ np.c_[points, ones].T
        u, v = x / w, y / w
        residual = wanted - np.c_[u, v]
        square = np.square(residual / sigmas[:, None]).sum(1)
        weight = 1 / sigmas / np.sqrt(1 + np.where(np.arange(len(points)) < len(p), square, 0) / 4)
        row, none = np.c_[points, ones] / w[:, None], np.zeros((len(points), 3))
        du = np.c_[row, none, -u[:, None] * row[:, :2]] * weight[:, None]
        dv = np.c_[none, row, -v[:, None] * row[:, :2]] * weight[:, None]
        system = np.concatenate([du, dv])
        if not np.isfinite(system).all():
            return start
        step = np.linalg.lstsq(system, (residual * weight[:, None]).T.ravel(), rcond=None)[0]
        map_ = map_ + np.append(step, 0).reshape(3, 3)
    fitted = np.linalg.inv(to_unit_b) @ map_ @ to_unit_a
    return fitted / fitted[2, 2] if np.isfinite(fitted).all() else start


def _grid_of(places: np.ndarray, b_from_a: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return (9, 2) points that cover the targets of a inside the picture of b."""
    inside = places[are_within(transfer(b_from_a, places), extent)]
    inside = inside if len(inside) > 1 else places
    low, high = inside.min(0), inside.max(0) + 1
    u, v = np.meshgrid(np.linspace(low[0], high[0], 3), np.linspace(low[1], high[1], 3))
    return np.c_[u.ravel(), v.ravel()]


def _normalizer(points: np.ndarray) -> np.ndarray:
    middle = points.mean(0)
    scale = 1 / max(float(np.abs(points - middle).mean()), 1e-9)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])


# --------------------------------------------------------------------------------------------------------------------
# Hypotheses.


def hypotheses(a: ViewTargets, b: ViewTargets, around: np.ndarray, count: int = 40) -> Iterator[np.ndarray]:
    """Yield maps (3, 3) to b from a, by votes of the targets of a nearest to a point, best first.

    The change of box sizes over a picture gives the rough tilt of its camera. Without both tilts, the views differ
    by a turn, a shift and a scale: each pair with similar size and motion votes for a shift at each turn.
    """
    if _is_metric(a):
        yield from _shifts(a, b, count)
        return
    near_a = np.argsort(np.square(a.place - around).sum(1))[:_MOST]
    near_b = np.argsort(np.square(b.place - (b.extent[:2] + b.extent[2:]) / 2).sum(1))[: 3 * _MOST]
    found: list[tuple[float, np.ndarray]] = []
    for tilt_a, tilt_b in product(_likely_tilts(a), _likely_tilts(b)):
        above_a, above_b = _Above(a[near_a], tilt_a), _Above(b[near_b], tilt_b)
        unit = np.nanmedian(above_b.size)
        for scale in _SCALES * unit / np.nanmedian(above_a.size):
            for votes, turn, shift in _vote(above_a, above_b, scale, unit):
                move = np.array([[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag], [0, 0, 1]])
                found.append((votes, np.linalg.inv(above_b.map) @ move @ above_a.map))
    found.sort(key=lambda one: -one[0])
    kept: list[np.ndarray] = []
    for _, b_from_a in found:
        there = transfer(b_from_a, a.place)
        if len(kept) < count and not any(are_one(there, other, b) for other in kept):
            kept.append(there)
            yield b_from_a / b_from_a[2, 2]


def _shifts(a: ViewTargets, b: ViewTargets, count: int) -> Iterator[np.ndarray]:
    """Yield the zero shift first, then the shifts on which most pairs of places agree."""
    from scipy.spatial import cKDTree

    shifts = (b.place[None] - a.place[:, None]).reshape(-1, 2)
    reach = 2 * float(np.sqrt(np.median(np.linalg.det(b.covariance)) ** 0.5))
    common = np.argsort(-cKDTree(shifts).query_ball_point(shifts, reach, return_length=True))[: count - 1]
    for shift in [np.zeros(2), *shifts[common]]:
        yield np.array([[1.0, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])


def are_one(there: np.ndarray, other: np.ndarray, b: ViewTargets) -> bool:
    """Return whether two maps take the targets of a to the same places in b, within the size of a box."""
    return bool(np.median(np.hypot(*(there - other).T)) < np.median(b.size))


class _Above:
    """A view as seen from straight above, for a given tilt below the horizon. Places and motions are complex."""

    def __init__(self, view: ViewTargets, tilt_deg: float) -> None:
        middle, focal = (view.extent[:2] + view.extent[2:]) / 2, _FOCAL * (view.extent[2] - view.extent[0])
        cos, sin = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
        rays = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, focal]]) / focal
        self.map = np.array([[1, 0, 0], [0, -sin, cos], [0, cos, sin]]) @ rays
        self.place = transfer(self.map, view.place) @ [1, 1j]
        motion = self.place - transfer(self.map, view.place - np.nan_to_num(view.motion)) @ [1, 1j]
        self.motion = motion - np.median(motion.real) - 1j * np.median(motion.imag)  # minus the camera's motion
        down = np.c_[view.place, np.ones(len(view.place))] @ self.map[2]
        self.size = np.where(down > 0.1, view.size / focal / np.maximum(down, 0.1), np.nan)


def _vote(a: _Above, b: _Above, scale: float, unit: float) -> Iterator[tuple[float, complex, complex]]:
    """Yield the votes of the best shifts at one scale, each with its turn (times the scale) and the shift."""
    alike = np.exp(-0.5 * np.square(np.log(b.size[None] / (scale * a.size[:, None])) / 0.35))
    i, j = np.nonzero(alike > 0.3)
    if not len(i):
        return
    turns = scale * np.exp(1j * np.linspace(0, 2 * np.pi, _TURNS, endpoint=False))[:, None]
    shift = b.place[j] - turns * a.place[i]
    speed = np.percentile(abs(b.motion), 75) + 0.1 * unit
    vote = alike[i, j] * (_UNLIKE + np.exp(-2 * np.square(abs(b.motion[j] - turns * a.motion[i]) / speed)))
    place = np.stack([shift.real, shift.imag], -1) / (_CELL * unit)
    cell = np.floor(place - np.median(place, axis=1, keepdims=True)).astype(np.int64) + _CELLS // 2
    vote[((cell < 1) | (cell > _CELLS - 2)).any(-1)] = 0
    cell = np.clip(cell, 0, _CELLS - 1)
    flat = (np.arange(_TURNS)[:, None] * _CELLS + cell[..., 0]) * _CELLS + cell[..., 1]
    votes = np.bincount(flat.ravel(), vote.ravel(), _TURNS * _CELLS**2).reshape(_TURNS, _CELLS, _CELLS)
    near = votes + np.roll(votes, -1, 1) + np.roll(votes, -1, 2) + np.roll(votes, (-1, -1), (1, 2))
    for best in np.argpartition(near.ravel(), -3)[-3:].tolist():
        turn, *corner = np.unravel_index(best, near.shape)
        weight = vote[turn] * ((cell[turn] - np.array(corner)) // 2 == 0).all(1)
        if weight.any():
            yield float(near.ravel()[best]), complex(turns[turn, 0]), complex(np.average(shift[turn], weights=weight))


def refine(start: np.ndarray, a: ViewTargets, b: ViewTargets, around: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit a hypothesis to the targets of a nearest to a point, then to all, and return its score and map."""
    part = a[np.argsort(np.square(a.place - around).sum(1))[: _MOST // 2]]
    for targets, wider in ((part, 2.0), (part, 1.3), (part, 1.0), (a, 1.3), (a, 1.0), (a, 1.0)):
        start = fit_map(start, targets, b, pair_up(start, targets, b, wider)[0], 2.0 * wider, wider)
    return pair_up(start, a, b)[1], start


def _likely_tilts(view: ViewTargets) -> list[float]:
    """Return three tilts of the camera below the horizon, degrees, at which the ground sizes of boxes differ least."""
    cost = [np.inf] * len(_TILTS_DEG)
    for k, tilt in enumerate(_TILTS_DEG):
        size = np.log(_Above(view, tilt).size)
        if np.isfinite(size).all():
            spread = np.abs(size - np.median(size)).mean() + 0.02
            cost[k] = len(size) * np.log(spread) + 0.5 * np.square((tilt - _USUAL_DEG[0]) / _USUAL_DEG[1])
    best = int(np.argmin(cost))
    return _TILTS_DEG[np.unique(np.clip([best - 2, best, best + 2], 0, len(_TILTS_DEG) - 1))].tolist()
