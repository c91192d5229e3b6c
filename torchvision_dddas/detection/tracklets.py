"""Follow each candidate over the looks before and after, so that targets can be judged by whole tracklets.

A tracklet starts at a candidate with a guess of its velocity, taken from a similar candidate one or three looks away.
It is extended look by look, after removal of the ground motion, to the candidate that fits its line, size and grey
levels best. Dense flow is not needed, and steps may be longer than the target. Of several guesses the steadiest
tracklet is kept. Two logistic scores, whose weights `python eval/tracklets.py` learns, then rate the candidate alone
and the whole tracklet. This step is ours; the source takes each pixel that differs as part of a target (appendix B,
S5).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from torchvision_dddas.detection.candidates import Candidates
from torchvision_dddas.geometry import transfer

LOOKS_BEFORE, LOOKS_AFTER = 4, 2

# Velocities are guessed from other looks: (offset of the look, number of its best candidates to try).
_GUESSES = ((1, 3), (-1, 3), (3, 1), (-3, 1))
# The longest guessed step is _LONGEST_STEP diagonals of the box plus _LONGEST_STEP_PX.
_LONGEST_STEP, _LONGEST_STEP_PX = 2.5, 4.0
# The standard deviation of the centre of a box is _CENTRE_SHARE of its side plus _CENTRE_PX.
_CENTRE_SHARE, _CENTRE_PX = 0.10, 0.7
# Gate of a link: the largest squared distance from the predicted centre, in units of its variance.
_LINE_GATE = 9.0
# Largest logarithm of the ratio of sides of two boxes of one target, and its spread.
_MOST_GROWTH, _GROWTH_SPREAD = 0.8, 0.35
_UNLIKE_COST = 6.0
_BORDER_PX = 3


@dataclass(frozen=True)
class Tracklets:
    """The best tracklet of each of a look's N candidates.

    members: by offset in looks, (N,) index of the tracklet's candidate in that look, -1 without one. velocity_px:
    (N, 2) pixels a look over the ground. All other fields are (N,). hits: number of candidates in the tracklet.
    travel_px: distance travelled. sureness: speed divided by its standard deviation. stays: share of the looks, among
    those in which the target should be elsewhere, that show a similar candidate at the same place. growth_x, growth_y:
    mean change of width and height, as logarithms.
    """

    members: Mapping[int, np.ndarray]
    velocity_px: np.ndarray
    hits: np.ndarray
    travel_px: np.ndarray
    sureness: np.ndarray
    stays: np.ndarray
    growth_x: np.ndarray
    growth_y: np.ndarray

    def of(self, rows: np.ndarray) -> "Tracklets":
        """Return the tracklets of the given rows."""
        members = {offset: index[rows] for offset, index in self.members.items()}
        return Tracklets(members, *(getattr(self, field.name)[rows] for field in fields(self)[1:]))


@dataclass(frozen=True)
class _Seen:
    """The M candidates of another look, compared with the N candidates of this look, in pixels of this look.

    centre: (M, 2). growth: (2, N, M) absolute logarithms of the ratios of width and height. likeness: (N, M)
    correlation of the patches. unlike: (N, M) cost of growth and likeness, infinite for pairs that cannot be one
    target. there_from_here: (3, 3) homography.
    """

    centre: np.ndarray
    growth: np.ndarray
    likeness: np.ndarray
    unlike: np.ndarray
    there_from_here: np.ndarray


def follow(here: Candidates, others: Mapping[int, tuple[Candidates, np.ndarray]], size: tuple[int, int]) -> Tracklets:
    """Return the best tracklet of each candidate of a look.

    others: by offset in looks, the candidates of another look and the (3, 3) homography from that look to this one.
    size: (width, height) of the picture.
    """
    count = len(here)
    seen = {o: _place(here, *others[o], size) for o in sorted(others, key=lambda o: (abs(o), -o))}
    centre, side = here.box_px[:, :2] + here.box_px[:, 2:] / 2, here.box_px[:, 2:]
    start, velocity, over = _guess(here, centre, seen)
    spread = _CENTRE_SHARE * side[start] + _CENTRE_PX
    members = {o: np.full(len(start), -1) for o in seen}
    line = _Line(centre[start], velocity, spread, over)
    possible = np.ones(len(start))
    for offset, there in seen.items():
        predicted = line.at(offset)
        back = transfer(there.there_from_here, predicted)
        possible += ((back > _BORDER_PX) & (back < np.array(size) - _BORDER_PX)).all(axis=1)
        if not len(there.centre):
            continue
        cost = _squared_distance(predicted, there.centre, line.variance(offset))
        outside = cost >= _LINE_GATE
        cost += there.unlike[start]
        cost[outside] = np.inf
        best = cost.argmin(axis=1)
        found = np.isfinite(cost[np.arange(len(start)), best])
        members[offset][found] = best[found]
        line.add(offset, there.centre[best], found)
    tracklets = _describe(start, here, members, seen, line)
    likeness = _mean_over(members, seen, "likeness", start, 0.3)
    steadiness = (
        3 * tracklets.hits / np.maximum(possible, 1)
        + 1.5 * np.log(tracklets.hits)
        - 0.5 * np.minimum(line.misfit(), 4)
        + likeness
        + 0.5 * np.minimum(np.log1p(np.minimum(tracklets.sureness, 100)), 3)
        - tracklets.growth_x
        - tracklets.growth_y
    )
    best = np.empty(count, int)
    order = np.argsort(steadiness, kind="stable")
    best[start[order]] = order  # the last assignment wins, which is the steadiest
    return tracklets.of(best)


def _place(here: Candidates, other: Candidates, here_from_there: np.ndarray, size: tuple[int, int]) -> _Seen:
    middle = np.array(size) / 2
    near, further = transfer(here_from_there, np.array([middle, [middle[0] + 10, middle[1]]]))
    scale = np.hypot(*(further - near)) / 10
    centre = transfer(here_from_there, other.box_px[:, :2] + other.box_px[:, 2:] / 2)
    sides, other_sides = np.log(here.box_px[:, 2:]), np.log(other.box_px[:, 2:] * scale)
    growth = np.abs(other_sides.T[:, None] - sides.T[:, :, None])
    likeness = here.patch @ other.patch.T
    unlike = (growth[0] ** 2 + growth[1] ** 2) / _GROWTH_SPREAD**2 + _UNLIKE_COST * (1 - likeness)
    unlike[np.maximum(*growth) > _MOST_GROWTH] = np.inf
    return _Seen(centre, growth, likeness, unlike, np.linalg.inv(here_from_there))


def _squared_distance(points: np.ndarray, others: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the (N, M) squared distances of points (N, 2) from others (M, 2), divided per axis by unit (N, 2)."""
    across = others[None, :, 0] - points[:, None, 0]
    down = others[None, :, 1] - points[:, None, 1]
    across *= across
    across *= 1 / unit[:, :1]
    down *= down
    down *= 1 / unit[:, 1:]
    across += down
    return across


def _guess(
    here: Candidates, centre: np.ndarray, seen: Mapping[int, _Seen]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Guess velocities from similar candidates in other looks.

    Return M guesses: (M,) index of the candidate, (M, 2) velocity in pixels a look, and (M,) looks over which it was
    measured. A candidate without a similar candidate gets velocity 0.
    """
    count = len(here)
    diagonal = np.hypot(*here.box_px[:, 2:].T)[:, None]
    start, velocity, over = [np.zeros(0, int)], [np.zeros((0, 2))], [np.zeros(0)]
    for offset, most in _GUESSES:
        if offset not in seen or not len(seen[offset].centre):
            continue
        there = seen[offset]
        away = _squared_distance(centre, there.centre, np.ones_like(centre))
        cost = there.unlike + away / (0.8 * diagonal + 2) ** 2
        cost[away >= (_LONGEST_STEP * diagonal + _LONGEST_STEP_PX) ** 2] = np.inf
        for best in np.argsort(cost, axis=1)[:, :most].T:
            able = np.flatnonzero(np.isfinite(cost[np.arange(count), best]))
            start.append(able)
            velocity.append((there.centre[best[able]] - centre[able]) / offset)
            over.append(np.full(len(able), abs(offset), float))
    alone = np.setdiff1d(np.arange(count), np.concatenate(start))
    start.append(alone)
    velocity.append(np.zeros((len(alone), 2)))
    over.append(np.ones(len(alone)))
    return np.concatenate(start), np.concatenate(velocity), np.concatenate(over)


class _Line:
    """Lines of constant velocity through the centres of tracklets, fitted by least squares as centres are added."""

    def __init__(self, centre: np.ndarray, velocity: np.ndarray, spread: np.ndarray, over: np.ndarray) -> None:
        """Start M lines. spread: (M, 2) sigma of a centre, px. over: (M,) looks that the velocity spans."""
        self.centre, self.velocity, self.spread = centre, velocity, spread
        self.offset_px = np.zeros_like(centre)  # offset of the line at time 0 from the candidate's own centre
        self._of_velocity = 1.4 * spread / over[:, None]
        count = len(centre)
        self.n, self.sum_t, self.sum_tt = np.ones(count), np.zeros(count), np.zeros(count)
        self._sum, self._sum_t = np.zeros((count, 2)), np.zeros((count, 2))
        self._places: list[tuple[int, np.ndarray, np.ndarray]] = [(0, np.zeros((count, 2)), np.ones(count, bool))]

    def at(self, offset: int) -> np.ndarray:
        """Return the (M, 2) positions of the lines at an offset in looks."""
        return self.centre + self.offset_px + self.velocity * offset

    def variance(self, offset: int) -> np.ndarray:
        """Return the (M, 2) variance of a centre around its prediction, px squared."""
        return 2 * self.spread**2 + (offset * self._of_velocity) ** 2

    def add(self, offset: int, centre: np.ndarray, found: np.ndarray) -> None:
        """Add the centres (M, 2) of the look at an offset to the lines for which `found`, (M,) bool, is set."""
        away = centre - self.centre
        self._places.append((offset, away, found))
        self.n += found
        self.sum_t += found * offset
        self.sum_tt += found * offset**2
        self._sum += away * found[:, None]
        self._sum_t += away * (found * offset)[:, None]
        enough = self.n >= 3
        spread_t = np.maximum(self.n * self.sum_tt - self.sum_t**2, 1e-9)
        fitted = (self.n[:, None] * self._sum_t - self.sum_t[:, None] * self._sum) / spread_t[:, None]
        self.velocity = np.where(enough[:, None], fitted, self.velocity)
        start = (self._sum - self.sum_t[:, None] * fitted) / self.n[:, None]
        self.offset_px = np.where(enough[:, None], start, self.offset_px)
        of_velocity = 1.2 * self.spread / np.sqrt(np.maximum(spread_t / self.n, 0.5))[:, None] + 0.1
        self._of_velocity = np.where(enough[:, None], of_velocity, self._of_velocity)

    def _root_mean_square(self, unit: np.ndarray | float) -> np.ndarray:
        total = np.zeros(len(self.n))
        for offset, away, found in self._places:
            miss = away - self.offset_px - self.velocity * offset
            total += found * ((miss / unit) ** 2).sum(axis=1)
        return np.sqrt(total / np.maximum(2 * self.n - 4, 1))

    def misfit(self) -> np.ndarray:
        """Return the (M,) root mean square distance of the centres from the line, in units of their spread."""
        return self._root_mean_square(self.spread)

    def speed_uncertainty(self) -> np.ndarray:
        """Return the (M,) standard deviation of the speed, pixels a look."""
        spread_t = np.maximum(self.n * self.sum_tt - self.sum_t**2, 0.5)
        return np.maximum(self._root_mean_square(1.0), 0.5) / np.sqrt(spread_t / self.n)

    def span(self) -> np.ndarray:
        """Return the (M,) looks from the first to the last centre."""
        last = np.max([np.where(found, offset, -99) for offset, _, found in self._places], axis=0)
        first = np.min([np.where(found, offset, 99) for offset, _, found in self._places], axis=0)
        return last - first


def _describe(
    start: np.ndarray, here: Candidates, members: Mapping[int, np.ndarray], seen: Mapping[int, _Seen], line: _Line
) -> Tracklets:
    centre, side = here.box_px[:, :2] + here.box_px[:, 2:] / 2, here.box_px[:, 2:]
    length = np.sqrt(side.prod(axis=1))[start]
    speed, span = np.hypot(*line.velocity.T), line.span()
    stays, gone_looks = np.zeros(len(start)), np.zeros(len(start))
    for offset, there in seen.items():
        gone = speed * abs(offset) > 0.7 * length
        gone_looks += gone
        if len(there.centre):
            near = np.abs(there.centre.T[:, None] - centre.T[:, :, None]) < 0.3 * side.T[:, :, None] + 1
            stays += gone * (near[0] & near[1] & (np.maximum(*there.growth) < 0.5)).any(axis=1)[start]
    return Tracklets(
        members,
        line.velocity,
        line.n,
        speed * span,
        speed / line.speed_uncertainty(),
        stays / np.maximum(gone_looks, 1),
        _mean_over(members, seen, "growth", start, 0.5, 0),
        _mean_over(members, seen, "growth", start, 0.5, 1),
    )


def _mean_over(
    members: Mapping[int, np.ndarray],
    seen: Mapping[int, _Seen],
    name: str,
    start: np.ndarray,
    missing: float,
    axis: int | None = None,
) -> np.ndarray:
    """Return the (M,) mean of a field of `_Seen` over the links of each tracklet; `missing` without links."""
    total, count = np.zeros(len(start)), np.zeros(len(start))
    for offset, index in members.items():
        values, found = getattr(seen[offset], name), index >= 0
        values = values if axis is None else values[axis]
        if values.shape[1]:
            total += np.where(found, values[start, np.maximum(index, 0)], 0)
            count += found
    return np.where(count > 0, total / np.maximum(count, 1), missing)
